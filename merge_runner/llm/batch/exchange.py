"""What all batch modes share: requests to them, their errors, and the reading of results."""

from __future__ import annotations

import json
import re
from collections.abc import (
    AsyncGenerator,
    AsyncIterator,
    Callable,
    Collection,
    Iterator,
    Mapping,
    Sequence,
)
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import TYPE_CHECKING, Any, TypeAlias
from urllib.parse import quote

from merge_runner.config import Endpoint
from merge_runner.llm.batch.service import (
    BatchFailed,
    BatchLine,
    BatchService,
    FailureKind,
    LineResult,
)
from merge_runner.llm.content_hashes import canonical_json
from merge_runner.llm.formats.base import ServerError, WireFormat, as_dicts, as_text
from merge_runner.llm.http_outcome import (
    TOO_LATE,
    ErrorReply,
    RawReply,
    TransportFailure,
    judge_error,
)
from merge_runner.records import ATTEMPT_HEADER, SLOT_HEADER

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
TOO_MANY_TOKENS = frozenset({"token_limit_exceeded"})
ID = re.compile(r"(?!.*\.\.)[A-Za-z0-9_-][A-Za-z0-9_./-]{0,999}")
# By how much a server's clock may be behind ours.
CLOCK_SLACK = timedelta(hours=1)
MOST_PAGES, LONGEST_CURSOR = 100, 2000
LONGEST_MESSAGE, LONGEST_NAME = 500, 80


class Unreadable(ValueError):
    """A result that cannot be used; the message says why."""


Line: TypeAlias = dict[str, Any] | Unreadable
"""An object of a JSONL file, or why there is none."""


@dataclass(frozen=True, slots=True)
class Listing:
    """How batches are listed: at ``path``, a page in ``member``, the next by the query ``after``.

    ``cursor`` is what stands for the next page, by a page and its batches; None: it is the last.
    ``batch_id`` and ``created`` are those of a batch, None where the server tells none.
    """

    path: str
    member: str
    after: str
    cursor: Callable[[dict[str, Any], Sequence[dict[str, Any]]], str | None]
    batch_id: Callable[[dict[str, Any]], str | None]
    created: Callable[[dict[str, Any]], datetime | None]


@dataclass(frozen=True, slots=True)
class Exchange:
    """Requests to the batch mode of an endpoint."""

    transport: HttpTransport
    endpoint: Endpoint
    wire: WireFormat

    async def get(self, path: str, *, timeout_s: float = TIMEOUT_S) -> dict[str, Any]:
        """The JSON object at a path; raises BatchFailed."""
        raw = await self._ask("GET", path, timeout_s=timeout_s, most_bytes=MOST_BYTES)
        if not _is_success(raw):
            raise self._unread(raw)
        return _object(raw)

    async def create(
        self,
        path: str,
        body: bytes,
        headers: Mapping[str, str] | None = None,
        *,
        lines: Sequence[BatchLine],
    ) -> dict[str, Any]:
        """The JSON object with which a step of a creation is answered; raises BatchFailed."""
        return _object(await self.step(path, body, headers, lines=lines))

    async def step(
        self,
        path: str,
        body: bytes,
        headers: Mapping[str, str] | None = None,
        *,
        lines: Sequence[BatchLine],
    ) -> RawReply:
        """The reply to a step of the creation of a batch with these lines; raises BatchFailed."""
        raw = await self._ask("POST", path, body, headers, timeout_s=TRANSFER_TIMEOUT_S)
        if _is_success(raw):
            return raw
        kind = self.failure_of(raw.error)
        if raw.status == 413 and len(lines) == 1:
            kind = "single"
        raise self._failed(kind, raw)

    async def cancel(self, path: str) -> None:
        """Ask for an end; one that has come already is none of the errors. Raises BatchFailed."""
        raw = await self._ask("POST", path, timeout_s=TIMEOUT_S)
        if not _is_success(raw) and raw.status not in ENDED_ALREADY:
            raise self._unread(raw)

    async def lines(self, path: str) -> AsyncIterator[Line]:
        """The objects of a JSONL file, or why one of them cannot be read; raises BatchFailed.

        One that is not there is asked for again: it belongs to a batch that is there.
        """
        number = 0
        headers = self.wire.headers
        try:
            async for line in self.transport.lines(path, headers, timeout_s=TRANSFER_TIMEOUT_S):
                number += 1
                yield _parsed(number, line)
        except ErrorReply as exc:
            if exc.raw.status == 404:
                raise self._failed("again", exc.raw) from exc
            raise self._unread(exc.raw) from exc
        except TransportFailure as exc:
            raise _unanswered(exc, reads=True) from exc

    async def listed(
        self, listing: Listing, since: datetime, known: Collection[str]
    ) -> AsyncIterator[tuple[str, dict[str, Any]]]:
        """The batches created since a moment, but for the known ones, with their ids.

        They may be listed in any order. Raises BatchFailed, with the kind ``lost`` where there are
        more than can be looked through.
        """
        earliest = since - CLOCK_SLACK
        following = ""
        seen: set[str] = set()
        while following not in seen:  # not for ever where a server knows no pages
            if len(seen) == MOST_PAGES:
                raise BatchFailed("lost", f"the batches fill more than {MOST_PAGES} pages")
            seen.add(following)
            page = await self.get(listing.path + following, timeout_s=TRANSFER_TIMEOUT_S)
            batches = as_dicts(page.get(listing.member))
            moments = [listing.created(batch) for batch in batches]
            for batch, moment in zip(batches, moments, strict=True):
                batch_id = listing.batch_id(batch)
                recent = moment is None or moment >= earliest
                if recent and batch_id is not None and batch_id not in known:
                    yield batch_id, batch
            cursor = listing.cursor(page, batches)
            if cursor is None or _leads_back_from(earliest, moments):
                return
            if len(cursor) > LONGEST_CURSOR:
                raise BatchFailed("lost", "the list of batches names no page that can be asked for")
            following = f"&{listing.after}={quote(cursor, safe='')}"

    def failure_of(self, error: ServerError) -> FailureKind:
        """What to do with lines whose batch is not created, or fails as a whole."""
        if error.names & TOO_MANY_TOKENS or "enqueued" in error.message.lower():
            return "smaller"
        if error.status == 413:
            return "smaller"
        if error.status in NO_BATCH_MODE:
            return "single"
        return self._judged(error) or "single"

    async def _ask(
        self,
        method: str,
        path: str,
        body: bytes = b"",
        headers: Mapping[str, str] | None = None,
        *,
        timeout_s: float,
        most_bytes: int | None = None,
    ) -> RawReply:
        sent = {**self.wire.headers, **(headers or {})}
        try:
            return await self.transport.ask(
                method, path, sent, body, timeout_s=timeout_s, most_bytes=most_bytes
            )
        except TransportFailure as exc:
            raise _unanswered(exc, reads=not body) from exc

    def _unread(self, raw: RawReply) -> BatchFailed:
        """The failure where a batch exists, or may exist, whatever its server says of it now."""
        if raw.status in GONE:
            return self._failed("lost", raw)
        return self._failed(self._judged(raw.error) or "again", raw)

    def _judged(self, error: ServerError) -> FailureKind | None:
        """What the judgement of single calls means here; None: nothing."""
        match judge_error(error, self.wire).action:
            case "quota":
                return "quota"
            case "refused":
                return "refused"
            case "retry":
                return "again"
        return None

    def _failed(self, kind: FailureKind, raw: RawReply) -> BatchFailed:
        delay_s = judge_error(raw.error, self.wire).delay_s
        message = f"HTTP {raw.status}: {as_message(raw.error.message)}"
        maybe_done = raw.status >= 500 or raw.status in TOO_LATE
        return BatchFailed(kind, message, delay_s=delay_s, sent=maybe_done)

    def told(self, line: BatchLine) -> str:
        """What our own emulator alone is told of a line, as members of its JSON object."""
        if not self.endpoint.is_emulator:
            return ""
        slot = canonical_json(line.request.slot.as_dict())
        return f',"{SLOT_HEADER}":{slot},"{ATTEMPT_HEADER}":{line.attempt}'


async def read_results(
    lines: Callable[[], AsyncIterator[Line]], read: Callable[[dict[str, Any]], LineResult]
) -> AsyncGenerator[LineResult, None]:
    """Every key's first result; raises BatchFailed.

    Where some cannot be used all are read once more: they may have been broken on their way.
    """
    given: set[str] = set()
    wrong, why = 0, ""
    for _ in range(2):
        seen: set[str] = set()
        wrong, why = 0, ""
        async for line in lines():
            try:
                result = _result(line, read, seen)
            except Unreadable as exc:
                wrong, why = wrong + 1, why or str(exc)
                continue
            seen.add(result.key)
            if result.key not in given:
                given.add(result.key)
                yield result
        if not wrong:
            return
    which = "a result of the batch" if wrong == 1 else f"{wrong} results of the batch"
    raise BatchFailed("single", f"{which} cannot be used: {why}")


async def counted(lines: AsyncIterator[Line], *, least: int, most: int) -> AsyncIterator[Line]:
    """The same lines; raises BatchFailed where there are fewer or more than there can be."""
    count = 0
    async for line in lines:
        count += 1
        if count > most:
            raise BatchFailed("single", f"the batch of {most} requests has more results than that")
        yield line
    if count < least:
        raise BatchFailed("again", f"{count} of the {least} results are there")


@contextmanager
def no_batch_yet() -> Iterator[None]:
    """Let errors say that no batch was created, whatever became of its file."""
    try:
        yield
    except BatchFailed as exc:
        raise BatchFailed(exc.kind, str(exc), delay_s=exc.delay_s, sent=False) from exc


def check_size(lines: Sequence[BatchLine], service: BatchService) -> None:
    """Raise BatchFailed where a line is too large for any batch."""
    if len(lines) == 1 and service.size(lines[0]) > service.limits.size:
        message = f"a request is larger than a batch, of {service.limits.size / 1e6:g} MB, may be"
        raise BatchFailed("single", message, sent=False)


def as_reply(status: int, body: dict[str, Any]) -> RawReply:
    """The reply of the plain endpoint that a result stands for."""
    # In ASCII, since JSON can spell half of a surrogate pair, which no file can hold.
    return RawReply(status, {}, json.dumps(body))


def as_message(value: object, longest: int = LONGEST_MESSAGE) -> str:
    """A text for a reader in one line, empty where there is none."""
    return " ".join((as_text(value) or "").split())[:longest]


def as_word(value: object) -> str:
    """A provider's word for a state."""
    return as_message(value, LONGEST_NAME) or "unknown"


def text_at(value: dict[str, Any], member: str) -> str:
    """A member that must be a text; raises Unreadable."""
    text = as_text(value.get(member))
    if not text:
        raise Unreadable(f"it has no {member}")
    return text


def unreadable(key: str, why: str) -> Unreadable:
    """The error of a result whose key is known."""
    return Unreadable(f"the result of {as_message(key, LONGEST_NAME)} {why}")


def as_id(value: object) -> str | None:
    """An id that can stand in a path, None where there is none."""
    return value if isinstance(value, str) and ID.fullmatch(value) else None


def id_of(reply: dict[str, Any], member: str = "id") -> str:
    """An id, which can stand in a path; raises BatchFailed."""
    told = as_id(reply.get(member))
    if told is None:
        raise BatchFailed("again", f"the reply cannot be used: it has no {member} of a known form")
    return told


def own_id(batch: dict[str, Any]) -> str | None:
    """The id of a listed batch."""
    return as_id(batch.get("id"))


def last_if_more(page: dict[str, Any], batches: Sequence[dict[str, Any]]) -> str | None:
    """The last id of a page that is not the last one."""
    if not page.get("has_more"):
        return None
    return as_text(page.get("last_id")) or (own_id(batches[-1]) if batches else None)


def moment_of(text: object) -> datetime | None:
    """A moment in RFC 3339, None where there is none."""
    try:
        moment = datetime.fromisoformat(str(text))
    except ValueError:
        return None
    return moment if moment.tzinfo else None


def _is_success(raw: RawReply) -> bool:
    return 200 <= raw.status < 300


def _object(raw: RawReply) -> dict[str, Any]:
    if not isinstance(raw.payload, dict):
        raise BatchFailed("again", f"HTTP {raw.status}: the body is not a JSON object")
    return raw.payload


def _leads_back_from(moment: datetime, created: Sequence[datetime | None]) -> bool:
    """Whether a page is older than a moment, and what follows older still."""
    known = [each for each in created if each is not None]
    return bool(known) and known[0] > known[-1] and max(known) < moment


def _parsed(number: int, line: str | TransportFailure) -> Line:
    if isinstance(line, TransportFailure):
        return Unreadable(f"line {number}: {line}")
    try:
        value = json.loads(line)
    except ValueError:
        return Unreadable(f"line {number} is no JSON")
    return value if isinstance(value, dict) else Unreadable(f"line {number} is no JSON object")


def _result(
    line: Line, read: Callable[[dict[str, Any]], LineResult], seen: Collection[str]
) -> LineResult:
    if isinstance(line, Unreadable):
        raise line
    result = read(line)
    if result.key in seen:
        raise Unreadable(f"there is another result of {as_message(result.key, LONGEST_NAME)}")
    return result


def _unanswered(failure: TransportFailure, *, reads: bool) -> BatchFailed:
    """What no reply means; one that is refused for what it is will be no other next time."""
    kind: FailureKind = "again"
    if failure.action == "refused":
        kind = "refused"
    elif failure.action == "fail" and reads:
        kind = "lost"
    return BatchFailed(kind, str(failure), sent=failure.sent)
