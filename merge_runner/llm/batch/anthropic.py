"""Anthropic's message batches."""

from __future__ import annotations

from collections.abc import AsyncIterator, Collection, Sequence
from datetime import datetime
from typing import Any

from merge_runner.llm.batch.exchange import (
    Exchange,
    Listing,
    Unreadable,
    as_reply,
    id_if_more,
    id_of,
    moment_of,
    read_results,
    text_at,
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


LISTING = Listing(f"{BATCHES}?limit=100", "data", "after_id", id_if_more, _created)


class AnthropicBatches:
    """``/v1/messages/batches``, with all requests in the body; see BatchService."""

    limits = BatchLimits(lines=100_000, size=256_000_000)

    def __init__(self, exchange: Exchange) -> None:
        self._exchange = exchange

    def size(self, line: BatchLine) -> int:
        """See BatchService."""
        return len(self._line(line)) + 1

    async def submit(self, lines: Sequence[BatchLine], mark: str) -> str:
        """See BatchService; a batch takes no name, so that the mark is not sent."""
        body = b'{"requests":[' + b",".join(map(self._line, lines)) + b"]}"
        return id_of(await self._exchange.post(BATCHES, body))

    async def find(
        self, mark: str, keys: Collection[str], *, since: datetime, known: Collection[str] = ()
    ) -> Found | None:
        """By a key among its results: of those that have not ended, by the number of requests.

        Nothing that the service tells of a batch in progress names its requests.
        """
        possible = None
        async for batch in self._exchange.newest(LISTING, since):
            batch_id = id_of(batch)
            if batch_id in known or sum(_counts(batch).values()) != len(keys):
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
        word = as_text(batch.get("processing_status")) or "unknown"
        total = sum(counts.values())
        return BatchStatus(
            state="ended" if word == "ended" else "waiting",
            word=word,
            # While a batch is in progress all its requests count as such.
            done=total - counts.get("processing", 0) if word == "ended" else None,
            total=total or None,
        )

    def results(self, batch_id: str) -> AsyncIterator[LineResult]:
        """See BatchService."""
        # Not at the URL that the batch names: the key goes to the configured host alone.
        return read_results(self._exchange.lines(f"{BATCHES}/{batch_id}/results"), _read)

    async def cancel(self, batch_id: str) -> None:
        """See BatchService."""
        await self._exchange.post(f"{BATCHES}/{batch_id}/cancel")

    async def _has_one_of(self, keys: Collection[str], batch_id: str) -> bool:
        """Whether the first result of a batch, which stands for all, is of one of the keys."""
        try:
            async for result in self.results(batch_id):
                return result.key in keys
        except BatchFailed as exc:
            if exc.kind != "single":
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
            kind = str(as_dict(error.get("error")).get("type"))
            return LineResult(key, as_reply(STATUSES.get(kind, 500), error))
        case "expired" | "canceled" as why:
            return LineResult(key, None, f"the batch {'has expired' if why == 'expired' else why}")
    raise Unreadable(f"the result of {key} is of no known type")
