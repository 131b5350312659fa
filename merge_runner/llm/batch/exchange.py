"""What all batch modes share: requests to them, their errors, and the reading of results."""

from __future__ import annotations

import json
import re
from collections.abc import AsyncIterator, Callable, Mapping
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from merge_runner.config import Endpoint
from merge_runner.llm.batch.service import BatchFailed, BatchLine, FailureKind, LineResult
from merge_runner.llm.content_hashes import canonical_json
from merge_runner.llm.formats.base import ServerError, WireFormat, as_dicts, as_text
from merge_runner.llm.http_outcome import TOO_LATE, RawReply, judge_error
from merge_runner.llm.transport import ErrorReply, TransportFailure
from merge_runner.records import ATTEMPT_HEADER, SLOT_HEADER

if TYPE_CHECKING:
    from merge_runner.llm.http import HttpTransport

TIMEOUT_S = 60.0
# A batch may have 256 MB on its way up.
UPLOAD_TIMEOUT_S = 900.0
# The results of an inline batch of Gemini come in one body.
MOST_BYTES = 256_000_000
# What a server answers that has no batch mode, or none for the model.
NO_BATCH_MODE = frozenset({404, 405, 501})
TOO_MANY_TOKENS = frozenset({"token_limit_exceeded"})
ID = re.compile(r"(?!.*\.\.)[A-Za-z0-9_-][A-Za-z0-9_./-]{0,199}")
# By how much a server's clock may be behind ours.
CLOCK_SLACK = timedelta(hours=1)


class Unreadable(ValueError):
    """A result that cannot be used; the message says why."""


@dataclass(frozen=True, slots=True)
class Listing:
    """How batches are listed: at ``path``, a page in ``member``, the next by the query ``after``.

    ``cursor`` is what stands for the next page, by a page and its last batch; None: it is the last.
    """

    path: str
    member: str
    after: str
    cursor: Callable[[dict[str, Any], dict[str, Any]], str | None]
    created: Callable[[dict[str, Any]], datetime | None]


@dataclass(frozen=True, slots=True)
class Exchange:
    """Requests to the batch mode of an endpoint; ``headers`` go with each."""

    transport: HttpTransport
    endpoint: Endpoint
    wire: WireFormat
    headers: Mapping[str, str] = field(default_factory=dict)

    async def get(self, path: str) -> dict[str, Any]:
        """The JSON object at a path; raises BatchFailed."""
        return _object(await self.ask("GET", path, most_bytes=MOST_BYTES))

    async def post(
        self, path: str, body: bytes = b"", headers: Mapping[str, str] | None = None
    ) -> dict[str, Any]:
        """The JSON object with which a request is answered; raises BatchFailed."""
        return _object(await self.ask("POST", path, body, headers))

    async def ask(
        self,
        method: str,
        path: str,
        body: bytes = b"",
        headers: Mapping[str, str] | None = None,
        *,
        most_bytes: int | None = None,
    ) -> RawReply:
        """A reply of status 2xx; raises BatchFailed."""
        try:
            raw = await self.transport.ask(
                method,
                path,
                {**self.headers, **(headers or {})},
                body,
                timeout_s=UPLOAD_TIMEOUT_S if body else TIMEOUT_S,
                most_bytes=most_bytes,
            )
        except TransportFailure as exc:
            raise _unanswered(exc) from exc
        if not 200 <= raw.status < 300:
            raise self._refusal(raw)
        return raw

    async def lines(self, path: str) -> AsyncIterator[dict[str, Any] | Unreadable]:
        """The objects of a JSONL file, or why one of them cannot be read; raises BatchFailed."""
        number = 0
        try:
            async for line in self.transport.lines(path, self.headers, timeout_s=TIMEOUT_S):
                number += 1
                yield _parsed(number, line)
        except ErrorReply as exc:
            raise self._refusal(exc.raw) from exc
        except TransportFailure as exc:
            raise _unanswered(exc) from exc

    async def newest(self, listing: Listing, since: datetime) -> AsyncIterator[dict[str, Any]]:
        """The batches created since a moment, as they are listed: the newest first."""
        following, seen = "", set()
        while following not in seen:  # not for ever where a server knows no pages
            seen.add(following)
            page = await self.get(listing.path + following)
            batches = as_dicts(page.get(listing.member))
            for batch in batches:
                created = listing.created(batch)
                if created is not None and created < since - CLOCK_SLACK:
                    return
                yield batch
            cursor = listing.cursor(page, batches[-1]) if batches else None
            if cursor is None:
                return
            following = f"&{listing.after}={quote(cursor)}"

    def failure_of(self, error: ServerError) -> FailureKind:
        """What to do after an error that a batch mode reports."""
        if error.names & TOO_MANY_TOKENS or "enqueued" in error.message.lower():
            return "smaller"
        if error.status == 413:
            return "smaller"
        if error.status in NO_BATCH_MODE:
            return "single"
        match judge_error(error, self.wire).action:
            case "quota":
                return "quota"
            case "refused":
                return "refused"
            case "retry":
                return "again"
        return "single"

    def _refusal(self, raw: RawReply) -> BatchFailed:
        delay_s = judge_error(raw.error, self.wire).delay_s
        message = f"HTTP {raw.status}: {raw.error.message}"
        maybe_done = raw.status >= 500 or raw.status in TOO_LATE
        return BatchFailed(self.failure_of(raw.error), message, delay_s=delay_s, sent=maybe_done)

    def told(self, line: BatchLine) -> str:
        """What our own emulator alone is told of a line, as members of its JSON object."""
        if self.endpoint.provider != "emulator":
            return ""
        slot = canonical_json(line.request.slot.as_dict())
        return f',"{SLOT_HEADER}":{slot},"{ATTEMPT_HEADER}":{line.attempt}'


async def read_results(
    lines: AsyncIterator[dict[str, Any] | Unreadable],
    read: Callable[[dict[str, Any]], LineResult],
) -> AsyncIterator[LineResult]:
    """Every key's first result; then raises BatchFailed where others could not be used."""
    seen: set[str] = set()
    wrong: list[str] = []
    async for line in lines:
        try:
            if isinstance(line, Unreadable):
                raise line
            result = read(line)
            if result.key in seen:
                raise Unreadable(f"there is another result of {result.key}")
        except Unreadable as exc:
            wrong.append(str(exc))
            continue
        seen.add(result.key)
        yield result
    if wrong:
        which = "a result of the batch" if len(wrong) == 1 else f"{len(wrong)} results of the batch"
        raise BatchFailed("single", f"{which} cannot be used: {wrong[0]}")


def as_reply(status: int, body: dict[str, Any]) -> RawReply:
    """The reply of the plain endpoint that a result stands for."""
    # In ASCII, since JSON can spell half of a surrogate pair, which no file can hold.
    return RawReply(status, {}, json.dumps(body))


def text_at(value: dict[str, Any], member: str) -> str:
    """A member that must be a text; raises Unreadable."""
    text = as_text(value.get(member))
    if not text:
        raise Unreadable(f"it has no {member}")
    return text


def id_of(reply: dict[str, Any], member: str = "id") -> str:
    """An id, which can stand in a path; raises BatchFailed."""
    told = reply.get(member)
    if not isinstance(told, str) or not ID.fullmatch(told):
        raise BatchFailed("again", f"the reply cannot be used: it has no {member} of a known form")
    return told


def id_if_more(page: dict[str, Any], last: dict[str, Any]) -> str | None:
    """The last id of a page that is not the last one."""
    return id_of(last) if page.get("has_more") else None


def moment_of(text: object) -> datetime | None:
    """A moment in RFC 3339, None where there is none."""
    try:
        moment = datetime.fromisoformat(str(text))
    except ValueError:
        return None
    return moment if moment.tzinfo else None


def _object(raw: RawReply) -> dict[str, Any]:
    if not isinstance(raw.payload, dict):
        raise BatchFailed("again", f"HTTP {raw.status}: the body is not a JSON object")
    return raw.payload


def _parsed(number: int, line: str | TransportFailure) -> dict[str, Any] | Unreadable:
    if isinstance(line, TransportFailure):
        return Unreadable(f"line {number}: {line}")
    try:
        value = json.loads(line)
    except ValueError:
        return Unreadable(f"line {number} is no JSON")
    return value if isinstance(value, dict) else Unreadable(f"line {number} is no JSON object")


def _unanswered(failure: TransportFailure) -> BatchFailed:
    kind: FailureKind = "refused" if failure.action == "refused" else "again"
    return BatchFailed(kind, str(failure), sent=failure.sent)
