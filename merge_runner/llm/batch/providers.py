"""The batch modes of three providers, and which models have one on what terms."""

from __future__ import annotations

import json
import re
from abc import ABC, abstractmethod
from collections.abc import AsyncIterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal
from urllib.parse import quote, urlsplit
from uuid import uuid4

from merge_runner.errors import MergeRunnerError
from merge_runner.llm.formats import (
    ServerError,
    WireFormat,
    as_count,
    as_dict,
    as_dicts,
    as_text,
    at,
    read_error,
)
from merge_runner.llm.http_outcome import (
    RawReply,
    TransportFailure,
    judge_error,
    may_be_charged,
    status_within,
)
from merge_runner.providers import PROVIDERS, BatchTerms, Endpoint, ModelEntry, endpoint_identity
from merge_runner.records import LARGEST_STATUS, SLOT_HEADER, ChatRequest, canonical_json

if TYPE_CHECKING:
    from merge_runner.llm.http import HttpTransport

# A page of a list, or a file of results, may have many megabytes.
TIMEOUT_S = 600.0
MOST_BYTES = 1_000_000_000
LONGEST_MESSAGE = 500
ID = re.compile(r"(?!.*\.\.)[A-Za-z0-9_-][A-Za-z0-9_./-]{0,999}")
FailureKind = Literal["again", "smaller", "quota", "refused", "lost"]
Gone = Mapping[int, FailureKind]
# A server does not have a batch, or no longer; its results may not be there yet.
NO_BATCH: Gone = {404: "lost", 410: "lost"}
NO_RESULTS: Gone = {404: "again", 410: "lost"}
NEW: Gone = {}
# Where a provider's addresses stand, whatever the base URL of the server is.
OPENAI, GEMINI = "/v1", "/v1beta"
NOT_ASKED = frozenset({"batch_expired", "batch_cancelled"})
# Of ASCII, as a URL is; it may carry a long token.
UPLOAD_PATH = re.compile("/[!-~]{1,8000}")
# The status with which the plain endpoint sends an error: a result has its type or its code
# (google/rpc/code.proto) alone. All others may pass.
ANTHROPIC_STATUSES = {
    "invalid_request_error": 400,
    "request_too_large": 413,
    "rate_limit_error": 429,
    "overloaded_error": 529,
}
GEMINI_STATUSES = {1: 499, 3: 400, 7: 403, 8: 429, 12: 501, 14: 503}
CANCELLED = 499


class BatchFailed(MergeRunnerError):
    """A batch mode did not do what it was asked; ``kind`` says what to do.

    ``again``: the same once more, after a while, ``delay_s`` where the server asks for that.
    ``smaller``: submit fewer lines, since too many tokens are enqueued. ``quota`` and ``refused``:
    nothing at this endpoint will be answered. ``lost``: what became of the batch cannot be known;
    its lines may have been charged. ``sent`` is False where certainly no batch was created.
    """

    def __init__(
        self, kind: FailureKind, message: str, *, delay_s: float | None = None, sent: bool = True
    ) -> None:
        super().__init__(message[:LONGEST_MESSAGE])
        self.kind = kind
        self.delay_s = delay_s
        self.sent = sent


@dataclass(frozen=True, slots=True)
class BatchStatus:
    """The state of a batch.

    One that has ended, or expired or was cancelled, has its results at ``paths``: JSONL, in any
    order, at least ``results`` of them, perhaps not of all lines. Where there is a ``failure`` no
    line was asked or charged. One that goes on has neither.
    """

    paths: Sequence[str] | None = None
    results: int = 0
    failure: BatchFailed | None = None


class BatchService(ABC):
    """The batch mode of one model at one endpoint; every request raises BatchFailed.

    Where a batch takes no mark, one whose id was lost cannot be found. Batches are at ``path``,
    where ``pages`` is the query for a page of their list, and ``cursor`` that for the one after it.
    A page has its batches as ``list_member``, each with its mark as ``mark_member`` of its
    metadata, and the cursor of the next page as ``next_member``. A line is made by ``template``,
    with the key of its request: 64 hexadecimal digits, as many characters as Anthropic takes.
    """

    template: ClassVar[str]
    takes_mark: ClassVar[bool] = True
    path: ClassVar[str]
    pages: ClassVar[str]
    cursor: ClassVar[str]
    list_member: ClassVar[str]
    next_member: ClassVar[str]
    mark_member: ClassVar[str]

    def __init__(self, transport: HttpTransport, endpoint: Endpoint, wire: WireFormat) -> None:
        self.transport = transport
        self.endpoint = endpoint
        self.wire = wire

    def line(self, request: ChatRequest) -> bytes:
        """Return a line as it is sent, with the body as it is hashed."""
        slot = canonical_json(request.slot.as_dict())
        # Only our own emulator is told the slot.
        told = f',"{SLOT_HEADER}":{slot}' if self.endpoint.provider == "emulator" else ""
        line = self.template.format(
            key=request.key, path=request.path, body=request.body, slot=told
        )
        return line.encode()

    async def _upload(self, content: bytes, mark: str) -> str:
        return ""  # the creation has the lines, unless they go into a file, whose name this returns

    @abstractmethod
    def _creation(self, requests: Sequence[ChatRequest], file: str, mark: str) -> tuple[str, bytes]:
        """Return the path and the body that create a batch of requests, or of those in the file."""

    async def create(self, requests: Sequence[ChatRequest], mark: str) -> str:
        """Create a batch of requests with different keys; returns its id.

        ``mark``, up to 64 letters, digits, _ and -, is attached where the provider takes a name.
        """
        try:
            file = await self._upload(b"".join(map(self.line, requests)), mark)
        except BatchFailed as exc:
            exc.sent = False  # a file is no batch yet
            raise
        created = await self._ask("POST", *self._creation(requests, file, mark))
        return self._batch_id(json_object(created))

    async def find(self, mark: str) -> str | None:
        """Return the id of the batch with this mark."""
        cursor: str | None = ""
        seen: set[str] = set()
        while cursor is not None and cursor not in seen:  # ends where a server knows no pages
            seen.add(cursor)
            after = f"&{self.cursor}={quote(cursor, safe='')}" if cursor else ""
            page = await self._look(f"{self.path}?{self.pages}{after}")
            cursor = as_text(page.get(self.next_member))
            for batch in as_dicts(page.get(self.list_member)):
                if as_dict(batch.get("metadata")).get(self.mark_member) == mark:
                    return self._batch_id(batch)
        return None

    async def status(self, batch_id: str) -> BatchStatus:
        """Return the state of a batch."""
        return self._status_of(await self._look(f"{self.path}/{batch_id}"))

    @abstractmethod
    def _status_of(self, batch: dict[str, Any]) -> BatchStatus:
        """Return the state of a batch as its server describes it."""

    @abstractmethod
    def _read(self, line: dict[str, Any]) -> RawReply | None:
        """Return what the plain endpoint would have replied: an answer (status 200) or an error.

        None where the line was never asked, since the batch expired or was cancelled before. Raises
        ValueError where the line has no known form.
        """

    async def results(self, paths: Sequence[str]) -> AsyncIterator[tuple[str, RawReply | None]]:
        """Yield the results of a batch that has ended, by key; it is empty where one is broken."""
        for path in paths:
            raw = await self._ask("GET", path, gone=NO_RESULTS)
            for line in filter(str.strip, raw.body.split("\n")):
                try:
                    value = as_dict(json.loads(line))
                    key = as_text(value.get("custom_id", value.get("key")))
                    yield key or "", self._read(value)
                except ValueError:
                    yield "", None

    def _failure_of(self, error: ServerError, gone: Gone = NEW) -> BatchFailed:
        """Return the failure of a batch that is not created or fails as a whole.

        Where one exists, ``gone`` says what the statuses mean with which it is not found.
        """
        outcome = judge_error(error, self.wire)
        kinds: dict[str, FailureKind] = {"retry": "again", "quota": "quota", "refused": "refused"}
        kind = kinds.get(outcome.action, "again" if gone else "refused")
        enqueued = "token_limit_exceeded" in error.names or "enqueued" in error.message.lower()
        if not gone and (enqueued or error.status == 413):
            kind = "smaller"
        message = f"HTTP {error.status}: {error.message}"
        return BatchFailed(gone.get(error.status, kind), message, delay_s=outcome.delay_s)

    async def _ask(
        self,
        method: str,
        path: str,
        body: bytes = b"",
        headers: Mapping[str, str] | None = None,
        gone: Gone = NEW,
    ) -> RawReply:
        """Return the reply to a step of a creation (POST), or to a look at what exists (GET)."""
        sent = {**self.wire.headers, **(headers or {})}
        try:
            raw = await self.transport.ask(
                method, path, sent, body, timeout_s=TIMEOUT_S, most_bytes=MOST_BYTES
            )
        except TransportFailure as exc:
            # One that is refused for what it is will be no other next time.
            kinds: dict[str, FailureKind] = {"refused": "refused", "fail": "lost"}
            kind = kinds.get(exc.action, "again")
            raise BatchFailed(kind, str(exc), sent=exc.sent) from exc
        if 200 <= raw.status < 300:
            return raw
        failure = self._failure_of(raw.error, gone)
        # Without a mark it cannot be looked for: what the provider says of itself decides.
        failure.sent = may_be_charged(raw, self.endpoint.identity)
        failure.sent |= self.takes_mark and raw.status >= 500
        raise failure

    async def _look(self, path: str) -> dict[str, Any]:
        return json_object(await self._ask("GET", path, gone=NO_BATCH))

    def _batch_id(self, batch: dict[str, Any]) -> str:
        return id_of({"id": batch.get("id", batch.get("name"))}).rpartition("/")[2]


def json_object(raw: RawReply) -> dict[str, Any]:
    """Return the body of a reply as a JSON object; raises BatchFailed."""
    if not isinstance(raw.payload, dict):
        raise BatchFailed("again", f"HTTP {raw.status}: the body is not a JSON object")
    return raw.payload


def id_of(reply: Mapping[str, Any], member: str = "id") -> str:
    """Return an id, which can stand in a path; raises BatchFailed."""
    value = reply.get(member)
    if not isinstance(value, str) or not ID.fullmatch(value):
        raise BatchFailed("again", f"the reply cannot be used: it has no {member} of a known form")
    return value


class OpenAIBatches(BatchService):
    """``/files`` and ``/batches`` of OpenAI, and of servers that speak like it."""

    template = (
        f'{{{{"custom_id":"{{key}}","method":"POST","url":"{OPENAI}{{path}}",'
        '"body":{body}{slot}}}\n'
    )
    path, pages, cursor = "/batches", "limit=100", "after"
    list_member, next_member, mark_member = "data", "last_id", "merge_runner_mark"

    async def _upload(self, content: bytes, mark: str) -> str:
        boundary = uuid4().hex
        purpose = 'content-disposition: form-data; name="purpose"\r\n\r\nbatch'
        file = 'content-disposition: form-data; name="file"; filename="batch.jsonl"'
        head = f"--{boundary}\r\n{purpose}\r\n--{boundary}\r\n{file}\r\n"
        head += "content-type: application/jsonl\r\n\r\n"
        body = head.encode() + content + f"\r\n--{boundary}--\r\n".encode()
        form = {"content-type": f"multipart/form-data; boundary={boundary}"}
        return id_of(json_object(await self._ask("POST", "/files", body, form)))

    def _creation(self, requests: Sequence[ChatRequest], file: str, mark: str) -> tuple[str, bytes]:
        batch = {
            "input_file_id": file,
            "endpoint": OPENAI + requests[0].path,
            "completion_window": "24h",
            "metadata": {self.mark_member: mark},
        }
        return self.path, canonical_json(batch).encode()

    def _status_of(self, batch: dict[str, Any]) -> BatchStatus:
        word = (as_text(batch.get("status")) or "").upper()
        answered = as_count(as_dict(batch.get("request_counts")).get("completed")) or 0
        error, told = at(batch, "errors.data.0"), batch.get("errors")
        why = read_error(400, {}, json.dumps(told) if told else "", {"error": error})
        why = replace(why, status=status_within(why) if why.names else 400)
        failure = self._failure_of(why) if word == "FAILED" else None
        if word not in ("COMPLETED", "EXPIRED", "CANCELLED"):
            return BatchStatus(failure=failure)
        names = [name for name in ("output_file_id", "error_file_id") if batch.get(name)]
        return BatchStatus([f"/files/{id_of(batch, name)}/content" for name in names], answered)

    def _read(self, line: dict[str, Any]) -> RawReply | None:
        response, error = as_dict(line.get("response")), as_dict(line.get("error"))
        status, body = as_count(response.get("status_code")), response.get("body")
        if status and status <= LARGEST_STATUS and isinstance(body, dict):
            return _reply(status, body)
        if as_text(error.get("code")) in NOT_ASKED:
            return None
        if not error:
            raise ValueError("neither a response nor an error")
        return _reply(500, {"error": error})


class AnthropicBatches(BatchService):
    """``/v1/messages/batches``, with all requests in the body; a batch takes no mark."""

    template = '{{"custom_id":"{key}","params":{body}{slot}}}'
    takes_mark = False
    path = "/v1/messages/batches"

    def _creation(self, requests: Sequence[ChatRequest], file: str, mark: str) -> tuple[str, bytes]:
        return self.path, b'{"requests":[' + b",".join(map(self.line, requests)) + b"]}"

    def _status_of(self, batch: dict[str, Any]) -> BatchStatus:
        if (as_text(batch.get("processing_status")) or "").upper() != "ENDED":
            return BatchStatus()
        counts = as_dict(batch.get("request_counts")).values()
        # Not at the URL that the batch names: the key goes to the configured host alone.
        path = f"{self.path}/{id_of(batch)}/results"
        return BatchStatus([path], sum(as_count(count) or 0 for count in counts))

    def _read(self, line: dict[str, Any]) -> RawReply | None:
        result = as_dict(line.get("result"))
        match result.get("type"):
            case "succeeded":
                return _reply(200, as_dict(result.get("message")))
            case "errored":
                error = as_dict(result.get("error"))
                kind = as_text(as_dict(error.get("error")).get("type")) or ""
                return _reply(ANTHROPIC_STATUSES.get(kind, 500), error)
            case "expired" | "canceled":
                return None
        raise ValueError("a result of an unknown type")


class GeminiBatches(BatchService):
    """``models/MODEL:batchGenerateContent`` and ``batches``, with the requests in a file.

    They could also stand in the body of the creation; a file has room for more, and each of its
    results has the key of its request.
    """

    template = '{{"key":"{key}","request":{body}{slot}}}\n'
    # A page has few batches, since one may come with all its results.
    path, pages, cursor = f"{GEMINI}/batches", "pageSize=10", "pageToken"
    list_member, next_member, mark_member = "operations", "nextPageToken", "displayName"

    async def _upload(self, content: bytes, mark: str) -> str:
        start = {
            "x-goog-upload-protocol": "resumable",
            "x-goog-upload-command": "start",
            "x-goog-upload-header-content-length": str(len(content)),
            "x-goog-upload-header-content-type": "application/jsonl",
        }
        file = canonical_json({"file": {"displayName": mark, "mimeType": "application/jsonl"}})
        begun = await self._ask("POST", f"/upload{GEMINI}/files", file.encode(), start)
        # At the configured host, to which alone the key goes, whatever the URL names.
        url = begun.headers.get("x-goog-upload-url", "")
        path = "/" + url.partition("://")[2].partition("/")[2]
        path = path.removeprefix(urlsplit(self.endpoint.base_url).path)
        if not UPLOAD_PATH.fullmatch(path):
            raise BatchFailed("again", "the reply names no URL for the upload")
        finish = {"x-goog-upload-command": "upload, finalize", "x-goog-upload-offset": "0"}
        uploaded = json_object(await self._ask("POST", path, content, finish))
        return id_of(as_dict(uploaded.get("file")), "name")

    def _creation(self, requests: Sequence[ChatRequest], file: str, mark: str) -> tuple[str, bytes]:
        batch = {"displayName": mark, "inputConfig": {"fileName": file}}
        path = requests[0].path.replace(":generateContent", ":batchGenerateContent")
        return path, canonical_json({"batch": batch}).encode()

    def _status_of(self, batch: dict[str, Any]) -> BatchStatus:
        # The word of an operation that is done may be one that nobody knows.
        metadata, error = as_dict(batch.get("metadata")), as_dict(batch.get("error"))
        # It says JOB_STATE_ or BATCH_STATE_ before it.
        word = (as_text(metadata.get("state")) or "").upper().rpartition("_STATE_")[2]
        done = batch.get("done") is True
        if word not in ("SUCCEEDED", "PARTIALLY_SUCCEEDED", "CANCELLED", "EXPIRED"):
            if word == "FAILED" or (done and error):
                why = read_error(_http_status(error) if error else 400, {}, "", batch)
                return BatchStatus(failure=self._failure_of(why))
            if not done:
                return BatchStatus()
        output = as_dict(metadata.get("output")) or as_dict(batch.get("response"))
        if not output and word.endswith("SUCCEEDED"):
            raise BatchFailed("again", "the results are not there yet")
        file = id_of(output, "responsesFile") if output.get("responsesFile") else ""
        answered = str(as_dict(metadata.get("batchStats")).get("successfulRequestCount"))
        return BatchStatus(
            [f"{GEMINI}/{file}:download?alt=media"] if file else [],
            int(answered) if re.fullmatch("[0-9]{1,18}", answered) else 0,  # numbers are texts
        )

    def _read(self, line: dict[str, Any]) -> RawReply | None:
        response, error = line.get("response"), as_dict(line.get("error"))
        if isinstance(response, dict):
            return _reply(200, response)
        if not error:
            raise ValueError("neither a response nor an error")
        status = _http_status(error)
        return None if status == CANCELLED else _reply(status, {"error": error})


def _reply(status: int, body: dict[str, Any]) -> RawReply:
    # In ASCII, since JSON can spell half of a surrogate pair, which no file can hold.
    return RawReply(status, {}, json.dumps(body))


def _http_status(error: dict[str, Any]) -> int:
    """The HTTP status of an error of Gemini's, whose code may be one already."""
    code = as_count(error.get("code")) or 2
    return code if 400 <= code < 600 else GEMINI_STATUSES.get(code, 500)


# By wire format.
SERVICES: Mapping[str, type[BatchService]] = {
    "openai-chat": OpenAIBatches,
    "openai-responses": OpenAIBatches,
    "gemini": GeminiBatches,
    "anthropic": AnthropicBatches,
}


def batch_terms(entry: ModelEntry) -> BatchTerms | None:
    """Return the terms on which a model answers in batches; None: it has no known batch mode."""
    # A path of its own leads to one deployment, which no batch can name.
    if entry.batch == "none" or entry.path is not None or entry.format not in SERVICES:
        return None
    if isinstance(entry.batch, BatchTerms):
        return entry.batch
    # A provider's price holds at its own address.
    is_its_own = endpoint_identity(entry) == entry.provider
    return PROVIDERS.require(entry.provider).batch if is_its_own else None
