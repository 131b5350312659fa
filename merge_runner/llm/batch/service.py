"""What the batch modes of all providers share: requests, errors, lists and lines of results."""

from __future__ import annotations

import json
import re
from abc import ABC, abstractmethod
from collections.abc import AsyncIterator, Mapping, Sequence
from contextlib import aclosing
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal
from urllib.parse import quote

from merge_runner.config import Endpoint, is_own_host
from merge_runner.errors import MergeRunnerError
from merge_runner.llm.formats import ServerError, WireFormat, as_dict, as_dicts, as_text
from merge_runner.llm.http_outcome import (
    RawReply,
    TransportFailure,
    judge_error,
    may_be_charged,
)
from merge_runner.records import SLOT_HEADER, ChatRequest, canonical_json

if TYPE_CHECKING:
    from merge_runner.llm.http import HttpTransport

# A batch, or a page of a list, may have many megabytes.
TIMEOUT_S = 300.0
MOST_BYTES = 256_000_000
LONGEST_MESSAGE = 500
ID = re.compile(r"(?!.*\.\.)[A-Za-z0-9_-][A-Za-z0-9_./-]{0,999}")
FailureKind = Literal["again", "smaller", "quota", "refused", "lost"]


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
        self.forgets = endpoint.is_emulator  # what waits there ends with the emulator

    def line(self, request: ChatRequest) -> bytes:
        """Return a line as it is sent, with the body as it is hashed."""
        slot = canonical_json(request.slot.as_dict())
        # Only our own emulator is told the slot.
        told = f',"{SLOT_HEADER}":{slot}' if self.endpoint.is_emulator else ""
        line = self.template.format(
            key=request.key, path=request.path, body=request.body, slot=told
        )
        return line.encode()

    async def upload(self, content: bytes, mark: str) -> str:
        """Return the name of a file with these lines; empty where the creation has them."""
        return ""

    @abstractmethod
    def creation(self, requests: Sequence[ChatRequest], file: str, mark: str) -> tuple[str, bytes]:
        """Return the path and the body that create a batch of requests, which are in the file."""

    async def create(self, requests: Sequence[ChatRequest], mark: str) -> str:
        """Create a batch of requests with different keys; returns its id.

        ``mark``, up to 64 letters, digits, _ and -, is attached where the provider takes a name.
        """
        try:
            file = await self.upload(b"".join(map(self.line, requests)), mark)
        except BatchFailed as exc:
            exc.sent = False  # a file is no batch yet
            raise
        created = await self.ask("POST", *self.creation(requests, file, mark))
        return self._batch_id(json_object(created))

    async def find(self, mark: str) -> str | None:
        """Return the id of the batch with this mark."""
        cursor: str | None = ""
        seen: set[str] = set()
        while cursor is not None and cursor not in seen:  # ends where a server knows no pages
            seen.add(cursor)
            after = f"&{self.cursor}={quote(cursor, safe='')}" if cursor else ""
            page = json_object(await self.ask("GET", f"{self.path}?{self.pages}{after}"))
            cursor = as_text(page.get(self.next_member))
            for batch in as_dicts(page.get(self.list_member)):
                if as_dict(batch.get("metadata")).get(self.mark_member) == mark:
                    return self._batch_id(batch)
        return None

    async def status(self, batch_id: str) -> BatchStatus:
        """Return the state of a batch."""
        return self.status_of(json_object(await self.ask("GET", f"{self.path}/{batch_id}")))

    @abstractmethod
    def status_of(self, batch: dict[str, Any]) -> BatchStatus:
        """Return the state of a batch as its server describes it."""

    @abstractmethod
    def read(self, line: dict[str, Any]) -> RawReply | None:
        """Return what the plain endpoint would have replied: an answer (status 200) or an error.

        None where the line was never asked, since the batch expired or was cancelled before. Raises
        ValueError where the line has no known form.
        """

    async def results(self, paths: Sequence[str]) -> AsyncIterator[tuple[str, RawReply | None]]:
        """Yield the results of a batch that has ended, by key; it is empty where one is broken.

        Raises BatchFailed with the kind ``again`` where they can be read from the beginning.
        """
        for path in paths:
            try:
                body = self.transport.lines(path, self.wire.headers, timeout_s=TIMEOUT_S)
                async with aclosing(body) as lines:
                    async for line in lines:
                        if isinstance(line, RawReply):
                            failure = self.failure_of(line.error, exists=True)
                            if line.status == 404:  # it belongs to a batch that is there
                                failure.kind = "again"
                            raise failure
                        if line.strip():
                            yield self._result(line)
            except TransportFailure as exc:
                raise _unanswered(exc) from exc

    def failure_of(self, error: ServerError, *, exists: bool = False) -> BatchFailed:
        """Return the failure of a batch that is not created, fails as a whole, or ``exists``."""
        outcome = judge_error(error, self.wire)
        kinds: dict[str, FailureKind] = {"retry": "again", "quota": "quota", "refused": "refused"}
        kind = kinds.get(outcome.action, "again" if exists else "refused")
        enqueued = "token_limit_exceeded" in error.names or "enqueued" in error.message.lower()
        if exists and error.status in (404, 410):  # its server does not have it, or no longer
            kind = "lost"
        elif not exists and (enqueued or error.status == 413):
            kind = "smaller"
        message = f"HTTP {error.status}: {error.message}"
        return BatchFailed(kind, message, delay_s=outcome.delay_s)

    async def ask(
        self, method: str, path: str, body: bytes = b"", headers: Mapping[str, str] | None = None
    ) -> RawReply:
        """Return the reply to a step of a creation (POST), or to a look at what exists (GET)."""
        sent = {**self.wire.headers, **(headers or {})}
        try:
            raw = await self.transport.ask(
                method, path, sent, body, timeout_s=TIMEOUT_S, most_bytes=MOST_BYTES
            )
        except TransportFailure as exc:
            raise _unanswered(exc) from exc
        if 200 <= raw.status < 300:
            return raw
        failure = self.failure_of(raw.error, exists=method == "GET")
        # Without a mark it cannot be looked for: what the provider says of itself decides.
        own = is_own_host(self.endpoint.provider, self.endpoint.identity)
        failure.sent = may_be_charged(raw, self.endpoint.provider if own else None)
        failure.sent |= self.takes_mark and raw.status >= 500
        raise failure

    def _batch_id(self, batch: dict[str, Any]) -> str:
        return id_of({"id": batch.get("id", batch.get("name"))}).rpartition("/")[2]

    def _result(self, line: str) -> tuple[str, RawReply | None]:
        try:
            value = as_dict(json.loads(line))
            key = value.get("custom_id", value.get("key"))
            return as_text(key) or "", self.read(value)
        except ValueError:
            return "", None


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


def _unanswered(failure: TransportFailure) -> BatchFailed:
    """Return what no reply means; one that is refused for what it is will be no other next time."""
    kinds: dict[str, FailureKind] = {"refused": "refused", "fail": "lost"}
    return BatchFailed(kinds.get(failure.action, "again"), str(failure), sent=failure.sent)
