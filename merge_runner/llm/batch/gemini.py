"""Gemini's batchGenerateContent, with the requests in the body or in a file."""

from __future__ import annotations

from collections.abc import AsyncIterator, Collection, Sequence
from datetime import datetime
from typing import Any
from urllib.parse import urlsplit

from merge_runner.llm.batch.exchange import (
    Exchange,
    Listing,
    Unreadable,
    as_reply,
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
from merge_runner.llm.content_hashes import canonical_json
from merge_runner.llm.formats.base import as_count, as_dict, as_dicts, as_text, read_error

API = "/v1beta"
METHOD, BATCH_METHOD = ":generateContent", ":batchGenerateContent"
# The whole request may have 20 MB, and all its results come in one body, which has bounds too.
MOST_INLINE, MOST_INLINE_LINES = 19_000_000, 1000
ENDED = frozenset({"SUCCEEDED", "PARTIALLY_SUCCEEDED", "CANCELLED", "EXPIRED"})
# The HTTP status of an error by its code (google/rpc/code.proto), and its name.
CODES = {
    1: (499, "CANCELLED"),
    2: (500, "UNKNOWN"),
    3: (400, "INVALID_ARGUMENT"),
    4: (504, "DEADLINE_EXCEEDED"),
    5: (404, "NOT_FOUND"),
    7: (403, "PERMISSION_DENIED"),
    8: (429, "RESOURCE_EXHAUSTED"),
    9: (400, "FAILED_PRECONDITION"),
    10: (409, "ABORTED"),
    13: (500, "INTERNAL"),
    14: (503, "UNAVAILABLE"),
    16: (401, "UNAUTHENTICATED"),
}
NOT_ASKED = frozenset({"CANCELLED"})


def _created(batch: dict[str, Any]) -> datetime | None:
    return moment_of(as_dict(batch.get("metadata")).get("createTime"))


def _next_page(page: dict[str, Any], last: dict[str, Any]) -> str | None:
    return as_text(page.get("nextPageToken")) or None


LISTING = Listing(f"{API}/batches?pageSize=100", "operations", "pageToken", _next_page, _created)


class GeminiBatches:
    """``models/MODEL:batchGenerateContent`` and ``batches``; see BatchService."""

    # A file may have 2 GB, but this one is held in memory.
    limits = BatchLimits(lines=100_000, size=200_000_000)

    def __init__(self, exchange: Exchange) -> None:
        self._exchange = exchange

    def size(self, line: BatchLine) -> int:
        """See BatchService."""
        return len(self._inline(line)) + 1

    async def submit(self, lines: Sequence[BatchLine], mark: str) -> str:
        """See BatchService."""
        inline = b",".join(map(self._inline, lines))
        if len(inline) <= MOST_INLINE and len(lines) <= MOST_INLINE_LINES:
            source = b'{"requests":{"requests":[' + inline + b"]}}"
        else:
            source = canonical_json({"fileName": await self._uploaded(lines, mark)}).encode()
        body = b'{"batch":{"displayName":"' + mark.encode() + b'","inputConfig":' + source + b"}}"
        path = lines[0].request.path.replace(METHOD, BATCH_METHOD)
        return _number(id_of(await self._exchange.post(path, body), "name"))

    async def find(
        self, mark: str, keys: Collection[str], *, since: datetime, known: Collection[str] = ()
    ) -> Found | None:
        """By the mark, which is its display name."""
        async for batch in self._exchange.newest(LISTING, since):
            if as_dict(batch.get("metadata")).get("displayName") == mark:
                return Found(_number(id_of(batch, "name")))
        return None

    async def status(self, batch_id: str) -> BatchStatus:
        """See BatchService."""
        batch = await self._batch(batch_id)
        metadata, error = as_dict(batch.get("metadata")), as_dict(batch.get("error"))
        word = _state(metadata)
        stats = as_dict(metadata.get("batchStats"))
        total, pending = _count(stats, "requestCount"), _count(stats, "pendingRequestCount")
        failed = word == "FAILED"
        return BatchStatus(
            state="failed" if failed else "ended" if word in ENDED else "waiting",
            word=word,
            done=None if total is None else total - (pending or 0),
            total=total,
            message=as_text(error.get("message")) or "",
            failure=self._exchange.failure_of(read_error(400, {}, "", batch)) if failed else None,
        )

    def results(self, batch_id: str) -> AsyncIterator[LineResult]:
        """See BatchService."""
        return read_results(self._lines(batch_id), _read)

    async def cancel(self, batch_id: str) -> None:
        """See BatchService."""
        await self._exchange.post(f"{API}/batches/{batch_id}:cancel")

    async def _batch(self, batch_id: str) -> dict[str, Any]:
        return await self._exchange.get(f"{API}/batches/{batch_id}")

    async def _uploaded(self, lines: Sequence[BatchLine], mark: str) -> str:
        """The name of a file with the lines."""
        try:
            return await self._upload(b"".join(map(self._line, lines)), mark)
        except BatchFailed as exc:
            # Whatever became of the file, there is no batch.
            raise BatchFailed(exc.kind, str(exc), delay_s=exc.delay_s, sent=False) from exc

    async def _upload(self, content: bytes, mark: str) -> str:
        start = {
            "x-goog-upload-protocol": "resumable",
            "x-goog-upload-command": "start",
            "x-goog-upload-header-content-length": str(len(content)),
            "x-goog-upload-header-content-type": "application/jsonl",
        }
        told = canonical_json({"file": {"displayName": mark, "mimeType": "application/jsonl"}})
        begun = await self._exchange.ask("POST", f"/upload{API}/files", told.encode(), start)
        finish = {"x-goog-upload-command": "upload, finalize", "x-goog-upload-offset": "0"}
        path = self._own_path(begun.headers.get("x-goog-upload-url", ""))
        uploaded = await self._exchange.post(path, content, finish)
        return id_of(as_dict(uploaded.get("file")), "name")

    def _own_path(self, url: str) -> str:
        """The path of an upload at the configured host, to which alone the key goes."""
        parts = urlsplit(url)
        if not parts.path:
            raise BatchFailed("again", "the reply names no URL for the upload", sent=False)
        path = parts.path.removeprefix(urlsplit(self._exchange.endpoint.base_url).path)
        return f"{path}?{parts.query}"

    async def _lines(self, batch_id: str) -> AsyncIterator[dict[str, Any] | Unreadable]:
        batch = await self._batch(batch_id)
        metadata = as_dict(batch.get("metadata"))
        output = as_dict(metadata.get("output")) or as_dict(batch.get("response"))
        if not output and _state(metadata).endswith("SUCCEEDED"):
            raise BatchFailed("again", "the results are not there yet")
        for result in as_dicts(as_dict(output.get("inlinedResponses")).get("inlinedResponses")):
            yield {"key": as_dict(result.get("metadata")).get("key"), **result}
        if output.get("responsesFile"):
            name = id_of(output, "responsesFile")
            async for line in self._exchange.lines(f"{API}/{name}:download?alt=media"):
                yield line

    def _inline(self, line: BatchLine) -> bytes:
        told = self._exchange.told(line)
        text = f'{{"request":{line.request.body},"metadata":{{"key":"{line.key}"}}{told}}}'
        return text.encode()

    def _line(self, line: BatchLine) -> bytes:
        told = self._exchange.told(line)
        return f'{{"key":"{line.key}","request":{line.request.body}{told}}}\n'.encode()


def _number(name: str) -> str:
    """The id of a batch, by its name ``batches/ID``."""
    return name.rpartition("/")[2]


def _state(metadata: dict[str, Any]) -> str:
    """The provider's word, whether it says JOB_STATE_ or BATCH_STATE_ before it."""
    return (as_text(metadata.get("state")) or "unknown").rpartition("_STATE_")[2]


def _count(stats: dict[str, Any], name: str) -> int | None:
    """A count, which is a text, as 64-bit numbers are in JSON of protobuf; 0 is left out."""
    text = str(stats.get(name, "0"))
    return as_count(int(text)) if stats and text.isdecimal() else None


def _read(line: dict[str, Any]) -> LineResult:
    key = text_at(line, "key")
    response, error = line.get("response"), as_dict(line.get("error"))
    if isinstance(response, dict):
        return LineResult(key, as_reply(200, response))
    if not error:
        raise Unreadable(f"the result of {key} has neither a response nor an error")
    code = as_count(error.get("code")) or 2
    status, name = (code, error.get("status")) if code >= 400 else CODES.get(code, CODES[2])
    message = as_text(error.get("message")) or ""
    if name in NOT_ASKED:
        return LineResult(key, None, message)
    return LineResult(key, as_reply(status, {"error": {**error, "code": status, "status": name}}))
