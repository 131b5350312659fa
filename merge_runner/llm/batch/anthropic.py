"""Anthropic's message batches."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from merge_runner.llm.batch.service import (
    BatchFailed,
    BatchLine,
    BatchService,
    BatchStatus,
    LineResult,
    as_reply,
    as_word,
)
from merge_runner.llm.formats.base import as_count, as_dict, as_text

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


class AnthropicBatches(BatchService):
    """``/v1/messages/batches``, with all requests in the body; see BatchService."""

    takes_mark = False
    path = "/v1/messages/batches"

    def line(self, line: BatchLine) -> bytes:
        """See BatchService."""
        slot = self.slot_members(line)
        return f'{{"custom_id":"{line.key}","params":{line.request.body}{slot}}}'.encode()

    def creation(self, lines: Sequence[BatchLine], file: str, mark: str) -> tuple[str, bytes]:
        """See BatchService; a batch takes no name, so that the mark is not sent."""
        return self.path, b'{"requests":[' + b",".join(map(self.line, lines)) + b"]}"

    def status_of(self, batch: dict[str, Any]) -> BatchStatus:
        """See BatchService."""
        ended = as_word(batch.get("processing_status")) == "ENDED"
        counts = as_dict(batch.get("request_counts")).values()
        total = sum(as_count(count) or 0 for count in counts)
        return BatchStatus("ended" if ended else "waiting", total, batch=batch)

    def result_paths(self, batch_id: str, batch: Mapping[str, Any]) -> list[str]:
        """See BatchService."""
        if batch.get("archived_at"):
            raise BatchFailed("lost", "the results of the batch are no longer kept")
        # Not at the URL that the batch names: the key goes to the configured host alone.
        return [f"{self.path}/{batch_id}/results"]

    def read(self, key: str, line: dict[str, Any]) -> LineResult | None:
        """See BatchService."""
        result = as_dict(line.get("result"))
        match result.get("type"):
            case "succeeded":
                return LineResult(key, as_reply(200, as_dict(result.get("message"))))
            case "errored":
                error = as_dict(result.get("error"))
                kind = as_text(as_dict(error.get("error")).get("type")) or ""
                return LineResult(key, as_reply(STATUSES.get(kind, 500), error))
            case "expired" | "canceled" as why:
                return LineResult(key, None, f"its result is {why!r}")
        return None
