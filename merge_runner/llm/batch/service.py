"""What the batch modes of all providers share: requests, errors, lists and lines of results."""

from __future__ import annotations

import json
import re
from abc import ABC, abstractmethod
from collections.abc import AsyncIterator, Mapping, Sequence
from contextlib import aclosing
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Literal
from urllib.parse import quote

from merge_runner.config import Endpoint, is_own_host
from merge_runner.errors import MergeRunnerError
from merge_runner.llm.content_hashes import canonical_json
from merge_runner.llm.formats.base import ServerError, WireFormat, as_text
from merge_runner.llm.http_outcome import (
    ErrorReply,
    RawReply,
    TransportFailure,
    judge_error,
    may_be_charged,
)
from merge_runner.records import ATTEMPT_HEADER, SLOT_HEADER, ChatRequest

if TYPE_CHECKING:
    from merge_runner.llm.http import HttpTransport

# A batch, or a page of a list, may have many megabytes.
TIMEOUT_S = 300.0
MOST_BYTES = 256_000_000
# What a server answers that has no batch mode, or none for the model.
NO_BATCH_MODE = frozenset({404, 405, 501})
# What it answers of a batch that it does not have, or no longer.
GONE = frozenset({301, 302, 303, 307, 308, 404, 410})
ID = re.compile(r"(?!.*\.\.)[A-Za-z0-9_-][A-Za-z0-9_./-]{0,999}")
MOST_PAGES = 100
LONGEST_MESSAGE = 500

# Batches of a list, each with its mark, and the cursor of the next page, if any.
Page = tuple[list[tuple[object, dict[str, Any]]], str | None]
FailureKind = Literal["again", "smaller", "single", "quota", "refused", "lost"]
"""What to do after a failure.

``again``: the same once more, after a while. ``smaller``: submit fewer lines, since too many tokens
are enqueued. ``single``: ask the lines singly, since there is no batch mode for them. ``quota`` and
``refused``: nothing at this endpoint will be answered, as the same actions of an AttemptOutcome
say. ``lost``: what became of the batch cannot be known, since its server no longer has it, or
answers with what cannot be read; its lines may have been charged.
"""

# What the judgement of a single call means here.
JUDGED: dict[str, FailureKind] = {"quota": "quota", "refused": "refused", "retry": "again"}


class BatchFailed(MergeRunnerError):
    """A batch mode did not do what it was asked.

    ``smaller`` and ``single`` come from ``create`` and as the ``failure`` of a status, ``lost``
    from all other methods alone. ``delay_s`` is how long the server asks to wait. ``sent`` is False
    where certainly no batch was created.
    """

    def __init__(
        self, kind: FailureKind, message: str, *, delay_s: float | None = None, sent: bool = True
    ) -> None:
        super().__init__(message)
        self.kind = kind
        self.delay_s = delay_s
        self.sent = sent


@dataclass(slots=True, eq=False)
class BatchLine:
    """One request of a batch, known there by its key; ``attempt`` counts from 1, as for a call."""

    request: ChatRequest
    attempt: int = 1

    @property
    def key(self) -> str:
        """Its id there: 64 hexadecimal digits, as many characters as Anthropic takes."""
        return self.request.key


@dataclass(frozen=True, slots=True)
class BatchStatus:
    """The state of a batch.

    ``ended``: there are results to fetch, at least ``results``, perhaps not of all lines; also of
    one that expired or was cancelled. ``failed``: no line was asked and nothing is charged;
    ``failure`` says what to do, ``message`` what the provider says. ``batch`` is all that it says.
    """

    state: Literal["waiting", "ended", "failed"]
    results: int = 0
    message: str = ""
    failure: FailureKind = "again"
    batch: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class LineResult:
    """The result of one line.

    ``raw`` is what the plain endpoint would have replied, an answer (status 200) or an error, to be
    judged in the same way; None where the line was never asked and is not charged, since the batch
    expired or was cancelled before, as ``message`` says. A line that cannot be used has no ``key``,
    and ``message`` says why.
    """

    key: str
    raw: RawReply | None = None
    message: str = ""


class BatchService(ABC):
    """The batch mode of one model at one endpoint; every request raises BatchFailed.

    Where a batch takes no mark, one whose id was lost cannot be found. Batches are at ``path``,
    where ``pages`` is the query for a page of their list, and ``cursor`` that for the one after it.
    A batch has its id as ``id_member``, a result the key of its request as ``key_member``.
    """

    takes_mark: ClassVar[bool] = True
    path: ClassVar[str]
    pages: ClassVar[str]
    cursor: ClassVar[str]
    id_member: ClassVar[str] = "id"
    key_member: ClassVar[str] = "custom_id"

    def __init__(self, transport: HttpTransport, endpoint: Endpoint, wire: WireFormat) -> None:
        self._transport = transport
        self._endpoint = endpoint
        self._wire = wire
        self.forgets = endpoint.is_emulator  # what waits there ends with the emulator

    @abstractmethod
    def line(self, line: BatchLine) -> bytes:
        """Return a line as it is sent, with the body as it is hashed."""

    async def upload(self, content: bytes, mark: str) -> str:
        """Return the name of a file with these lines; empty where the creation has them."""
        return ""

    @abstractmethod
    def creation(self, lines: Sequence[BatchLine], file: str, mark: str) -> tuple[str, bytes]:
        """Return the path and the body that create a batch of lines, which are in the file."""

    async def create(self, lines: Sequence[BatchLine], mark: str) -> str:
        """Create a batch of lines with different keys; returns its id.

        ``mark``, up to 64 letters, digits, _ and -, is attached where the provider takes a name.
        """
        try:
            file = await self.upload(b"".join(map(self.line, lines)), mark)
        except BatchFailed as exc:
            exc.sent = False  # a file is no batch yet
            raise
        created = await self._ask("POST", *self.creation(lines, file, mark))
        return self._batch_id(json_object(created))

    async def find(self, mark: str) -> str | None:
        """Return the id of the batch with this mark.

        Raises BatchFailed with the kind ``lost`` where there are too many to look through.
        """
        cursor: str | None = ""
        seen: set[str] = set()
        while cursor is not None and cursor not in seen:  # ends where a server knows no pages
            if len(seen) == MOST_PAGES:
                raise BatchFailed("lost", "the list of batches cannot be read to its end")
            seen.add(cursor)
            after = f"&{self.cursor}={quote(cursor, safe='')}" if cursor else ""
            page = json_object(await self._ask("GET", f"{self.path}?{self.pages}{after}"))
            listed, cursor = self.page_of(page)
            for its, batch in listed:
                if its == mark:
                    return self._batch_id(batch)
        return None

    def page_of(self, page: dict[str, Any]) -> Page:
        """Return what a page of the list says."""
        raise NotImplementedError

    async def status(self, batch_id: str) -> BatchStatus:
        """Return the state of a batch."""
        return self.status_of(json_object(await self._ask("GET", f"{self.path}/{batch_id}")))

    @abstractmethod
    def status_of(self, batch: dict[str, Any]) -> BatchStatus:
        """Return the state of a batch as its server describes it."""

    @abstractmethod
    def result_paths(self, batch_id: str, batch: Mapping[str, Any]) -> list[str]:
        """Return where the results of a batch that has ended are: JSONL, in any order."""

    @abstractmethod
    def read(self, key: str, line: dict[str, Any]) -> LineResult | None:
        """Return the result in a line, None where it has no known form."""

    async def results(self, batch_id: str, status: BatchStatus) -> AsyncIterator[LineResult]:
        """Yield the results of a batch that has ended.

        Where one file cannot be read, those of the other come all the same. Raises BatchFailed with
        the kind ``again`` where they can be read from the beginning.
        """
        failure: BatchFailed | None = None
        for path in self.result_paths(batch_id, status.batch):
            try:
                body = self._transport.lines(path, self._wire.headers, timeout_s=TIMEOUT_S)
                async with aclosing(body) as lines:
                    async for line in lines:
                        if line:
                            yield self._result(line)
            except ErrorReply as exc:
                failure = self._refused(exc.raw, exists=True)
                if exc.raw.status == 404:  # it belongs to a batch that is there
                    failure.kind = "again"
            except TransportFailure as exc:
                failure = _unanswered(exc)
        if failure is not None:
            raise failure

    def failure_of(self, error: ServerError) -> FailureKind:
        """Return what to do with lines whose batch is not created, or fails as a whole."""
        enqueued = "token_limit_exceeded" in error.names or "enqueued" in error.message.lower()
        if enqueued or error.status == 413:
            return "smaller"
        if error.status in NO_BATCH_MODE:
            return "single"
        return JUDGED.get(judge_error(error, self._wire).action, "single")

    def slot_members(self, line: BatchLine) -> str:
        """Return what our own emulator alone is told of a line, as members of its JSON object."""
        if not self._endpoint.is_emulator:
            return ""
        slot = canonical_json(line.request.slot.as_dict())
        return f',"{SLOT_HEADER}":{slot},"{ATTEMPT_HEADER}":{line.attempt}'

    async def _ask(
        self, method: str, path: str, body: bytes = b"", headers: Mapping[str, str] | None = None
    ) -> RawReply:
        """Return the reply to a step of a creation (POST), or to a look at what exists (GET)."""
        sent = {**self._wire.headers, **(headers or {})}
        try:
            raw = await self._transport.ask(
                method, path, sent, body, timeout_s=TIMEOUT_S, most_bytes=MOST_BYTES
            )
        except TransportFailure as exc:
            raise _unanswered(exc) from exc
        if not 200 <= raw.status < 300:
            raise self._refused(raw, exists=method == "GET")
        return raw

    def _refused(self, raw: RawReply, *, exists: bool) -> BatchFailed:
        """Return the failure in a reply; a batch that may exist is never asked singly."""
        outcome = judge_error(raw.error, self._wire)
        kind = JUDGED.get(outcome.action, "again") if exists else self.failure_of(raw.error)
        if exists and raw.status in GONE:
            kind = "lost"
        # Without a mark it cannot be looked for: what the provider says of itself decides.
        own = is_own_host(self._endpoint.provider, self._endpoint.identity)
        sent = may_be_charged(raw, self._endpoint.provider if own else None)
        sent = sent or (self.takes_mark and raw.status >= 500)
        message = f"HTTP {raw.status}: {as_message(raw.error.message)}"
        return BatchFailed(kind, message, delay_s=outcome.delay_s, sent=sent)

    def _batch_id(self, batch: dict[str, Any]) -> str:
        return id_of(batch, self.id_member).rpartition("/")[2]

    def _result(self, line: str | TransportFailure) -> LineResult:
        if isinstance(line, TransportFailure):
            return LineResult("", message=str(line))
        try:
            value = json.loads(line)
            key = as_text(value.get(self.key_member))
        except (ValueError, AttributeError):
            return LineResult("", message="it is no JSON object")
        if not key:
            return LineResult("", message=f"it has no {self.key_member}")
        return self.read(key, value) or LineResult("", message="it is of no known form")


def json_object(raw: RawReply) -> dict[str, Any]:
    """Return the body of a reply as a JSON object; raises BatchFailed."""
    if not isinstance(raw.payload, dict):
        raise BatchFailed("again", f"HTTP {raw.status}: the body is not a JSON object")
    return raw.payload


def as_reply(status: int, body: dict[str, Any]) -> RawReply:
    """Return the reply of the plain endpoint that a result stands for."""
    # In ASCII, since JSON can spell half of a surrogate pair, which no file can hold.
    return RawReply(status, {}, json.dumps(body))


def as_message(value: object) -> str:
    """Return a text for a reader in one line, empty where there is none."""
    return " ".join((as_text(value) or "").split())[:LONGEST_MESSAGE]


def as_word(value: object) -> str:
    """Return a provider's word for a state, in capitals."""
    return (as_text(value) or "").upper()


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
