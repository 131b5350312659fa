"""OpenAI's batches of files, and those of servers that speak like it."""

from __future__ import annotations

from collections.abc import AsyncIterator, Collection, Sequence
from datetime import UTC, datetime
from typing import Any
from uuid import uuid4

from merge_runner.llm.batch.exchange import (
    Exchange,
    Listing,
    Unreadable,
    as_reply,
    id_if_more,
    id_of,
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
from merge_runner.llm.content_hashes import canonical_json
from merge_runner.llm.formats.base import as_count, as_dict, as_text, first_of, read_error

# Where the files of a batch stand, whatever the base URL of the server is.
API = "/v1"
MARK = "merge_runner_mark"
# What OpenAI itself does with input files.
KEPT_S = 30 * 86400
ENDED = frozenset({"completed", "expired", "cancelled"})
NOT_ASKED = frozenset({"batch_expired", "batch_cancelled"})


def _created(batch: dict[str, Any]) -> datetime | None:
    created_s = as_count(batch.get("created_at"))
    return None if created_s is None else datetime.fromtimestamp(created_s, UTC)


LISTING = Listing("/batches?limit=100", "data", "after", id_if_more, _created)


class OpenAIBatches:
    """``/files`` and ``/batches``; see BatchService."""

    limits = BatchLimits(lines=50_000, size=200_000_000)

    def __init__(self, exchange: Exchange) -> None:
        self._exchange = exchange

    def size(self, line: BatchLine) -> int:
        """See BatchService."""
        return len(self._line(line))

    async def submit(self, lines: Sequence[BatchLine], mark: str) -> str:
        """See BatchService."""
        try:
            file_id = await self._upload(b"".join(map(self._line, lines)))
        except BatchFailed as exc:
            # Whatever became of the file, there is no batch.
            raise BatchFailed(exc.kind, str(exc), delay_s=exc.delay_s, sent=False) from exc
        batch: dict[str, Any] = {
            "input_file_id": file_id,
            "endpoint": API + lines[0].request.path,
            "completion_window": "24h",
            "metadata": {MARK: mark},
        }
        if self._exchange.endpoint.identity == "openai":  # others may not know the member
            batch["output_expires_after"] = {"anchor": "created_at", "seconds": KEPT_S}
        return id_of(await self._exchange.post("/batches", canonical_json(batch).encode()))

    async def find(
        self, mark: str, keys: Collection[str], *, since: datetime, known: Collection[str] = ()
    ) -> Found | None:
        """By the mark among its metadata."""
        async for batch in self._exchange.newest(LISTING, since):
            if as_dict(batch.get("metadata")).get(MARK) == mark:
                return Found(id_of(batch))
        return None

    async def status(self, batch_id: str) -> BatchStatus:
        """See BatchService."""
        batch = await self._batch(batch_id)
        word = as_text(batch.get("status")) or "unknown"
        counts = as_dict(batch.get("request_counts"))
        done = [as_count(counts.get(name)) for name in ("completed", "failed")]
        error = first_of(as_dict(batch.get("errors")).get("data"))
        why = read_error(400, {}, "", {"error": error})
        failed = word == "failed"
        return BatchStatus(
            state="failed" if failed else "ended" if word in ENDED else "waiting",
            word=word,
            done=sum(each or 0 for each in done) if counts else None,
            total=as_count(counts.get("total")) or None,
            message=as_text(error.get("message")) or "",
            failure=self._exchange.failure_of(why) if failed else None,
        )

    def results(self, batch_id: str) -> AsyncIterator[LineResult]:
        """See BatchService."""
        return read_results(self._lines(batch_id), _read)

    async def cancel(self, batch_id: str) -> None:
        """See BatchService."""
        await self._exchange.post(f"/batches/{batch_id}/cancel")

    async def _batch(self, batch_id: str) -> dict[str, Any]:
        return await self._exchange.get(f"/batches/{batch_id}")

    async def _upload(self, content: bytes) -> str:
        boundary = uuid4().hex
        body = b"\r\n".join(
            [
                f"--{boundary}".encode(),
                b'content-disposition: form-data; name="purpose"',
                b"",
                b"batch",
                f"--{boundary}".encode(),
                b'content-disposition: form-data; name="file"; filename="batch.jsonl"',
                b"content-type: application/jsonl",
                b"",
                content,
                f"--{boundary}--".encode(),
                b"",
            ]
        )
        form = {"content-type": f"multipart/form-data; boundary={boundary}"}
        return id_of(await self._exchange.post("/files", body, form))

    async def _lines(self, batch_id: str) -> AsyncIterator[dict[str, Any] | Unreadable]:
        batch = await self._batch(batch_id)
        answered = as_count(as_dict(batch.get("request_counts")).get("completed"))
        if answered and not batch.get("output_file_id"):
            raise BatchFailed("again", f"the results of {answered} requests are not there yet")
        for name in ("output_file_id", "error_file_id"):
            if batch.get(name):
                path = f"/files/{id_of(batch, name)}/content"
                async for line in self._exchange.lines(path):
                    yield line

    def _line(self, line: BatchLine) -> bytes:
        """A line of the file, with the body as it is hashed."""
        request = line.request
        url = canonical_json(API + request.path)
        told = self._exchange.told(line)
        text = (
            f'{{"custom_id":"{line.key}","method":"POST","url":{url},"body":{request.body}{told}}}'
        )
        return text.encode() + b"\n"


def _read(line: dict[str, Any]) -> LineResult:
    key = text_at(line, "custom_id")
    response, error = as_dict(line.get("response")), as_dict(line.get("error"))
    status, body = response.get("status_code"), response.get("body")
    if isinstance(status, int) and isinstance(body, dict):
        return LineResult(key, as_reply(status, body))
    message = as_text(error.get("message")) or ""
    if error.get("code") in NOT_ASKED:
        return LineResult(key, None, message)
    if error:
        return LineResult(key, as_reply(500, {"error": error}), message)
    raise Unreadable(f"the result of {key} has neither a response nor an error")
