"""The batch modes of three providers on the emulator's own clock: what their clients ask for."""

from __future__ import annotations

import email
import json
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from email.policy import HTTP
from functools import partial
from typing import TYPE_CHECKING, Any

import httpx

from merge_runner.chance import draw, draw_between, draw_index
from merge_runner.emulator.handler import (
    CHAT,
    GEMINI,
    MESSAGES,
    RESPONSES,
    UNREADABLE,
    Asked,
    ServedFormat,
    as_json,
    as_response,
)
from merge_runner.errors import UsageError
from merge_runner.records import ATTEMPT_HEADER, SCRIPTED_FIELD, SLOT_HEADER, canonical_json
from tests.support.mock_server.errors import ERRORS, as_error, error_body

if TYPE_CHECKING:
    from tests.support.mock_server.emulator import FaultyEmulator

ID = "(?P<name>[^/]+?)"
FAILURES = (429, 500, 503)
GRPC_CODES = {400: 3, 429: 8, 500: 13, 503: 14}
Handler = Callable[..., httpx.Response]


class NotThere(Exception):
    """There is no such batch or file, or not yet."""


class BrokenOff(httpx.ReadError):
    """The connection ends before, or within, the response; ``fault`` says how."""

    def __init__(self, fault: str) -> None:
        super().__init__(f"the emulator broke off: {fault}")
        self.fault = fault


@dataclass(frozen=True, slots=True)
class Line:
    """A request within a batch."""

    custom_id: str
    asked: Asked


@dataclass(frozen=True, slots=True)
class Fate:
    """When a line has its result, in seconds from the batch's beginning, and which.

    A line is ``answered``, ``failed`` or ``not asked``.
    """

    after_s: float
    kind: str


@dataclass(frozen=True, slots=True)
class Result:
    """A status and a body as the plain endpoint would reply; 0 for a line that was not asked."""

    custom_id: str
    status: int
    body: dict[str, Any]

    @property
    def kind(self) -> str:
        """What became of the line."""
        return "answered" if self.status == 200 else "failed" if self.status else "not asked"


@dataclass(slots=True, eq=False)
class Batch:
    """Lines that were submitted together; times are in seconds of the clock.

    ``told`` is the body of its creation. ``refused`` says why the lines are not asked at all.
    ``results`` are there once it has ended, in the order in which they came.
    """

    id: str
    told: dict[str, Any]
    lines: Sequence[Line]
    fates: Sequence[Fate]
    began_s: float
    least_polls: int
    refused: str = ""
    polls: int = 0
    cancelled_s: float | None = None
    results: list[Result] | None = None

    @property
    def tokens(self) -> int:
        """About how many tokens its requests have."""
        return sum(len(line.asked.raw) for line in self.lines) // 4

    def finished(self, now_s: float) -> int:
        """Return how many lines have their result by now."""
        until_s = now_s if self.cancelled_s is None else self.cancelled_s
        in_time = sum(self.began_s + fate.after_s <= until_s for fate in self.fates)
        if self.polls >= self.least_polls:
            return in_time
        return min(in_time, len(self.lines) * self.polls // self.least_polls)

    def count(self, *kinds: str) -> int:
        """Return how many lines ended so."""
        return sum(result.kind in kinds for result in self.results or ())

    @property
    def why_not(self) -> str:
        """Why lines were not asked."""
        return "expired" if self.cancelled_s is None else "cancelled"


class Batches:
    """All batches of all providers, the oldest first."""

    def __init__(self, emulator: FaultyEmulator, clock: Callable[[], float] = time.time) -> None:
        self._emulator = emulator
        self.faults = emulator.plan
        self.now_s = clock
        self.files: dict[str, bytes] = {}
        self.requests: Counter[str] = Counter()
        self._all: dict[str, Batch] = {}
        self._submitted: Counter[str] = Counter()

    def create(self, prefix: str, lines: Sequence[Line], told: dict[str, Any]) -> Batch:
        """Create a batch, which is ``refused`` where more tokens would wait than may."""
        if not lines or len({line.custom_id for line in lines}) < len(lines):
            raise UsageError("A batch needs lines, and every custom_id must be unique.")
        batch_id = f"{prefix}{draw_index(2**40, 'batch', self.faults.seed, len(self._all)):010x}"
        fates = [self._fate(line) for line in lines]
        plan = self.faults.batch
        batch = Batch(batch_id, told, lines, fates, self.now_s(), plan.polls)
        self.settle()
        waiting = sum(each.tokens for each in self._all.values() if each.results is None)
        if plan.enqueued_tokens is not None and waiting + batch.tokens > plan.enqueued_tokens:
            limit = f"{plan.enqueued_tokens:,} enqueued tokens"
            batch.refused, batch.results = f"Enqueued token limit reached. Limit: {limit}.", []
        self._all[batch_id] = batch
        return batch

    def listed(self, prefix: str) -> list[Batch]:
        """Return all of a provider's, as it lists them."""
        self.settle()
        own = [batch for batch in self._all.values() if batch.id.startswith(prefix)]
        return own if self.faults.batch.oldest_first else own[::-1]

    def poll(self, batch_id: str) -> Batch:
        """Return a batch whose state is asked for; raises NotThere."""
        if batch_id not in self._all:
            raise NotThere
        batch = self._all[batch_id]
        self._settle(batch)
        batch.polls += 1
        return batch

    def settle(self) -> None:
        """Let all batches end that are due."""
        for batch in self._all.values():
            self._settle(batch)

    def shown(self, name: str, lines: Sequence[dict[str, Any]]) -> httpx.Response:
        """Return what is there of a file of results; raises NotThere."""
        plan = self.faults.batch
        self.requests[name] += 1
        if self.requests[name] <= plan.late_results:
            raise NotThere
        if self.requests[name] <= plan.late_results + plan.short_results:
            lines = lines[: len(lines) // 2]
        body = b"".join(json.dumps(line, ensure_ascii=False).encode() + b"\n" for line in lines)
        return as_response(body, 200, {"content-type": "application/octet-stream"})

    def _fate(self, line: Line) -> Fate:
        """A function of the seed, the line, and how often it was submitted."""
        plan, seed = self.faults.batch, self.faults.seed
        where = line.asked.where
        self._submitted[where] += 1
        what = (seed, where, self._submitted[where])
        chance = draw("line", *what)
        after_s = plan.delay_s * draw_between(0.2, 1.0, "when", *what)
        if draw("slow", *what) < plan.slow:
            after_s *= plan.slow_factor
        if chance < plan.failed:
            return Fate(after_s, "failed")
        if chance < plan.failed + plan.expired:
            return Fate(plan.delay_s, "not asked")
        return Fate(after_s, "answered")

    def _settle(self, batch: Batch) -> None:
        """Make the results of a batch that is due, or was cancelled."""
        finished = batch.finished(self.now_s())
        if batch.results is not None or (finished < len(batch.lines) and batch.cancelled_s is None):
            return
        fates = sorted(zip(batch.fates, batch.lines, strict=True), key=lambda pair: pair[0].after_s)
        batch.results = [
            self._result(line, fate.kind if number < finished else "not asked")
            for number, (fate, line) in enumerate(fates)
        ]

    def _result(self, line: Line, kind: str) -> Result:
        asked = line.asked
        if kind == "not asked":
            return Result(line.custom_id, 0, {})
        status, message = 200, "An emulated fault."
        if kind == "failed":
            status = FAILURES[draw_index(3, "failure", self.faults.seed, asked.where)]
        else:
            attempt = self._emulator.attempt(asked)
            fault = self.faults.fault(asked.where, attempt)
            fault = fault if fault in ("empty", "refused", "malformed") else None
            try:
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
    queries ``cursor`` and ``size``.
    """

    wire: ServedFormat
    prefix: str
    path: str
    creation: str
    uploads = ""
    results: str
    key, body = "custom_id", "body"
    cursor, size = "after", "limit"

    def __init__(self, batches: Batches) -> None:
        self._batches = batches

    def routes(self) -> list[tuple[str, str, Handler]]:
        """The method, the pattern of paths and the handler of each address."""
        handlers = [
            ("POST", self.creation, self._create),
            ("POST", self.uploads, self._upload),
            ("GET", self.path, self._list),
            ("GET", f"{self.path}/{ID}", self._status),
            ("POST", f"{self.path}/{ID}[:/]cancel", self._cancel),
            ("GET", self.results, self._results),
        ]
        return [(method, path, partial(self._guarded, each)) for method, path, each in handlers]

    def lines(self, told: dict[str, Any], model: str | None) -> list[Line]:
        """The lines of a batch that is created; raises UsageError or what is UNREADABLE."""
        raise NotImplementedError

    def shown(self, batch: Batch) -> dict[str, Any]:
        """A batch as its state is told."""
        raise NotImplementedError

    def line(self, batch: Batch, result: Result, part: str) -> dict[str, Any] | None:
        """A line of results; None: it is in no such ``part`` of them."""
        raise NotImplementedError

    def page(self, batches: Sequence[Batch], more: bool) -> dict[str, Any]:
        """Return a page of the list."""
        last = batches[-1].id if batches else None
        return {"data": [self.shown(batch) for batch in batches], "has_more": more, "last_id": last}

    def _guarded(self, handler: Handler, request: httpx.Request, **named: str) -> httpx.Response:
        """Answer with the faults of a service, and with errors in the provider's form."""
        faults, requests = self._batches.faults, self._batches.requests
        where = f"{request.method} {request.url.path}"
        requests[where] += 1
        fault = faults.fault(where, requests[where])
        if fault == "rate_limit":
            return as_error(self.wire, 429, "Rate limit reached.", faults.delay_s)
        if fault in ERRORS:
            return as_error(self.wire, ERRORS[fault], "An emulated fault.")
        try:
            return handler(request, **named)
        except UsageError as exc:
            return as_error(self.wire, 400, str(exc))
        except NotThere:
            return as_error(self.wire, 404, "There is no such thing.")
        except UNREADABLE:
            return as_error(self.wire, 400, "The body is not valid.")

    def _create(self, request: httpx.Request, model: str | None = None) -> httpx.Response:
        told = json.loads(request.content)
        batch = self._batches.create(self.prefix, self.lines(told, model), told)
        if batch.refused and self.wire is not CHAT:
            return as_error(self.wire, 429, batch.refused)
        self._batches.requests["created"] += 1
        faults, number = self._batches.faults, self._batches.requests["created"]
        if draw("lost", faults.seed, number) < faults.batch.lost:
            raise BrokenOff("lost")  # the answer is lost on its way
        return as_json(self.shown(batch))

    def _list(self, request: httpx.Request) -> httpx.Response:
        batches = self._batches.listed(self.prefix)
        after = request.url.params.get(self.cursor)
        start = [batch.id for batch in batches].index(after) + 1 if after else 0
        end = start + int(request.url.params.get(self.size, 20))
        return as_json(self.page(batches[start:end], len(batches) > end))

    def _status(self, request: httpx.Request, name: str) -> httpx.Response:
        return as_json(self.shown(self._batches.poll(name)))

    def _cancel(self, request: httpx.Request, name: str) -> httpx.Response:
        batch = self._batches.poll(name)
        if batch.results is None and batch.cancelled_s is None:
            batch.cancelled_s = self._batches.now_s()  # it ends at the next look
        return as_json(self.shown(batch))

    def _results(self, request: httpx.Request, name: str) -> httpx.Response:
        """Show a file of results, whose name holds the id of its batch."""
        batch_id, _, part = name.removeprefix("file-").partition("-")
        batch = self._batches.poll(batch_id)
        if batch.results is None:
            raise NotThere
        lines = [self.line(batch, result, part) for result in batch.results]
        return self._batches.shown(name, [line for line in lines if line])

    def _upload(self, request: httpx.Request) -> httpx.Response:
        raise NotThere

    def _asked(
        self, line: dict[str, Any], wire: ServedFormat, path: str, model: str | None = None
    ) -> Line:
        """A line as the request that it stands for, in canonical JSON like one of our client."""
        slot, attempt = line.get(SLOT_HEADER), str(line.get(ATTEMPT_HEADER, ""))
        raw = canonical_json(line[self.body]).encode()
        where = None if slot is None else canonical_json(slot)
        return Line(line[self.key], Asked(wire, path, raw, model, where, attempt))

    def _file(self, content: bytes) -> str:
        """Keep an uploaded file; returns its id."""
        name = f"file-{len(self._batches.files):06x}"
        self._batches.files[name] = content
        return name

    def _uploaded(self, name: str) -> list[dict[str, Any]]:
        """Return the lines of an uploaded file; raises NotThere."""
        if name not in self._batches.files:
            raise NotThere
        return [json.loads(line) for line in self._batches.files[name].splitlines()]


class OpenAIMode(BatchMode):
    """``/v1/files`` and ``/v1/batches``."""

    wire, prefix, path = CHAT, "batch_", "/v1/batches"
    creation, uploads, results = path, "/v1/files", f"/v1/files/{ID}/content"

    def lines(self, told: dict[str, Any], model: str | None) -> list[Line]:
        endpoint = told["endpoint"]
        wire = {each.path: each for each in (CHAT, RESPONSES)}[endpoint]
        lines = self._uploaded(told["input_file_id"])
        if told["completion_window"] != "24h" or any(line["url"] != endpoint for line in lines):
            raise UsageError("A line is for another endpoint, or the completion_window is not 24h.")
        return [self._asked(line, wire, endpoint) for line in lines]

    def shown(self, batch: Batch) -> dict[str, Any]:
        ended, answered = batch.results is not None, batch.count("answered")
        failed = batch.count("failed", "not asked")
        status = "in_progress" if batch.cancelled_s is None else "cancelling"
        if batch.refused:
            status = "failed"
        elif ended:
            status = batch.why_not if batch.count("not asked") else "completed"
        error = {"code": "token_limit_exceeded", "message": batch.refused}
        counts = {
            "total": len(batch.lines),
            "completed": answered if ended else batch.finished(self._batches.now_s()),
            "failed": failed,
        }
        return _marked(
            {
                "id": batch.id,
                "object": "batch",
                **batch.told,
                "errors": {"data": [error]} if batch.refused else None,
                "status": status,
                "output_file_id": f"file-{batch.id}-output" if answered else None,
                "error_file_id": f"file-{batch.id}-error" if failed else None,
                "created_at": int(batch.began_s),
                "request_counts": counts,
            }
        )

    def _upload(self, request: httpx.Request) -> httpx.Response:
        head = f"content-type: {request.headers.get('content-type', '')}\r\n\r\n".encode()
        parts = email.message_from_bytes(head + request.content, policy=HTTP).iter_parts()
        form = {
            part.get_param("name", header="content-disposition"): part.get_payload(decode=True)
            for part in parts
        }
        if form.get("purpose") != b"batch" or "file" not in form:
            raise UsageError("A file and the purpose batch are needed.")
        return as_json(_marked({"id": self._file(form["file"]), "object": "file"}))

    def line(self, batch: Batch, result: Result, part: str) -> dict[str, Any] | None:
        if (result.kind == "answered") != (part == "output"):
            return None
        line: dict[str, Any] = {"custom_id": result.custom_id, "response": None, "error": None}
        if result.status:
            return line | {"response": {"status_code": result.status, "body": result.body}}
        return line | {"error": {"code": f"batch_{batch.why_not}", "message": "Not executed."}}


class AnthropicMode(BatchMode):
    """``/v1/messages/batches``."""

    wire, prefix, path = MESSAGES, "msgbatch_", "/v1/messages/batches"
    creation, results = path, f"{path}/{ID}/results"
    body, cursor = "params", "after_id"

    def lines(self, told: dict[str, Any], model: str | None) -> list[Line]:
        return [self._asked(line, MESSAGES, MESSAGES.path) for line in told["requests"]]

    def shown(self, batch: Batch) -> dict[str, Any]:
        ended, cancelled = batch.results is not None, batch.cancelled_s is not None
        counts = {
            "processing": 0 if ended else len(batch.lines),
            "succeeded": batch.count("answered"),
            "errored": batch.count("failed"),
            "canceled": batch.count("not asked") if cancelled else 0,
            "expired": 0 if cancelled else batch.count("not asked"),
        }
        going_on = "canceling" if cancelled else "in_progress"
        return _marked(
            {
                "id": batch.id,
                "type": "message_batch",
                "processing_status": "ended" if ended else going_on,
                "request_counts": counts,
                "created_at": _rfc3339(batch.began_s),
                "results_url": f"{self.path}/{batch.id}/results" if ended else None,
            }
        )

    def line(self, batch: Batch, result: Result, part: str) -> dict[str, Any] | None:
        told = {
            "answered": {"type": "succeeded", "message": result.body},
            "failed": {"type": "errored", "error": result.body},
            "not asked": {"type": "expired" if batch.cancelled_s is None else "canceled"},
        }
        return {"custom_id": result.custom_id, "result": told[result.kind]}


class GeminiMode(BatchMode):
    """``models/MODEL:batchGenerateContent`` and ``batches``, with requests and results in files."""

    wire, prefix, path = GEMINI, "g", "/v1beta/batches"
    creation = "/v1beta/models/(?P<model>[^/]+?):batchGenerateContent"
    uploads, results = "/upload/v1beta/files", f"/v1beta/files/{ID}:download"
    key, body = "key", "request"
    cursor, size = "pageToken", "pageSize"

    def lines(self, told: dict[str, Any], model: str | None) -> list[Line]:
        name = told["batch"]["inputConfig"]["fileName"].removeprefix("files/")
        path = f"/v1beta/models/{model}:generateContent"
        return [self._asked(line, GEMINI, path, model) for line in self._uploaded(name)]

    def shown(self, batch: Batch) -> dict[str, Any]:
        ended = batch.results is not None
        state = "PENDING" if batch.polls < 2 else "RUNNING"
        if ended:
            state = "SUCCEEDED" if batch.count("answered", "failed") else "EXPIRED"
        if ended and batch.cancelled_s is not None:
            state = "CANCELLED"
        done = len(batch.lines) if ended else batch.finished(self._batches.now_s())
        stats = {
            "requestCount": len(batch.lines),
            "successfulRequestCount": batch.count("answered"),
            "failedRequestCount": batch.count("failed"),
            "pendingRequestCount": len(batch.lines) - done,
        }
        metadata = {
            "displayName": batch.told["batch"]["displayName"],
            "createTime": _rfc3339(batch.began_s),
            # 64-bit numbers are texts in JSON of protobuf, and a 0 is left out.
            "batchStats": {name: str(count) for name, count in stats.items() if count},
            "state": f"BATCH_STATE_{state}",
        }
        operation: dict[str, Any] = {"name": f"batches/{batch.id}", "metadata": metadata}
        if ended:
            output = {"responsesFile": f"files/{batch.id}"}
            metadata["output"] = output
            operation |= {"done": True, "response": output}
        return _marked(operation)

    def page(self, batches: Sequence[Batch], more: bool) -> dict[str, Any]:
        following = {"nextPageToken": batches[-1].id} if more else {}
        return {"operations": [self.shown(batch) for batch in batches], **following}

    def _upload(self, request: httpx.Request) -> httpx.Response:
        """A resumable upload: it is announced, and then sent whole."""
        if request.headers.get("x-goog-upload-command") == "start":
            url = f"http://{request.headers['host']}{request.url.path}?upload_id=1"
            headers = {"x-goog-upload-url": url, "x-goog-upload-status": "active"}
            response = as_json(_marked({}))
            response.headers.update(headers)
            return response
        content = request.content
        file = {"name": f"files/{self._file(content)}", "sizeBytes": str(len(content))}
        response = as_json(_marked({"file": file}))
        response.headers["x-goog-upload-status"] = "final"
        return response

    def line(self, batch: Batch, result: Result, part: str) -> dict[str, Any] | None:
        if result.kind == "not asked":
            return None
        if result.kind == "answered":
            return {"key": result.custom_id, "response": result.body}
        message = result.body["error"]["message"]
        error = {"code": GRPC_CODES[result.status], "message": message}
        return {"key": result.custom_id, "error": error}


MODES = (OpenAIMode, AnthropicMode, GeminiMode)


def _marked(body: dict[str, Any]) -> dict[str, Any]:
    """A body with the field that says that no model made it."""
    return {**body, SCRIPTED_FIELD: True}


def _rfc3339(moment_s: float) -> str:
    return datetime.fromtimestamp(moment_s, UTC).isoformat().replace("+00:00", "Z")
