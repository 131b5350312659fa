"""The batch modes of three providers as a server speaks them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any

from merge_runner.emulator.batches import Batch, Result
from merge_runner.emulator.formats import CHAT, GEMINI, MESSAGES, RESPONSES, ServedFormat
from merge_runner.emulator.replies import Asked, marked
from merge_runner.errors import UsageError
from merge_runner.llm.content_hashes import canonical_json
from merge_runner.records import ATTEMPT_HEADER, SLOT_HEADER

DAY_S = 86400
OPENAI_URLS: dict[str, ServedFormat] = {each.path: each for each in (CHAT, RESPONSES)}
GRPC_CODES = {400: 3, 429: 8, 500: 13, 503: 14}


def asked(
    wire: ServedFormat,
    path: str,
    body: Any,  # noqa: ANN401 # whatever stands there is read like the body of a request
    custom_id: str,
    line: dict[str, Any],
    model: str | None = None,
) -> Asked:
    """A line as the request that it stands for: in canonical JSON, as our own client sends it."""
    slot, attempt = line.get(SLOT_HEADER), line.get(ATTEMPT_HEADER, "")
    return Asked(
        wire=wire,
        path=path,
        raw=canonical_json(body).encode(),
        model=model,
        slot=None if slot is None else canonical_json(slot),
        attempt=str(attempt),
        custom_id=custom_id,
    )


def openai_lines(content: bytes, endpoint: str) -> list[Asked]:
    """The lines of an input file; raises UsageError."""
    wire = OPENAI_URLS[endpoint]
    lines = []
    for number, text in enumerate(filter(None, content.splitlines()), start=1):
        try:
            line = json.loads(text)
            if line["url"] != endpoint or line["method"] != "POST":
                raise UsageError(f"Line {number} is not for POST {endpoint}.")
            lines.append(asked(wire, endpoint, line["body"], str(line["custom_id"]), line))
        except (ValueError, KeyError, TypeError) as exc:
            raise UsageError(f"Line {number} is no request.") from exc
    return different(lines)


def anthropic_lines(body: dict[str, Any]) -> list[Asked]:
    """The requests of a batch; raises UsageError."""
    return different(
        [
            asked(MESSAGES, MESSAGES.path, line["params"], str(line["custom_id"]), line)
            for line in body["requests"]
        ]
    )


def gemini_lines(requests: Sequence[dict[str, Any]], version: str, model: str) -> list[Asked]:
    """The requests of a batch, in the body (with metadata) or in a file (with a key)."""
    path = f"/{version}/models/{model}:generateContent"
    return [
        asked(GEMINI, path, line["request"], _gemini_key(line, number), line, model)
        for number, line in enumerate(requests)
    ]


def _gemini_key(line: dict[str, Any], number: int) -> str:
    return str(line.get("key") or (line.get("metadata") or {}).get("key") or number)


def different(lines: list[Asked]) -> list[Asked]:
    """The lines; raises UsageError where two have the same id."""
    if len({line.custom_id for line in lines}) < len(lines):
        raise UsageError("Every custom_id must be unique within a batch.")
    return lines


def openai_batch(batch: Batch, now_s: float) -> dict[str, Any]:
    """A batch object."""
    answered = sum(result.status == 200 for result in batch.results or ())
    done = batch.finished(now_s)
    refused = batch.refused and {
        "object": "list",
        "data": [
            {
                "code": "token_limit_exceeded",
                "message": batch.refused,
                "param": None,
                "line": None,
            }
        ],
    }
    return marked(
        {
            "id": batch.id,
            "object": "batch",
            "endpoint": batch.details["endpoint"],
            "errors": refused,
            "input_file_id": batch.details["input_file_id"],
            "completion_window": "24h",
            "status": _openai_status(batch),
            "output_file_id": f"file-{batch.id}-output" if answered else None,
            "error_file_id": f"file-{batch.id}-error"
            if batch.ended and answered < len(batch.lines)
            else None,
            "created_at": int(batch.began_s),
            "expires_at": int(batch.began_s) + DAY_S,
            "request_counts": {
                "total": len(batch.lines),
                "completed": answered if batch.ended else done,
                "failed": len(batch.lines) - answered if batch.ended else 0,
            },
            "metadata": batch.details["metadata"],
        }
    )


def _openai_status(batch: Batch) -> str:
    if batch.refused:
        return "failed"
    if not batch.ended:
        return "in_progress" if batch.cancelled_s is None else "cancelling"
    if batch.cancelled_s is not None:
        return "cancelled"
    return "expired" if _not_asked(batch) else "completed"


def openai_results(batch: Batch, *, answered: bool) -> bytes:
    """The output file, or that of errors."""
    chosen = (each for each in batch.results or () if (each.status == 200) == answered)
    return _jsonl([_openai_result(batch, result) for result in chosen])


def _openai_result(batch: Batch, result: Result) -> dict[str, Any]:
    if result.status is None:
        word = "expired" if batch.cancelled_s is None else "cancelled"
        error = {"code": f"batch_{word}", "message": f"This request was not executed: {word}."}
        response = None
    else:
        error = None
        response = {"status_code": result.status, "request_id": "emulated", "body": result.body}
    return {
        "id": f"batch_req_{result.custom_id}",
        "custom_id": result.custom_id,
        "response": response,
        "error": error,
    }


def anthropic_batch(batch: Batch, own_url: str) -> dict[str, Any]:
    """A message batch; ``own_url`` is that of the server."""
    counts = dict.fromkeys(("processing", "succeeded", "errored", "canceled", "expired"), 0)
    for result in batch.results or ():
        counts[_anthropic_type(batch, result)] += 1
    counts["processing"] = 0 if batch.ended else len(batch.lines)
    cancelled = None if batch.cancelled_s is None else _rfc3339(batch.cancelled_s)
    going_on = "in_progress" if cancelled is None else "canceling"
    return marked(
        {
            "id": batch.id,
            "type": "message_batch",
            "processing_status": "ended" if batch.ended else going_on,
            "request_counts": counts,
            "created_at": _rfc3339(batch.began_s),
            "expires_at": _rfc3339(batch.began_s + DAY_S),
            "ended_at": _rfc3339(batch.due_s) if batch.ended else None,
            "archived_at": None,
            "cancel_initiated_at": cancelled,
            "results_url": f"{own_url}/v1/messages/batches/{batch.id}/results"
            if batch.ended
            else None,
        }
    )


def anthropic_results(batch: Batch) -> bytes:
    """The lines at ``results_url``."""
    lines = []
    for result in batch.results or ():
        kind = _anthropic_type(batch, result)
        member = {"succeeded": "message", "errored": "error"}.get(kind)
        body = {} if member is None else {member: result.body}
        lines.append({"custom_id": result.custom_id, "result": {"type": kind, **body}})
    return _jsonl(lines)


def _anthropic_type(batch: Batch, result: Result) -> str:
    if result.status is None:
        return "expired" if batch.cancelled_s is None else "canceled"
    return "succeeded" if result.status == 200 else "errored"


def gemini_batch(batch: Batch, now_s: float) -> dict[str, Any]:
    """A long-running operation."""
    results = batch.results or []
    answered = sum(result.status == 200 for result in results)
    failed = sum(result.status not in (200, None) for result in results)
    pending = 0 if batch.ended else len(batch.lines) - batch.finished(now_s)
    stats = {
        "requestCount": len(batch.lines),
        "successfulRequestCount": answered,
        "failedRequestCount": failed,
        "pendingRequestCount": pending,
    }
    metadata = {
        "@type": "type.googleapis.com/google.ai.generativelanguage.v1main.GenerateContentBatch",
        "name": f"batches/{batch.id}",
        "model": f"models/{batch.details['model']}",
        "displayName": batch.name,
        "createTime": _rfc3339(batch.began_s),
        "updateTime": _rfc3339(now_s),
        # 64-bit numbers are texts in JSON of protobuf, and a 0 is left out.
        "batchStats": {name: str(count) for name, count in stats.items() if count},
        "state": f"BATCH_STATE_{_gemini_state(batch)}",
    }
    operation = {"name": f"batches/{batch.id}", "metadata": metadata}
    if not batch.ended:
        return marked(operation)
    output = _gemini_output(batch)
    metadata |= {"endTime": _rfc3339(batch.due_s), "output": output}
    return marked({**operation, "done": True, "response": output})


def _gemini_state(batch: Batch) -> str:
    if not batch.ended:
        return "PENDING" if batch.polls < 2 else "RUNNING"
    if batch.cancelled_s is not None:
        return "CANCELLED"
    return "EXPIRED" if _not_asked(batch) == len(batch.lines) else "SUCCEEDED"


def _gemini_output(batch: Batch) -> dict[str, Any]:
    if batch.details["from_file"]:
        return {"responsesFile": f"files/batch-{batch.id}"}
    by_id = {result.custom_id: result for result in batch.results or ()}
    # Inline results come in the order of the requests.
    ordered = (by_id[line.custom_id or ""] for line in batch.lines)
    responses = [
        {**_gemini_result(result), "metadata": {"key": result.custom_id}}
        for result in ordered
        if result.status is not None
    ]
    return {"inlinedResponses": {"inlinedResponses": responses}}


def gemini_results(batch: Batch) -> bytes:
    """The file of responses; a line that was not asked has none."""
    return _jsonl(
        [
            {"key": result.custom_id, **_gemini_result(result)}
            for result in batch.results or ()
            if result.status is not None
        ]
    )


def _gemini_result(result: Result) -> dict[str, Any]:
    if result.status == 200 or result.status is None or result.body is None:
        return {"response": result.body}
    error = result.body["error"]
    return {"error": {"code": GRPC_CODES[result.status], "message": error["message"]}}


def _not_asked(batch: Batch) -> int:
    return sum(result.status is None for result in batch.results or ())


def _jsonl(lines: Sequence[dict[str, Any]]) -> bytes:
    return b"".join(json.dumps(line, ensure_ascii=False).encode() + b"\n" for line in lines)


def _rfc3339(moment_s: float) -> str:
    return datetime.fromtimestamp(moment_s, UTC).isoformat().replace("+00:00", "Z")
