"""The batch modes of three providers, on the clock: what their clients ask for."""

import email
import json
import time
from collections import Counter
from dataclasses import dataclass, field
from datetime import UTC, datetime
from email.policy import HTTP
from functools import partial

import httpx

from merge_runner.chance import draw, draw_between, draw_index
from merge_runner.emulator.handler import (
    CHAT,
    GEMINI,
    MESSAGES,
    RESPONSES,
    UNREADABLE,
    Asked,
    as_json,
    as_response,
)
from merge_runner.errors import UsageError
from merge_runner.records import ATTEMPT_HEADER, SCRIPTED_FIELD, SLOT_HEADER, canonical_json
from tests.support.mock_server.errors import as_error, error_body

ID = "(?P<name>[^/]+?)"
FAILURES = (429, 500, 503)
GRPC_CODES = {400: 3, 429: 8, 500: 13, 503: 14}


class NotThere(Exception):
    """There is no such batch or file, or not yet."""


class BrokenOff(httpx.ReadError):
    """The connection ends before, or within, the response; ``fault`` says how."""

    def __init__(self, fault: str) -> None:
        super().__init__(f"the emulator broke off: {fault}")
        self.fault = fault


@dataclass(frozen=True, slots=True)
class Line:
    """A request within a batch, and when and how it ends: answered, failed or not asked."""

    custom_id: str
    asked: Asked
    after_s: float
    kind: str


@dataclass(frozen=True, slots=True)
class Result:
    """A status and a body as the plain endpoint would reply; 0 for a line that was not asked."""

    custom_id: str
    status: int
    body: dict


@dataclass(slots=True, eq=False)
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
    def tokens(self) -> int:
        """About how many tokens its requests have."""
        return sum(len(line.asked.raw) for line in self.lines) // 4

    @property
    def counts(self) -> tuple[int, int, int]:
        """How many lines were answered, failed, and were not asked."""
        statuses = [result.status for result in self.results or ()]
        return statuses.count(200), sum(s not in (0, 200) for s in statuses), statuses.count(0)


class Batches:
    """All batches of all providers, the oldest first."""

    def __init__(self, emulator) -> None:
        self._emulator = emulator
        self._seed = emulator.plan.seed
        self.plan = emulator.plan.batch
        self.files: dict[str, bytes] = {}
        self.requests: Counter[str] = Counter()
        self._all: dict[str, Batch] = {}

    def create(self, prefix: str, asked: dict[str, Asked], told: dict) -> Batch:
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

    def listed(self, prefix: str) -> list[Batch]:
        """Return all of a provider's, as it lists them."""
        self.settle()
        own = [batch for batch in self._all.values() if batch.id.startswith(prefix)]
        return own if self.plan.oldest_first else own[::-1]

    def poll(self, batch_id: str) -> Batch:
        """Return a batch whose state is asked for; raises NotThere."""
        if batch_id not in self._all:
            raise NotThere
        self.settle()
        self._all[batch_id].polls += 1
        return self._all[batch_id]

    def settle(self) -> None:
        """Make the results of all batches that are due."""
        for batch in self._all.values():
            latest_s = batch.began_s + max(line.after_s for line in batch.lines)
            if batch.results is None and latest_s <= time.time() and batch.polls >= self.plan.polls:
                in_order = sorted(batch.lines, key=lambda line: line.after_s)
                batch.results = [self._result(line) for line in in_order]

    def shown(self, name: str, lines: list[dict]) -> httpx.Response:
        """Return what is there of a file of results; raises NotThere."""
        self.requests[name] += 1
        if self.requests[name] <= self.plan.late_results:
            raise NotThere
        if self.requests[name] <= self.plan.late_results + self.plan.short_results:
            lines = lines[: len(lines) // 2]
        body = b"".join(json.dumps(line, ensure_ascii=False).encode() + b"\n" for line in lines)
        return as_response(body, 200, {"content-type": "application/octet-stream"})

    def is_lost(self) -> bool:
        """Whether the answer to this creation is lost."""
        self.requests["created"] += 1
        return draw("lost", self._seed, self.requests["created"]) < self.plan.lost

    def _line(self, custom_id: str, asked: Asked) -> Line:
        """Its end is a function of the seed, the request, and how often it was submitted."""
        plan = self.plan
        self.requests[asked.where] += 1
        what = (self._seed, asked.where, self.requests[asked.where])
        chance = draw("line", *what)
        after_s = plan.delay_s * draw_between(0.2, 1.0, "when", *what)
        if plan.failed <= chance < plan.failed + plan.expired:
            return Line(custom_id, asked, plan.delay_s, "not asked")
        return Line(custom_id, asked, after_s, "failed" if chance < plan.failed else "answered")

    def _result(self, line: Line) -> Result:
        asked = line.asked
        if line.kind == "not asked":
            return Result(line.custom_id, 0, {})
        status, message = 200, "An emulated fault."
        if line.kind == "failed":
            status = FAILURES[draw_index(3, "failure", self._seed, asked.where)]
        else:
            try:
                attempt = self._emulator.attempt(asked)
                fault = self._emulator.plan.fault(asked.where, attempt)
                fault = fault if fault in ("empty", "malformed") else None
                body = self._emulator.answer(asked, attempt, fault, line.custom_id)
            except UsageError as exc:
                status, message = 400, str(exc)
        if status != 200:
            body = error_body(asked.wire, status, message)
        return Result(line.custom_id, status, body)


class BatchMode:
    """A provider's batch mode: its addresses, and how it puts what it says.

    Its batches are at ``path``. ``creation``, ``uploads`` and ``results`` are patterns of paths. A
    line has its id as ``key`` and its request as ``body``. A page of the list is asked for by the
    queries ``cursor`` and ``size``. A mode has the methods ``asked``, the requests of a batch that
    is created, ``shown``, a batch as its state is told, and ``line``, one of results or None.
    """

    uploads = "/none"
    key, body = "custom_id", "body"
    cursor, size = "after", "limit"

    def __init__(self, batches: Batches) -> None:
        self._batches = batches

    def routes(self):
        """The method, the pattern of paths and the handler of each address."""
        handlers = [
            ("POST", self.creation, self._create),
            ("POST", self.uploads, self._upload),
            ("GET", self.path, self._list),
            ("GET", f"{self.path}/{ID}", self._status),
            ("GET", self.results, self._results),
        ]
        return [(method, path, partial(self._guarded, each)) for method, path, each in handlers]

    def page(self, batches: list[Batch], more: bool) -> dict:
        """Return a page of the list."""
        last = batches[-1].id if batches else None
        return {"data": [self.shown(batch) for batch in batches], "has_more": more, "last_id": last}

    def _guarded(self, handler, request: httpx.Request, **named: str) -> httpx.Response:
        """Answer with errors in the provider's form."""
        try:
            return handler(request, **named)
        except NotThere:
            return as_error(self.wire, 404, "There is no such thing.")
        except UNREADABLE:
            return as_error(self.wire, 400, "The body is not valid.")

    def _create(self, request: httpx.Request, model: str | None = None) -> httpx.Response:
        told = json.loads(request.content)
        batch = self._batches.create(self.prefix, self.asked(told, model), told)
        if batch.refused and self.wire is not CHAT:
            return as_error(self.wire, 429, batch.refused)
        if self._batches.is_lost():
            raise BrokenOff("lost")
        return _marked(self.shown(batch))

    def _list(self, request: httpx.Request) -> httpx.Response:
        batches = self._batches.listed(self.prefix)
        after = request.url.params.get(self.cursor)
        start = [batch.id for batch in batches].index(after) + 1 if after else 0
        end = start + int(request.url.params.get(self.size, 20))
        return _marked(self.page(batches[start:end], len(batches) > end))

    def _status(self, request: httpx.Request, name: str) -> httpx.Response:
        return _marked(self.shown(self._batches.poll(name)))

    def _results(self, request: httpx.Request, name: str) -> httpx.Response:
        """Show a file of results, whose name holds the id of its batch."""
        batch_id, _, part = name.removeprefix("file-").partition("-")
        batch = self._batches.poll(batch_id)
        if batch.results is None:
            raise NotThere
        lines = [self.line(result, part) for result in batch.results]
        return self._batches.shown(name, [line for line in lines if line])

    def _upload(self, request: httpx.Request) -> httpx.Response:
        raise NotThere

    def _read(self, lines: list[dict], wire, path: str, model: str | None = None):
        """Lines as the requests that they stand for, by their ids, in canonical JSON like ours."""
        asked = {}
        for line in lines:
            slot, attempt = line.get(SLOT_HEADER), str(line.get(ATTEMPT_HEADER, ""))
            raw = canonical_json(line[self.body]).encode()
            where = None if slot is None else canonical_json(slot)
            asked[line[self.key]] = Asked(wire, path, raw, model, where, attempt)
        if len(asked) < max(len(lines), 1):
            raise ValueError("A batch needs lines, each of another id.")
        return asked

    def _kept(self, content: bytes) -> str:
        """Keep an uploaded file; returns its id."""
        name = f"file-{len(self._batches.files):06x}"
        self._batches.files[name] = content
        return name

    def _uploaded(self, name: str) -> list[dict]:
        """Return the lines of an uploaded file."""
        return [json.loads(line) for line in self._batches.files[name].splitlines()]


class OpenAIMode(BatchMode):
    """``/v1/files`` and ``/v1/batches``."""

    wire, prefix, path = CHAT, "batch_", "/v1/batches"
    creation, uploads, results = path, "/v1/files", f"/v1/files/{ID}/content"

    def asked(self, told, model):
        endpoint = told["endpoint"]
        wire = {each.path: each for each in (CHAT, RESPONSES)}[endpoint]
        lines = self._uploaded(told["input_file_id"])
        if told["completion_window"] != "24h" or any(line["url"] != endpoint for line in lines):
            raise ValueError("A line is for another endpoint, or the completion_window is not 24h.")
        return self._read(lines, wire, endpoint)

    def shown(self, batch: Batch) -> dict:
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

    def _upload(self, request: httpx.Request) -> httpx.Response:
        head = f"content-type: {request.headers.get('content-type', '')}\r\n\r\n".encode()
        parts = email.message_from_bytes(head + request.content, policy=HTTP).iter_parts()
        form = {
            part.get_param("name", header="content-disposition"): part.get_payload(decode=True)
            for part in parts
        }
        if form["purpose"] != b"batch":
            raise ValueError("The purpose is batch.")
        return _marked({"id": self._kept(form["file"]), "object": "file"})

    def line(self, result: Result, part: str) -> dict | None:
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

    def shown(self, batch: Batch) -> dict:
        ended = batch.results is not None
        names = ("succeeded", "errored", "expired")
        counts = {"processing": 0 if ended else len(batch.lines)}
        counts |= zip(names, batch.counts, strict=True)
        return {
            "id": batch.id,
            "type": "message_batch",
            "processing_status": "ended" if ended else "in_progress",
            "request_counts": counts,
            "created_at": _rfc3339(batch.began_s),
            "results_url": f"{self.path}/{batch.id}/results" if ended else None,
        }

    def line(self, result: Result, part: str) -> dict:
        told = {"type": "succeeded", "message": result.body}
        if result.status == 0:
            told = {"type": "expired"}
        elif result.status != 200:
            told = {"type": "errored", "error": result.body}
        return {"custom_id": result.custom_id, "result": told}


class GeminiMode(BatchMode):
    """``models/MODEL:batchGenerateContent`` and ``batches``, with requests and results in files."""

    wire, prefix, path = GEMINI, "g", "/v1beta/batches"
    creation = "/v1beta/models/(?P<model>[^/]+?):batchGenerateContent"
    uploads, results = "/upload/v1beta/files", f"/v1beta/files/{ID}:download"
    key, body = "key", "request"
    cursor, size = "pageToken", "pageSize"

    def asked(self, told, model):
        name = told["batch"]["inputConfig"]["fileName"].removeprefix("files/")
        path = f"/v1beta/models/{model}:generateContent"
        return self._read(self._uploaded(name), GEMINI, path, model)

    def shown(self, batch: Batch) -> dict:
        answered, failed, _ = batch.counts
        state = "PENDING" if batch.polls < 2 else "RUNNING"
        if batch.results is not None:
            state = "SUCCEEDED" if answered or failed else "EXPIRED"
        stats = {
            "requestCount": len(batch.lines),
            "successfulRequestCount": answered,
            "failedRequestCount": failed,
            "pendingRequestCount": 0 if batch.results is not None else len(batch.lines),
        }
        metadata = {
            "displayName": batch.told["batch"]["displayName"],
            "createTime": _rfc3339(batch.began_s),
            # 64-bit numbers are texts in JSON of protobuf, and a 0 is left out.
            "batchStats": {name: str(count) for name, count in stats.items() if count},
            "state": f"BATCH_STATE_{state}",
        }
        operation = {"name": f"batches/{batch.id}", "metadata": metadata}
        if batch.results is not None:
            metadata["output"] = {"responsesFile": f"files/{batch.id}"}
            operation |= {"done": True, "response": metadata["output"]}
        return operation

    def page(self, batches: list[Batch], more: bool) -> dict:
        following = {"nextPageToken": batches[-1].id} if more else {}
        return {"operations": [self.shown(batch) for batch in batches], **following}

    def _upload(self, request: httpx.Request) -> httpx.Response:
        """A resumable upload: it is announced, and then sent whole."""
        if request.headers.get("x-goog-upload-command") == "start":
            response = _marked({})
            url = f"http://{request.headers['host']}{request.url.path}?upload_id=1"
            response.headers.update({"x-goog-upload-url": url, "x-goog-upload-status": "active"})
            return response
        response = _marked({"file": {"name": f"files/{self._kept(request.content)}"}})
        response.headers["x-goog-upload-status"] = "final"
        return response

    def line(self, result: Result, part: str) -> dict | None:
        if result.status == 0:
            return None
        if result.status == 200:
            return {"key": result.custom_id, "response": result.body}
        message = result.body["error"]["message"]
        error = {"code": GRPC_CODES[result.status], "message": message}
        return {"key": result.custom_id, "error": error}


def _marked(body: dict) -> httpx.Response:
    """JSON with the field that says that no model made it."""
    return as_json({**body, SCRIPTED_FIELD: True})


MODES = (OpenAIMode, AnthropicMode, GeminiMode)


def _rfc3339(moment_s: float) -> str:
    return datetime.fromtimestamp(moment_s, UTC).isoformat().replace("+00:00", "Z")
