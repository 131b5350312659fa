"""What the batch modes of all providers share: requests, errors, lists and lines of results."""

from __future__ import annotations

import json
import re
from abc import ABC, abstractmethod
from collections.abc import AsyncIterator, Mapping, Sequence
from contextlib import aclosing
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from typing import TYPE_CHECKING, Any, ClassVar, Literal
from urllib.parse import quote

from merge_runner.config import Endpoint, is_own_host
from merge_runner.errors import MergeRunnerError
from merge_runner.llm.content_hashes import canonical_json
from merge_runner.llm.formats.base import ServerError, WireFormat, as_text
from merge_runner.llm.http_outcome import (
    TOO_LATE,
    ErrorReply,
    RawReply,
    TransportFailure,
    judge_error,
    may_be_charged,
)
from merge_runner.records import ATTEMPT_HEADER, SLOT_HEADER, ChatRequest

if TYPE_CHECKING:
    from merge_runner.llm.http import HttpTransport

TIMEOUT_S = 60.0
# A batch, its results or a page of a list may have hundreds of megabytes.
TRANSFER_TIMEOUT_S = 900.0
MOST_BYTES = 256_000_000
# What a server answers that has no batch mode, or none for the model.
NO_BATCH_MODE = frozenset({404, 405, 501})
# What it answers of a batch that it does not have, or no longer.
GONE = frozenset({301, 302, 303, 307, 308, 404, 410})
# What it answers to the cancellation of a batch that has ended.
ENDED_ALREADY = frozenset({400, 409})
ID = re.compile(r"(?!.*\.\.)[A-Za-z0-9_-][A-Za-z0-9_./-]{0,999}")
# By how much a server's clock may be behind ours.
CLOCK_SLACK = timedelta(hours=1)
MOST_PAGES, LONGEST_CURSOR = 100, 2000
# A file of results with more lines than that is none, and may have no end.
MOST_LINES_OF_A_CALL = 3
LONGEST_MESSAGE, LONGEST_NAME = 500, 80

FailureKind = Literal["again", "smaller", "single", "quota", "refused", "lost"]
"""What to do after a failure.

``again``: the same once more, after a while. ``smaller``: wait until other batches have ended, or
submit fewer lines: too many tokens are enqueued. ``single``: ask the lines singly, since there is
no batch mode for them. ``quota`` and ``refused``: nothing at this endpoint will be answered, as the
same actions of an AttemptOutcome say. ``lost``: what became of the batch cannot be known, since its
server no longer has it, or answers with what cannot be read; its lines may have been charged.
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


@dataclass(frozen=True, slots=True)
class Unreadable:
    """A line of results that cannot be used."""

    why: str


@dataclass(frozen=True, slots=True)
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

    ``ended``: there are results to fetch, perhaps not of all lines; also of one that expired or was
    cancelled. ``failed``: no line was asked and nothing is charged; ``failure`` says what to do.
    ``done`` of ``total`` lines have ended, None where the provider does not say; there are at least
    ``results`` of them. ``message`` is what the provider says beside the state, ``batch`` all that
    it says.
    """

    state: Literal["waiting", "ended", "failed"]
    done: int | None = None
    total: int | None = None
    results: int = 0
    message: str = ""
    failure: FailureKind | None = None
    batch: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class LineResult:
    """The result of one line.

    ``raw`` is what the plain endpoint would have replied, an answer (status 200) or an error, to be
    judged in the same way; None where the line was never asked and is not charged, since the batch
    expired or was cancelled before, as ``message`` says.
    """

    key: str
    raw: RawReply | None
    message: str = ""


@dataclass(frozen=True, slots=True)
class Listed:
    """A batch in the list of all batches: its mark, its beginning, and all that is said of it."""

    mark: object
    created: datetime | None
    said: dict[str, Any]


class BatchService(ABC):
    """The batch mode of one model at one endpoint; every request raises BatchFailed.

    A batch has at most ``most_bytes`` of lines. Where it takes no mark, one whose id was lost
    cannot be found. Batches are at ``path``, where ``pages`` is the query for a page of their list,
    and ``cursor`` that for the one after it. A result has the key of its request as ``key_member``.
    """

    most_bytes: ClassVar[int]
    takes_mark: ClassVar[bool] = True
    path: ClassVar[str]
    cancel_suffix: ClassVar[str] = "/cancel"
    key_member: ClassVar[str] = "custom_id"
    pages: ClassVar[str]
    cursor: ClassVar[str]

    def __init__(self, transport: HttpTransport, endpoint: Endpoint, wire: WireFormat) -> None:
        self._transport = transport
        self._endpoint = endpoint
        self._wire = wire

    @abstractmethod
    def line(self, line: BatchLine) -> bytes:
        """Return a line as it is sent, with the body as it is hashed."""

    @abstractmethod
    async def create(self, lines: Sequence[BatchLine], mark: str) -> str:
        """Create a batch of lines with different keys; returns its id.

        ``mark``, up to 64 letters, digits, _ and -, is attached where the provider takes a name.
        """

    async def find(self, mark: str, since: datetime) -> str | None:
        """Return the id of the batch with this mark, created at ``since`` (UTC) or later.

        Raises BatchFailed with the kind ``lost`` where there are too many to look through.
        """
        cursor: str | None = ""
        seen: set[str] = set()
        while cursor is not None and cursor not in seen:  # ends where a server knows no pages
            if len(seen) == MOST_PAGES or len(cursor) > LONGEST_CURSOR:
                raise BatchFailed("lost", "the list of batches cannot be read to its end")
            seen.add(cursor)
            after = f"&{self.cursor}={quote(cursor, safe='')}" if cursor else ""
            page = await self._get(f"{self.path}?{self.pages}{after}", TRANSFER_TIMEOUT_S)
            listed, cursor = self.page_of(page)
            for batch in listed:
                if batch.mark == mark:
                    return self.batch_id_of(batch.said)
            if _leads_back([batch.created for batch in listed], since):
                break
        return None

    def page_of(self, page: dict[str, Any]) -> tuple[list[Listed], str | None]:
        """Return the batches of a page of the list, and the cursor of the next one, if any."""
        raise NotImplementedError

    def batch_id_of(self, batch: dict[str, Any]) -> str:
        """Return the id of a batch as its server describes it; raises BatchFailed."""
        return id_of(batch)

    async def status(self, batch_id: str) -> BatchStatus:
        """Return the state of a batch."""
        return self.status_of(await self._get(f"{self.path}/{batch_id}", TIMEOUT_S))

    async def cancel(self, batch_id: str) -> None:
        """Ask for the end of a batch, which then ends with the results that it has.

        One that has ended already stays as it is.
        """
        path = f"{self.path}/{batch_id}{self.cancel_suffix}"
        raw = await self._ask("POST", path, timeout_s=TIMEOUT_S)
        if not _is_success(raw) and raw.status not in ENDED_ALREADY:
            raise self._unread(raw)

    @abstractmethod
    def status_of(self, batch: dict[str, Any]) -> BatchStatus:
        """Return the state of a batch as its server describes it."""

    @abstractmethod
    def result_paths(self, batch_id: str, batch: Mapping[str, Any]) -> list[str]:
        """Return where the results of a batch that has ended are: JSONL, in any order."""

    @abstractmethod
    def read(self, key: str, line: dict[str, Any]) -> LineResult | None:
        """Return the result in a line, None where it has no known form."""

    async def results(
        self, batch_id: str, status: BatchStatus, calls: int
    ) -> AsyncIterator[LineResult | Unreadable]:
        """Yield the results of a batch of so many calls that has ended, or why one cannot be read.

        Where one file cannot be read, those of the other come all the same. Raises BatchFailed with
        the kind ``again`` where they can be read from the beginning.
        """
        failure: BatchFailed | None = None
        for path in self.result_paths(batch_id, status.batch):
            try:
                async for result in self._lines(path, MOST_LINES_OF_A_CALL * calls):
                    yield result
            except BatchFailed as exc:
                failure = failure or exc
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

    async def _get(self, path: str, timeout_s: float) -> dict[str, Any]:
        """Return the JSON object at a path."""
        raw = await self._ask("GET", path, timeout_s=timeout_s)
        if not _is_success(raw):
            raise self._unread(raw)
        return json_object(raw)

    async def _post(
        self, path: str, body: bytes, headers: Mapping[str, str] | None = None
    ) -> RawReply:
        """Return the reply to a step of a creation."""
        raw = await self._ask("POST", path, body, headers, timeout_s=TRANSFER_TIMEOUT_S)
        if not _is_success(raw):
            raise self._failed(self.failure_of(raw.error), raw)
        return raw

    async def _lines(self, path: str, most: int) -> AsyncIterator[LineResult | Unreadable]:
        """Yield the results of a JSONL file of at most so many lines, blank ones included.

        One that is not there is asked for again: it belongs to a batch that is there.
        """
        number = 0
        try:
            body = self._transport.lines(path, self._wire.headers, timeout_s=TRANSFER_TIMEOUT_S)
            async with aclosing(body) as lines:
                async for line in lines:
                    number += 1
                    if number > most:
                        raise BatchFailed("single", f"there are more than {most} lines of results")
                    if line:
                        yield self._result(number, line)
        except ErrorReply as exc:
            if exc.raw.status == 404:
                raise self._failed("again", exc.raw) from exc
            raise self._unread(exc.raw) from exc
        except TransportFailure as exc:
            raise _unanswered(exc, reads=True) from exc

    def _result(self, number: int, line: str | TransportFailure) -> LineResult | Unreadable:
        """Return the result in a line."""
        if isinstance(line, TransportFailure):
            return Unreadable(f"line {number}: {line}")
        try:
            value = json.loads(line)
        except ValueError:
            return Unreadable(f"line {number} is no JSON")
        if not isinstance(value, dict):
            return Unreadable(f"line {number} is no JSON object")
        key = as_text(value.get(self.key_member))
        if not key:
            return Unreadable(f"line {number} has no {self.key_member}")
        name = as_message(key, LONGEST_NAME)
        return self.read(key, value) or Unreadable(f"the result of {name} is of no known form")

    async def _ask(
        self,
        method: str,
        path: str,
        body: bytes = b"",
        headers: Mapping[str, str] | None = None,
        *,
        timeout_s: float,
    ) -> RawReply:
        sent = {**self._wire.headers, **(headers or {})}
        most_bytes = MOST_BYTES if method == "GET" else None
        try:
            return await self._transport.ask(
                method, path, sent, body, timeout_s=timeout_s, most_bytes=most_bytes
            )
        except TransportFailure as exc:
            raise _unanswered(exc, reads=not body) from exc

    def _unread(self, raw: RawReply) -> BatchFailed:
        """Return the failure where a batch exists, or may exist, whatever its server says now."""
        if raw.status in GONE:
            return self._failed("lost", raw)
        return self._failed(JUDGED.get(judge_error(raw.error, self._wire).action, "again"), raw)

    def _failed(self, kind: FailureKind, raw: RawReply) -> BatchFailed:
        delay_s = judge_error(raw.error, self._wire).delay_s
        message = f"HTTP {raw.status}: {as_message(raw.error.message)}"
        maybe_done = raw.status >= 500 or raw.status in TOO_LATE
        if not self.takes_mark:  # it cannot be looked for: what the provider says of itself decides
            own = is_own_host(self._endpoint.provider, self._endpoint.identity)
            provider = self._endpoint.provider if own else None
            maybe_done = maybe_done and may_be_charged(raw, provider)
        return BatchFailed(kind, message, delay_s=delay_s, sent=maybe_done)


def _leads_back(created: Sequence[datetime | None], since: datetime) -> bool:
    """Whether a page of batches is older than a moment, and the next one older still."""
    known = [each for each in created if each is not None]
    return bool(known) and known[0] > known[-1] and max(known) < since - CLOCK_SLACK


def json_object(raw: RawReply) -> dict[str, Any]:
    """Return the body of a reply as a JSON object; raises BatchFailed."""
    if not isinstance(raw.payload, dict):
        raise BatchFailed("again", f"HTTP {raw.status}: the body is not a JSON object")
    return raw.payload


def as_reply(status: int, body: dict[str, Any]) -> RawReply:
    """Return the reply of the plain endpoint that a result stands for."""
    # In ASCII, since JSON can spell half of a surrogate pair, which no file can hold.
    return RawReply(status, {}, json.dumps(body))


def as_message(value: object, longest: int = LONGEST_MESSAGE) -> str:
    """Return a text for a reader in one line, empty where there is none."""
    return " ".join((as_text(value) or "").split())[:longest]


def as_word(value: object) -> str:
    """Return a provider's word for a state, in capitals."""
    return (as_text(value) or "").upper()


def id_of(reply: Mapping[str, Any], member: str = "id") -> str:
    """Return an id, which can stand in a path; raises BatchFailed."""
    value = reply.get(member)
    if not isinstance(value, str) or not ID.fullmatch(value):
        raise BatchFailed("again", f"the reply cannot be used: it has no {member} of a known form")
    return value


def moment_of(text: object) -> datetime | None:
    """Return a moment in RFC 3339, None where there is none."""
    try:
        moment = datetime.fromisoformat(str(text))
    except ValueError:
        return None
    return moment if moment.tzinfo else None


def _is_success(raw: RawReply) -> bool:
    return 200 <= raw.status < 300


def _unanswered(failure: TransportFailure, *, reads: bool) -> BatchFailed:
    """Return what no reply means; one that is refused for what it is will be no other next time."""
    kind: FailureKind = "again"
    if failure.action == "refused":
        kind = "refused"
    elif failure.action == "fail" and reads:
        kind = "lost"
    return BatchFailed(kind, str(failure), sent=failure.sent)
