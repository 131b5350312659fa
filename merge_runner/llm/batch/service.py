"""Batch mode of one model: create a batch, find it, get its status, and read its results."""

from __future__ import annotations

import json
import re
from abc import ABC, abstractmethod
from collections.abc import AsyncIterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple
from urllib.parse import quote

from merge_runner.errors import MergeRunnerError
from merge_runner.llm.formats.server_error import ServerError
from merge_runner.llm.formats.wire import WireFormat, as_dict, as_dicts, as_text
from merge_runner.llm.http_outcome import (
    RawReply,
    TransportFailure,
    judge_error,
    may_be_charged,
)
from merge_runner.providers import Endpoint
from merge_runner.records import SLOT_HEADER, ChatRequest, canonical_json

if TYPE_CHECKING:
    from merge_runner.llm.http import HttpTransport
# A page of a list, or a file of results, may have many megabytes.
TIMEOUT_S = 600.0
MOST_BYTES = 1_000_000_000
LONGEST_MESSAGE = 500
ID = re.compile(r"(?!.*\.\.)[A-Za-z0-9_-][A-Za-z0-9_./-]{0,999}")
FailureKind = Literal["again", "smaller", "quota", "rejected", "lost"]
Gone = Mapping[int, FailureKind]
# Meaning of a 404 and 410: a batch is gone; its results may not exist yet.
NO_BATCH: Gone = {404: "lost", 410: "lost"}
NO_RESULTS: Gone = {404: "again", 410: "lost"}
NEW: Gone = {}


class BatchFailed(MergeRunnerError):
    """A request to a batch mode failed; ``kind`` names what follows.

    ``again``: retry later, after ``delay_s`` if the server asks for it. ``smaller``: submit fewer
    requests, since too many tokens are enqueued. ``quota`` and ``rejected``: this endpoint answers
    nothing. ``lost``: the fate of the batch is unknown; its requests may have been billed. ``sent``
    is False where certainly no batch was created.
    """

    def __init__(
        self, kind: FailureKind, message: str, *, delay_s: float | None = None, sent: bool = True
    ) -> None:
        super().__init__(message[:LONGEST_MESSAGE])
        self.kind = kind
        self.delay_s = delay_s
        self.sent = sent


class BatchStatus(NamedTuple):
    """Status of a batch.

    One that has ended, expired or was cancelled has at least ``results`` results at ``paths``:
    JSONL, in any order, perhaps not of all requests. After a ``failure`` no request was processed
    or billed. One in progress has neither.
    """

    paths: Sequence[str] | None = None
    results: int = 0
    failure: BatchFailed | None = None


@dataclass
class BatchService(ABC):
    """Batch mode of one model at one endpoint; every request raises BatchFailed.

    A mark is our name of a batch at its provider. Without one (``takes_mark``) a batch whose id was
    lost cannot be found. Batches are listed at ``path``, in pages by the query ``pages``, and
    ``cursor`` for the next one. A page has its batches in ``list_member``, each with its mark in
    ``mark_member`` of its metadata, and the cursor of the next page in ``next_member``. A request
    is a line by ``template``, with its key: 64 hexadecimal digits, Anthropic's maximum.
    """

    template: ClassVar[str]
    takes_mark: ClassVar[bool] = True
    path: ClassVar[str]
    pages: ClassVar[str]
    cursor: ClassVar[str]
    list_member: ClassVar[str]
    next_member: ClassVar[str]
    mark_member: ClassVar[str]

    transport: HttpTransport
    endpoint: Endpoint
    wire: WireFormat

    def line(self, request: ChatRequest) -> bytes:
        """Return the line of a request, with its hashed body."""
        slot = canonical_json(request.slot.as_dict())
        # Only the emulator gets the slot.
        member = f',"{SLOT_HEADER}":{slot}' if self.endpoint.provider == "emulator" else ""
        line = self.template.format(
            key=request.key, path=request.path, body=request.body, slot=member
        )
        return line.encode()

    async def _upload(self, content: bytes, mark: str) -> str:
        return ""  # the creation contains the requests; else this is the id of their file

    @abstractmethod
    def _creation(self, requests: Sequence[ChatRequest], file: str, mark: str) -> tuple[str, bytes]:
        """Return the path and the body that create a batch of requests, or of a file."""

    async def create(self, requests: Sequence[ChatRequest], mark: str) -> str:
        """Create a batch of requests with different keys, and return its id.

        ``mark``, up to 64 letters, digits, _ and -, is attached where the provider takes one.
        """
        try:
            file = await self._upload(b"".join(map(self.line, requests)), mark)
        except BatchFailed as exc:
            exc.sent = False  # an uploaded file is not a batch
            raise
        created = await self._ask("POST", *self._creation(requests, file, mark))
        return batch_id_of(json_object(created))

    async def find(self, mark: str) -> str | None:
        """Return the id of the batch with this mark."""
        cursor: str | None = ""
        seen: set[str] = set()
        while cursor is not None and cursor not in seen:  # ends where a server knows no pages
            seen.add(cursor)
            after = f"&{self.cursor}={quote(cursor, safe='')}" if cursor else ""
            listed = await self._ask("GET", f"{self.path}?{self.pages}{after}", gone=NO_BATCH)
            page = json_object(listed)
            cursor = as_text(page.get(self.next_member))
            for batch in as_dicts(page.get(self.list_member)):
                if as_dict(batch.get("metadata")).get(self.mark_member) == mark:
                    return batch_id_of(batch)
        return None

    async def status(self, batch_id: str) -> BatchStatus:
        """Return the status of a batch."""
        described = await self._ask("GET", f"{self.path}/{batch_id}", gone=NO_BATCH)
        return self._status_of(json_object(described))

    @abstractmethod
    def _status_of(self, batch: dict[str, Any]) -> BatchStatus:
        """Return the status of a batch from its server's description."""

    @abstractmethod
    def _read(self, line: dict[str, Any]) -> RawReply | None:
        """Return the reply of the normal endpoint: an answer (status 200) or an error.

        None where the request was never processed, since the batch expired or was cancelled. Raises
        ValueError where the line has no known form.
        """

    async def results(self, paths: Sequence[str]) -> AsyncIterator[tuple[str, RawReply | None]]:
        """Yield the results of a batch that has ended, by key; the key of a broken one is empty."""
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

        For an existing batch ``gone`` has the meaning of statuses such as 404.
        """
        outcome = judge_error(error, self.wire)
        kinds: dict[str, FailureKind] = {"retry": "again", "quota": "quota", "rejected": "rejected"}
        kind = kinds.get(outcome.action, "again" if gone else "rejected")
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
        """Return the reply to a step of a creation (POST), or to a query (GET)."""
        sent = {**self.wire.headers, **(headers or {})}
        try:
            raw = await self.transport.ask(
                method, path, sent, body, timeout_s=TIMEOUT_S, most_bytes=MOST_BYTES
            )
        except TransportFailure as exc:
            # A reply that is refused for its content will be the same next time.
            kinds: dict[str, FailureKind] = {"rejected": "rejected", "fail": "lost"}
            kind = kinds.get(exc.outcome.action, "again")
            raise BatchFailed(kind, str(exc), sent=exc.outcome.charged) from exc
        if 200 <= raw.status < 300:
            return raw
        failure = self._failure_of(raw.error, gone)
        # Without a mark it cannot be found: the provider's own statement decides.
        failure.sent = may_be_charged(raw, self.endpoint.identity)
        failure.sent |= self.takes_mark and raw.status >= 500
        raise failure


def json_object(raw: RawReply) -> dict[str, Any]:
    """Return the body of a reply as a JSON object; raise BatchFailed."""
    if not isinstance(raw.payload, dict):
        raise BatchFailed("again", f"HTTP {raw.status}: the body is not a JSON object")
    return raw.payload


def id_of(reply: Mapping[str, Any], member: str = "id") -> str:
    """Return an id that is safe in a path; raise BatchFailed."""
    value = reply.get(member)
    if not isinstance(value, str) or not ID.fullmatch(value):
        raise BatchFailed("again", f"the reply cannot be used: it has no {member} of a known form")
    return value


def batch_id_of(batch: Mapping[str, Any]) -> str:
    """Return the id of a batch by its server's description; raise BatchFailed."""
    return id_of({"id": batch.get("id", batch.get("name"))}).rpartition("/")[2]
