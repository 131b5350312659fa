"""The batch modes of three providers, on the clock: what their clients ask for."""

import email
import json
import time
from collections import Counter
from dataclasses import dataclass, field
from datetime import UTC, datetime
from email.policy import HTTP
from functools import partial
from typing import NamedTuple

import httpx

from merge_runner.chance import draw, draw_between, draw_index
from merge_runner.emulator.handler import (
    CHAT,
    GEMINI,
    MESSAGES,
    RESPONSES,
    UNREADABLE,
    ReceivedRequest,
    as_json,
    as_response,
)
from merge_runner.errors import UsageError
from merge_runner.records import ATTEMPT_HEADER, SCRIPTED_FIELD, SLOT_HEADER, canonical_json
from tests.support.mock_server.faults import as_error, error_body

ID = "(?P<name>[^/]+?)"
FAILURES = (429, 500, 503)
GRPC_CODES = {400: 3, 429: 8, 500: 13, 503: 14}


class NotThere(Exception):
    """There is no such batch or file, or not yet."""


class BrokenOff(httpx.ReadError):
    """The connection ends before, or within, the response; its text says how."""


class Line(NamedTuple):
    """A request within a batch, and when and how it ends: answered, failed or not asked."""

    custom_id: str
    asked: ReceivedRequest
    after_s: float
    kind: str


class Result(NamedTuple):
    """A status and a body as the plain endpoint would reply; 0 for a line that was not asked."""

    custom_id: str
    status: int
    body: dict


@dataclass(eq=False)
class Batch:
    """Lines that were submitted together; ``told`` is the body of its creation.

    ``refused`` says why the lines are not asked at all. ``results`` are there once it has ended,
    in the order in which they came.
    """

    id: str
    told: dict
    lines: list[Line]
    began_s: float = field(default_factory=time.time)
    refused: str = ""
    polls: int = 0
    results: list[Result] | None = None

    @property
    def tokens(self):
        """About how many tokens its requests have."""
        return sum(len(line.asked.raw) for line in self.lines) // 4

    @property
    def counts(self):
        """How many lines were answered, failed, and were not asked."""
        statuses = [result.status for result in self.results or ()]
        return statuses.count(200), sum(s not in (0, 200) for s in statuses), statuses.count(0)


class Batches:
    """All batches and uploaded files of all providers, the oldest first."""

    def __init__(self, emulator):
        self._emulator, self.plan = emulator, emulator.plan.batch
        self._seed = emulator.plan.seed
        self.files, self._all = {}, {}
        self.requests = Counter()

    def create(self, prefix, asked, told):
        """Create a batch, which is ``refused`` where more tokens would wait than may."""
        batch_id = f"{prefix}{draw_index(2**40, 'batch', self._seed, len(self._all)):010x}"
        batch = Batch(batch_id, told, [self._line(*each) for each in asked.items()])
        self.settle()
        waiting = sum(each.tokens for each in self._all.values() if each.results is None)
        limit = self.plan.enqueued_tokens
        if limit is not None and waiting + batch.tokens > limit:
            batch.refused = f"Enqueued token limit reached. Limit: {limit:,} enqueued tokens."
            batch.results = []
        self._all[batch_id] = batch
        return batch

    def listed(self, prefix):
        """All of a provider's, the newest first."""
        self.settle()
        return [batch for batch in self._all.values() if batch.id.startswith(prefix)][::-1]

    def poll(self, batch_id):
        """A batch whose state is asked for; raises NotThere."""
        if batch_id not in self._all:
            raise NotThere
        self.settle()
        self._all[batch_id].polls += 1
        return self._all[batch_id]

    def settle(self):
        """Make the results of all batches that are due."""
        for batch in self._all.values():
            latest_s = batch.began_s + max(line.after_s for line in batch.lines)
            if batch.results is None and latest_s <= time.time() and batch.polls >= self.plan.polls:
                in_order = sorted(batch.lines, key=lambda line: line.after_s)
                batch.results = [self._result(line) for line in in_order]

    def shown(self, name, lines):
        """What is there of a file of results; raises NotThere."""
        self.requests[name] += 1
        if self.requests[name] <= self.plan.late_results:
            raise NotThere
        if self.requests[name] <= self.plan.late_results + self.plan.short_results:
            lines = lines[: len(lines) // 2]
        body = b"".join(json.dumps(line, ensure_ascii=False).encode() + b"\n" for line in lines)
        return as_response(body, 200, {"content-type": "application/octet-stream"})

    def break_off(self):
        """Lose the answer to a creation, as planned."""
        self.requests["created"] += 1
        if draw("lost", self._seed, self.requests["created"]) < self.plan.lost:
            raise BrokenOff("lost")

    def keep(self, content):
        """Keep the lines of an uploaded file; returns its id."""
        name = f"file-{len(self.files):06x}"
        self.files[name] = [json.loads(line) for line in content.splitlines()]
        return name

    def _line(self, custom_id, asked):
        """Its end is a function of the seed, the request, and how often it was submitted."""
        plan = self.plan
        self.requests[asked.where] += 1
        what = (self._seed, asked.where, self.requests[asked.where])
        chance = draw("line", *what)
        if plan.failed <= chance < plan.failed + plan.expired:
            return Line(custom_id, asked, plan.delay_s, "not asked")
        after_s = plan.delay_s * draw_between(0.2, 1.0, "when", *what)
        return Line(custom_id, asked, after_s, "failed" if chance < plan.failed else "answered")

    def _result(self, line):
        asked, custom_id = line.asked, line.custom_id
        if line.kind == "not asked":
            return Result(custom_id, 0, {})
        if line.kind == "failed":
            status = FAILURES[draw_index(3, "failure", self._seed, asked.where)]
            return Result(custom_id, status, error_body(asked.wire, status, "An emulated fault."))
        try:
            attempt = self._emulator.attempt(asked)
            fault = self._emulator.plan.fault(asked.where, attempt)
            fault = fault if fault in ("empty", "malformed") else None
            return Result(custom_id, 200, self._emulator.answer(asked, attempt, fault, custom_id))
        except UsageError as exc:
            return Result(custom_id, 400, error_body(asked.wire, 400, str(exc)))


class BatchMode:
    """A provider's batch mode: its addresses, and how it puts what it says.

    ``creation``, ``uploads`` and ``results`` are patterns of paths. A line has its id as ``key``,
    its request as ``body``; queries for a page of the list are ``cursor`` and ``size``. A mode has
    ``asked``, the requests of a new batch, ``shown``, its state as told, and ``line``, of results.
    """

    uploads = ()
    key, body = "custom_id", "body"
    cursor, size = "after", "limit"

    def __init__(self, batches):
        self._batches = batches

    def routes(self):
        """The method, the pattern of paths and the handler of each address."""
        handlers = [
            ("POST", self.creation, self._create),
            ("GET", self.path, self._list),
            ("GET", f"{self.path}/{ID}", self._status),
            ("GET", self.results, self._results),
        ]
        handlers += [("POST", path, self.upload) for path in self.uploads]
        return [(method, path, partial(self._guarded, each)) for method, path, each in handlers]

    def page(self, batches, more):
        """A page of the list."""
        last = batches[-1].id if batches else None
        return {"data": [self.shown(batch) for batch in batches], "has_more": more, "last_id": last}

    def _guarded(self, handler, request, **named):
        """Answer with errors in the provider's form, and else with JSON that no model made."""
        try:
            told = handler(request, **named)
        except NotThere:
            return as_error(self.wire, 404, "There is no such thing.")
        except UNREADABLE:
            return as_error(self.wire, 400, "The body is not valid.")
        return as_json({**told, SCRIPTED_FIELD: True}) if isinstance(told, dict) else told

    def _create(self, request, model=None):
        told = json.loads(request.content)
        batch = self._batches.create(self.prefix, self.asked(told, model), told)
        if batch.refused and self.wire is not CHAT:
            return as_error(self.wire, 429, batch.refused)
        self._batches.break_off()
        return self.shown(batch)

    def _list(self, request):
        batches = self._batches.listed(self.prefix)
        after = request.url.params.get(self.cursor)
        start = [batch.id for batch in batches].index(after) + 1 if after else 0
        end = start + int(request.url.params.get(self.size, 20))
        return self.page(batches[start:end], len(batches) > end)

    def _status(self, request, name):
        return self.shown(self._batches.poll(name))

    def _results(self, request, name):
        """Show a file of results, whose name holds the id of its batch."""
        batch_id, _, part = name.removeprefix("file-").partition("-")
        batch = self._batches.poll(batch_id)
        if batch.results is None:
            raise NotThere
        lines = [self.line(result, part) for result in batch.results]
        return self._batches.shown(name, [line for line in lines if line])

    def _read(self, lines, wire, path, model=None):
        """Lines as the requests that they stand for, by their ids, in canonical JSON like ours."""
        asked = {}
        for line in lines:
            slot, attempt = line.get(SLOT_HEADER), str(line.get(ATTEMPT_HEADER, ""))
            raw = canonical_json(line[self.body]).encode()
            where = None if slot is None else canonical_json(slot)
            asked[line[self.key]] = ReceivedRequest(wire, path, raw, model, where, attempt)
        if len(asked) < max(len(lines), 1):
            raise ValueError("A batch needs lines, each of another id.")
        return asked


class OpenAIMode(BatchMode):
    """``/v1/files`` and ``/v1/batches``."""

    wire, prefix, path = CHAT, "batch_", "/v1/batches"
    creation, uploads, results = path, ["/v1/files"], f"/v1/files/{ID}/content"

    def asked(self, told, model):
        endpoint = told["endpoint"]
        lines = self._batches.files[told["input_file_id"]]
        if told["completion_window"] != "24h" or any(line["url"] != endpoint for line in lines):
            raise ValueError("A line is for another endpoint, or the completion_window is not 24h.")
        wire = {each.path: each for each in (CHAT, RESPONSES)}[endpoint]
        return self._read(lines, wire, endpoint)

    def shown(self, batch):
        answered, *others = batch.counts
        failed = sum(others)
        status = "failed" if batch.refused else "in_progress"
        if batch.results:
            status = "expired" if others[1] else "completed"
        error = {"code": "token_limit_exceeded", "message": batch.refused}
        return {
            "id": batch.id,
            "object": "batch",
            **batch.told,
            "errors": {"data": [error]} if batch.refused else None,
            "status": status,
            "output_file_id": f"file-{batch.id}-output" if answered else None,
            "error_file_id": f"file-{batch.id}-error" if failed else None,
            "created_at": int(batch.began_s),
            "request_counts": {"total": len(batch.lines), "completed": answered, "failed": failed},
        }

    def upload(self, request):
        head = f"content-type: {request.headers.get('content-type', '')}\r\n\r\n".encode()
        form = {
            part.get_param("name", header="content-disposition"): part.get_payload(decode=True)
            for part in email.message_from_bytes(head + request.content, policy=HTTP).iter_parts()
        }
        if form["purpose"] != b"batch":
            raise ValueError("The purpose is batch.")
        return {"id": self._batches.keep(form["file"]), "object": "file"}

    def line(self, result, part):
        if (result.status == 200) != (part == "output"):
            return None
        line = {"custom_id": result.custom_id, "response": None, "error": None}
        if result.status:
            return line | {"response": {"status_code": result.status, "body": result.body}}
        return line | {"error": {"code": "batch_expired", "message": "Not executed."}}


class AnthropicMode(BatchMode):
    """``/v1/messages/batches``."""

    wire, prefix, path = MESSAGES, "msgbatch_", "/v1/messages/batches"
    creation, results = path, f"{path}/{ID}/results"
    body, cursor = "params", "after_id"

    def asked(self, told, model):
        return self._read(told["requests"], MESSAGES, MESSAGES.path)

    def shown(self, batch):
        ended = batch.results is not None
        counts = zip(("succeeded", "errored", "expired"), batch.counts, strict=True)
        return {
            "id": batch.id,
            "type": "message_batch",
            "processing_status": "ended" if ended else "in_progress",
            "request_counts": {"processing": 0 if ended else len(batch.lines), **dict(counts)},
            "created_at": _rfc3339(batch.began_s),
            "results_url": f"{self.path}/{batch.id}/results" if ended else None,
        }

    def line(self, result, part):
        told = {"type": "errored", "error": result.body}
        if result.status == 200:
            told = {"type": "succeeded", "message": result.body}
        elif result.status == 0:
            told = {"type": "expired"}
        return {"custom_id": result.custom_id, "result": told}


class GeminiMode(BatchMode):
    """``models/MODEL:batchGenerateContent`` and ``batches``, with requests and results in files."""

    wire, prefix, path = GEMINI, "g", "/v1beta/batches"
    creation = "/v1beta/models/(?P<model>[^/]+?):batchGenerateContent"
    uploads, results = ["/upload/v1beta/files"], f"/v1beta/files/{ID}:download"
    key, body = "key", "request"
    cursor, size = "pageToken", "pageSize"

    def asked(self, told, model):
        name = told["batch"]["inputConfig"]["fileName"].removeprefix("files/")
        path = f"/v1beta/models/{model}:generateContent"
        return self._read(self._batches.files[name], GEMINI, path, model)

    def shown(self, batch):
        answered, failed, _ = batch.counts
        ended = batch.results is not None
        state = "PENDING" if batch.polls < 2 else "RUNNING"
        if ended:
            state = "SUCCEEDED" if answered or failed else "EXPIRED"
        stats = {
            "requestCount": len(batch.lines),
            "successfulRequestCount": answered,
            "failedRequestCount": failed,
            "pendingRequestCount": 0 if ended else len(batch.lines),
        }
        metadata = {
            "displayName": batch.told["batch"]["displayName"],
            "createTime": _rfc3339(batch.began_s),
            # 64-bit numbers are texts in JSON of protobuf, and a 0 is left out.
            "batchStats": {name: str(count) for name, count in stats.items() if count},
            "state": f"BATCH_STATE_{state}",
        }
        operation = {"name": f"batches/{batch.id}", "metadata": metadata}
        if ended:
            metadata["output"] = {"responsesFile": f"files/{batch.id}"}
            operation |= {"done": True, "response": metadata["output"]}
        return operation

    def page(self, batches, more):
        following = {"nextPageToken": batches[-1].id} if more else {}
        return {"operations": [self.shown(batch) for batch in batches], **following}

    def upload(self, request):
        """A resumable upload: it is announced, and then sent whole."""
        told, headers = {}, {"x-goog-upload-status": "active"}
        if request.headers.get("x-goog-upload-command") == "start":
            url = f"http://{request.headers['host']}{request.url.path}?upload_id=1"
            headers["x-goog-upload-url"] = url
        else:
            told = {"file": {"name": f"files/{self._batches.keep(request.content)}"}}
            headers["x-goog-upload-status"] = "final"
        response = as_json({**told, SCRIPTED_FIELD: True})
        response.headers.update(headers)
        return response

    def line(self, result, part):
        told = {"response": result.body}
        if result.status not in (0, 200):
            message = result.body["error"]["message"]
            told = {"error": {"code": GRPC_CODES[result.status], "message": message}}
        return {"key": result.custom_id, **told} if result.status else None


MODES = (OpenAIMode, AnthropicMode, GeminiMode)


def _rfc3339(moment_s):
    return datetime.fromtimestamp(moment_s, UTC).isoformat().replace("+00:00", "Z")
