"""Anthropic's message batches."""

from __future__ import annotations

from collections.abc import AsyncGenerator, AsyncIterator, Collection, Sequence
from contextlib import aclosing
from datetime import datetime
from functools import partial
from typing import Any

from merge_runner.llm.batch.exchange import (
    Exchange,
    Line,
    Listing,
    as_reply,
    as_word,
    check_size,
    counted,
    id_of,
    last_if_more,
    moment_of,
    own_id,
    read_results,
    text_at,
    unreadable,
)
from merge_runner.llm.batch.service import (
    BatchFailed,
    BatchLimits,
    BatchLine,
    BatchStatus,
    Found,
    LineResult,
)
from merge_runner.llm.formats.base import as_count, as_dict, as_text

BATCHES = "/v1/messages/batches"
OPENING, CLOSING = b'{"requests":[', b"]}"
# The status with which the plain endpoint sends an error, by its type: a result has none.
STATUSES = {
    "invalid_request_error": 400,
    "authentication_error": 401,
    "billing_error": 402,
    "permission_error": 403,
    "not_found_error": 404,
    "conflict_error": 409,
    "request_too_large": 413,
    "rate_limit_error": 429,
    "api_error": 500,
    "timeout_error": 504,
    "overloaded_error": 529,
}


def _created(batch: dict[str, Any]) -> datetime | None:
    return moment_of(batch.get("created_at"))


LISTING = Listing(f"{BATCHES}?limit=100", "data", "after_id", last_if_more, own_id, _created)


class AnthropicBatches:
    """``/v1/messages/batches``, with all requests in the body; see BatchService."""

    # What stands around the lines counts as well.
    limits = BatchLimits(lines=100_000, size=256_000_000 - len(OPENING + CLOSING))

    def __init__(self, exchange: Exchange) -> None:
        self._exchange = exchange

    def size(self, line: BatchLine) -> int:
        """See BatchService."""
        return len(self._line(line)) + 1

    async def submit(self, lines: Sequence[BatchLine], mark: str) -> str:
        """See BatchService; a batch takes no name, so that the mark is not sent."""
        check_size(lines, self)
        body = OPENING + b",".join(map(self._line, lines)) + CLOSING
        return id_of(await self._exchange.create(BATCHES, body, lines=lines))

    async def find(
        self, mark: str, keys: Collection[str], *, since: datetime, known: Collection[str] = ()
    ) -> Found | None:
        """By a key among its results: of those that have not ended, by the number of requests.

        Nothing that the service tells of a batch in progress names its requests.
        """
        possible = None
        async for batch_id, batch in self._exchange.listed(LISTING, since, known):
            if sum(_counts(batch).values()) != len(keys):
                continue
            if not batch.get("results_url"):
                possible = possible or Found(batch_id, sure=False)
            elif await self._has_one_of(keys, batch_id):
                return Found(batch_id)
        return possible

    async def status(self, batch_id: str) -> BatchStatus:
        """See BatchService."""
        batch = await self._exchange.get(f"{BATCHES}/{batch_id}")
        counts = _counts(batch)
        word = as_word(batch.get("processing_status"))
        ended = word.lower() == "ended"
        total = sum(counts.values())
        return BatchStatus(
            state="ended" if ended else "waiting",
            word=word,
            # While a batch is in progress all its requests count as such.
            done=total - counts.get("processing", 0) if ended else None,
            total=total or None,
        )

    def results(self, batch_id: str) -> AsyncGenerator[LineResult, None]:
        """See BatchService."""
        return read_results(partial(self._lines, batch_id), _read)

    async def cancel(self, batch_id: str) -> None:
        """See BatchService."""
        await self._exchange.cancel(f"{BATCHES}/{batch_id}/cancel")

    async def _lines(self, batch_id: str) -> AsyncIterator[Line]:
        batch = await self._exchange.get(f"{BATCHES}/{batch_id}")
        if batch.get("archived_at"):
            raise BatchFailed("lost", "the results of the batch are no longer kept")
        total = sum(_counts(batch).values())
        # Not at the URL that the batch names: the key goes to the configured host alone.
        lines = self._exchange.lines(f"{BATCHES}/{batch_id}/results")
        async for line in counted(lines, least=total, most=total or self.limits.lines):
            yield line

    async def _has_one_of(self, keys: Collection[str], batch_id: str) -> bool:
        """Whether the first result of a batch, which stands for all, is of one of the keys."""
        try:
            async with aclosing(self.results(batch_id)) as results:
                async for result in results:
                    return result.key in keys
        except BatchFailed as exc:
            if exc.kind not in ("single", "lost"):
                raise
        return False

    def _line(self, line: BatchLine) -> bytes:
        told = self._exchange.told(line)
        return f'{{"custom_id":"{line.key}","params":{line.request.body}{told}}}'.encode()


def _counts(batch: dict[str, Any]) -> dict[str, int]:
    counts = as_dict(batch.get("request_counts"))
    return {name: as_count(count) or 0 for name, count in counts.items()}


def _read(line: dict[str, Any]) -> LineResult:
    key = text_at(line, "custom_id")
    result = as_dict(line.get("result"))
    match result.get("type"):
        case "succeeded":
            return LineResult(key, as_reply(200, as_dict(result.get("message"))))
        case "errored":
            error = as_dict(result.get("error"))
            kind = as_text(as_dict(error.get("error")).get("type")) or ""
            return LineResult(key, as_reply(STATUSES.get(kind, 500), error))
        case "expired" | "canceled" as why:
            return LineResult(key, None, f"the batch {'has expired' if why == 'expired' else why}")
    raise unreadable(key, "is of no known type")
