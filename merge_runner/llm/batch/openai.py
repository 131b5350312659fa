"""OpenAI's batches of files, and those of servers that speak like it."""

from __future__ import annotations

from collections.abc import AsyncIterator, Collection, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from typing import Any
from uuid import uuid4

from merge_runner.config import is_own_host
from merge_runner.llm.batch.exchange import (
    Exchange,
    Line,
    Listing,
    as_message,
    as_reply,
    as_word,
    check_size,
    counted,
    id_of,
    last_if_more,
    no_batch_yet,
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
from merge_runner.llm.content_hashes import canonical_json
from merge_runner.llm.formats.base import as_count, as_dict, as_text, first_of, read_error
from merge_runner.llm.http_outcome import status_within
from merge_runner.llm.verify import LARGEST_STATUS

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


LISTING = Listing("/batches?limit=100", "data", "after", last_if_more, own_id, _created)


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
        check_size(lines, self)
        with no_batch_yet():
            file_id = await self._upload(lines)
        batch: dict[str, Any] = {
            "input_file_id": file_id,
            "endpoint": API + lines[0].request.path,
            "completion_window": "24h",
            "metadata": {MARK: mark},
        }
        if is_own_host(
            "openai", self._exchange.endpoint.identity
        ):  # others may not know the member
            batch["output_expires_after"] = {"anchor": "created_at", "seconds": KEPT_S}
        body = canonical_json(batch).encode()
        return id_of(await self._exchange.create("/batches", body, lines=lines))

    async def find(
        self, mark: str, keys: Collection[str], *, since: datetime, known: Collection[str] = ()
    ) -> Found | None:
        """By the mark among its metadata."""
        async for batch_id, batch in self._exchange.listed(LISTING, since, known):
            if as_dict(batch.get("metadata")).get(MARK) == mark:
                return Found(batch_id)
        return None

    async def status(self, batch_id: str) -> BatchStatus:
        """See BatchService."""
        batch = await self._batch(batch_id)
        word = as_word(batch.get("status"))
        counts = as_dict(batch.get("request_counts"))
        done = [as_count(counts.get(name)) for name in ("completed", "failed")]
        error = first_of(as_dict(batch.get("errors")).get("data"))
        why = read_error(400, {}, "", {"error": error})
        why = replace(why, status=status_within(why) if why.names else 400)
        failed = word.lower() == "failed"
        return BatchStatus(
            state="failed" if failed else "ended" if word.lower() in ENDED else "waiting",
            word=word,
            done=sum(each or 0 for each in done) if counts else None,
            total=as_count(counts.get("total")) or None,
            message=as_message(error.get("message")),
            failure=self._exchange.failure_of(why) if failed else None,
        )

    def results(self, batch_id: str) -> AsyncIterator[LineResult]:
        """See BatchService."""
        return read_results(partial(self._lines, batch_id), _read)

    async def cancel(self, batch_id: str) -> None:
        """See BatchService."""
        await self._exchange.cancel(f"/batches/{batch_id}/cancel")

    async def _batch(self, batch_id: str) -> dict[str, Any]:
        return await self._exchange.get(f"/batches/{batch_id}")

    async def _upload(self, lines: Sequence[BatchLine]) -> str:
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
                b"".join(map(self._line, lines)),
                f"--{boundary}--".encode(),
                b"",
            ]
        )
        form = {"content-type": f"multipart/form-data; boundary={boundary}"}
        return id_of(await self._exchange.create("/files", body, form, lines=lines))

    async def _lines(self, batch_id: str) -> AsyncIterator[Line]:
        """The lines of both files; where one cannot be read, those of the other all the same."""
        batch = await self._batch(batch_id)
        counts = as_dict(batch.get("request_counts"))
        completed = as_count(counts.get("completed")) or 0
        most = max(as_count(counts.get("total")) or self.limits.lines, completed)
        failure: BatchFailed | None = None
        for name, least in (("output_file_id", completed), ("error_file_id", 0)):
            try:
                async for line in counted(self._file(batch, name), least=least, most=most):
                    yield line
            except BatchFailed as exc:
                failure = failure or exc
        if failure is not None:
            raise failure

    async def _file(self, batch: dict[str, Any], name: str) -> AsyncIterator[Line]:
        """The lines of a file, none where a batch has no such file."""
        if batch.get(name):
            async for line in self._exchange.lines(f"/files/{id_of(batch, name)}/content"):
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
    status, body = as_count(response.get("status_code")), response.get("body")
    if status and status <= LARGEST_STATUS and isinstance(body, dict):
        return LineResult(key, as_reply(status, body))
    message = as_message(error.get("message"))
    if as_text(error.get("code")) in NOT_ASKED:
        return LineResult(key, None, message)
    if error:
        return LineResult(key, as_reply(500, {"error": error}), message)
    raise unreadable(key, "has neither a response nor an error")
