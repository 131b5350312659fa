"""Gemini's batchGenerateContent, with the requests in a file.

They could also stand in the body of the creation; a file has room for more, and each of its results
has the key of its request. Results of both kinds are read.
"""

from __future__ import annotations

import re
from collections.abc import AsyncIterator, Collection, Sequence
from datetime import datetime
from functools import partial
from typing import Any, Literal
from urllib.parse import urlsplit

from merge_runner.llm.batch.exchange import (
    TRANSFER_TIMEOUT_S,
    Exchange,
    Line,
    Listing,
    as_id,
    as_message,
    as_reply,
    as_word,
    check_size,
    counted,
    id_of,
    moment_of,
    no_batch_yet,
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
from merge_runner.llm.formats.base import as_count, as_dict, as_dicts, as_text, read_error

API = "/v1beta"
METHOD, BATCH_METHOD = ":generateContent", ":batchGenerateContent"
# Of ASCII, as a URL is; it may carry a long token.
UPLOAD_PATH = re.compile("/[!-~]{0,8000}")
ENDED = frozenset({"SUCCEEDED", "PARTIALLY_SUCCEEDED", "CANCELLED", "EXPIRED"})
# The HTTP status of an error by its code (google/rpc/code.proto), and its name.
CODES = {
    1: (499, "CANCELLED"),
    2: (500, "UNKNOWN"),
    3: (400, "INVALID_ARGUMENT"),
    4: (504, "DEADLINE_EXCEEDED"),
    5: (404, "NOT_FOUND"),
    6: (409, "ALREADY_EXISTS"),
    7: (403, "PERMISSION_DENIED"),
    8: (429, "RESOURCE_EXHAUSTED"),
    9: (400, "FAILED_PRECONDITION"),
    10: (409, "ABORTED"),
    11: (400, "OUT_OF_RANGE"),
    12: (501, "UNIMPLEMENTED"),
    13: (500, "INTERNAL"),
    14: (503, "UNAVAILABLE"),
    15: (500, "DATA_LOSS"),
    16: (401, "UNAUTHENTICATED"),
}
NOT_ASKED = frozenset({"CANCELLED"})


def _created(batch: dict[str, Any]) -> datetime | None:
    return moment_of(as_dict(batch.get("metadata")).get("createTime"))


def _next_page(page: dict[str, Any], batches: Sequence[dict[str, Any]]) -> str | None:
    return as_text(page.get("nextPageToken")) or None


def _listed_id(batch: dict[str, Any]) -> str | None:
    name = as_id(batch.get("name"))
    return None if name is None else _number(name)


# A page has few batches, since one may come with all its results.
LISTING = Listing(
    f"{API}/batches?pageSize=10", "operations", "pageToken", _next_page, _listed_id, _created
)


class GeminiBatches:
    """``models/MODEL:batchGenerateContent`` and ``batches``; see BatchService."""

    # A file may have 2 GB, but this one is held in memory.
    limits = BatchLimits(lines=100_000, size=200_000_000)

    def __init__(self, exchange: Exchange) -> None:
        self._exchange = exchange

    def size(self, line: BatchLine) -> int:
        """See BatchService."""
        return len(self._line(line))

    async def submit(self, lines: Sequence[BatchLine], mark: str) -> str:
        """See BatchService."""
        check_size(lines, self)
        with no_batch_yet():
            name = await self._upload(lines, mark)
        batch = {"displayName": mark, "inputConfig": {"fileName": name}}
        body = canonical_json({"batch": batch}).encode()
        path = lines[0].request.path.replace(METHOD, BATCH_METHOD)
        return _number(id_of(await self._exchange.create(path, body, lines=lines), "name"))

    async def find(
        self, mark: str, keys: Collection[str], *, since: datetime, known: Collection[str] = ()
    ) -> Found | None:
        """By the mark, which is its display name."""
        async for batch_id, batch in self._exchange.listed(LISTING, since, known):
            if as_dict(batch.get("metadata")).get("displayName") == mark:
                return Found(batch_id)
        return None

    async def status(self, batch_id: str) -> BatchStatus:
        """See BatchService."""
        batch = await self._exchange.get(f"{API}/batches/{batch_id}")
        metadata, error = as_dict(batch.get("metadata")), as_dict(batch.get("error"))
        word = _word(metadata)
        stats = as_dict(metadata.get("batchStats"))
        total, pending = _count(stats, "requestCount"), _count(stats, "pendingRequestCount")
        state = _state(word, batch)
        why = read_error(_status_of(error)[0] if error else 400, {}, "", batch)
        return BatchStatus(
            state=state,
            word=word,
            done=None if total is None else max(0, total - (pending or 0)),
            total=total,
            message=as_message(error.get("message")),
            failure=self._exchange.failure_of(why) if state == "failed" else None,
        )

    def results(self, batch_id: str) -> AsyncIterator[LineResult]:
        """See BatchService."""
        return read_results(partial(self._lines, batch_id), _read)

    async def cancel(self, batch_id: str) -> None:
        """See BatchService."""
        await self._exchange.cancel(f"{API}/batches/{batch_id}:cancel")

    async def _upload(self, lines: Sequence[BatchLine], mark: str) -> str:
        """The name of a file with the lines."""
        content = b"".join(map(self._line, lines))
        start = {
            "x-goog-upload-protocol": "resumable",
            "x-goog-upload-command": "start",
            "x-goog-upload-header-content-length": str(len(content)),
            "x-goog-upload-header-content-type": "application/jsonl",
        }
        told = canonical_json({"file": {"displayName": mark, "mimeType": "application/jsonl"}})
        files = f"/upload{API}/files"
        begun = await self._exchange.step(files, told.encode(), start, lines=lines)
        finish = {"x-goog-upload-command": "upload, finalize", "x-goog-upload-offset": "0"}
        path = self._own_path(begun.headers.get("x-goog-upload-url", ""))
        uploaded = await self._exchange.create(path, content, finish, lines=lines)
        return id_of(as_dict(uploaded.get("file")), "name")

    def _own_path(self, url: str) -> str:
        """The path of an upload at the configured host, to which alone the key goes."""
        try:
            parts = urlsplit(url)
        except ValueError:
            parts = urlsplit("")
        path = parts.path.removeprefix(urlsplit(self._exchange.endpoint.base_url).path)
        if not UPLOAD_PATH.fullmatch(f"{path}?{parts.query}"):
            raise BatchFailed("again", "the reply names no URL for the upload")
        return f"{path}?{parts.query}"

    async def _lines(self, batch_id: str) -> AsyncIterator[Line]:
        path = f"{API}/batches/{batch_id}"
        batch = await self._exchange.get(path, timeout_s=TRANSFER_TIMEOUT_S)
        metadata = as_dict(batch.get("metadata"))
        output = as_dict(metadata.get("output")) or as_dict(batch.get("response"))
        if not output and _word(metadata).upper().endswith("SUCCEEDED"):
            raise BatchFailed("again", "the results are not there yet")
        stats = as_dict(metadata.get("batchStats"))
        least = _count(stats, "successfulRequestCount") or 0
        most = max(_count(stats, "requestCount") or self.limits.lines, least)
        async for line in counted(self._output(output), least=least, most=most):
            yield line

    async def _output(self, output: dict[str, Any]) -> AsyncIterator[Line]:
        """The results of a batch that has some, in a file or beside its state."""
        for result in as_dicts(as_dict(output.get("inlinedResponses")).get("inlinedResponses")):
            yield {"key": as_dict(result.get("metadata")).get("key"), **result}
        if output.get("responsesFile"):
            name = id_of(output, "responsesFile")
            async for line in self._exchange.lines(f"{API}/{name}:download?alt=media"):
                yield line

    def _line(self, line: BatchLine) -> bytes:
        told = self._exchange.told(line)
        return f'{{"key":"{line.key}","request":{line.request.body}{told}}}\n'.encode()


def _number(name: str) -> str:
    """The id of a batch, by its name ``batches/ID``."""
    return name.rpartition("/")[2]


def _word(metadata: dict[str, Any]) -> str:
    """The provider's word, whether it says JOB_STATE_ or BATCH_STATE_ before it."""
    return re.sub("^.*_state_", "", as_word(metadata.get("state")), flags=re.IGNORECASE)


def _state(word: str, batch: dict[str, Any]) -> Literal["waiting", "ended", "failed"]:
    """What a word means; of an operation that is done, it may be one that nobody knows."""
    done = batch.get("done") is True
    if word.upper() in ENDED:
        return "ended"
    if word.upper() == "FAILED" or (done and batch.get("error")):
        return "failed"
    return "ended" if done else "waiting"


def _count(stats: dict[str, Any], name: str) -> int | None:
    """A count, which is a text, as 64-bit numbers are in JSON of protobuf; 0 is left out."""
    text = str(stats.get(name, "0"))
    return as_count(int(text)) if stats and re.fullmatch("[0-9]{1,18}", text) else None


def _status_of(error: dict[str, Any]) -> tuple[int, str | None]:
    """The HTTP status of an error, whose code may be one already, and its name."""
    code = as_count(error.get("code")) or 2
    if 400 <= code < 600:
        return code, as_text(error.get("status"))
    return CODES.get(code, CODES[2])


def _read(line: dict[str, Any]) -> LineResult:
    key = text_at(line, "key")
    response, error = line.get("response"), as_dict(line.get("error"))
    if isinstance(response, dict):
        return LineResult(key, as_reply(200, response))
    if not error:
        raise unreadable(key, "has neither a response nor an error")
    status, name = _status_of(error)
    if name in NOT_ASKED:
        return LineResult(key, None, as_message(error.get("message")))
    return LineResult(key, as_reply(status, {"error": {**error, "code": status, "status": name}}))
