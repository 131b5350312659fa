"""Gemini's batchGenerateContent, with the requests in a file.

They could also stand in the body of the creation; a file has room for more, and each of its results
has the key of its request.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any, Literal
from urllib.parse import urlsplit

from merge_runner.llm.batch.service import (
    BatchFailed,
    BatchLine,
    BatchService,
    BatchStatus,
    LineResult,
    Listed,
    as_message,
    as_reply,
    as_word,
    id_of,
    json_object,
    moment_of,
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


class GeminiBatches(BatchService):
    """``models/MODEL:batchGenerateContent`` and ``batches``; see BatchService."""

    # A file may have 2 GB, but this one is held in memory.
    most_bytes = 200_000_000
    # A page has few batches, since one may come with all its results.
    path, pages, cursor = f"{API}/batches", "pageSize=10", "pageToken"
    cancel_suffix, key_member = ":cancel", "key"

    def line(self, line: BatchLine) -> bytes:
        """See BatchService."""
        slot = self.slot_members(line)
        return f'{{"key":"{line.key}","request":{line.request.body}{slot}}}\n'.encode()

    async def create(self, lines: Sequence[BatchLine], mark: str) -> str:
        """See BatchService."""
        try:
            name = await self._upload(b"".join(map(self.line, lines)), mark)
        except BatchFailed as exc:
            exc.sent = False  # a file is no batch yet
            raise
        batch = {"displayName": mark, "inputConfig": {"fileName": name}}
        path = lines[0].request.path.replace(METHOD, BATCH_METHOD)
        created = await self._post(path, canonical_json({"batch": batch}).encode())
        return self.batch_id_of(json_object(created))

    async def _upload(self, content: bytes, mark: str) -> str:
        """Return the name of a file with these lines."""
        start = {
            "x-goog-upload-protocol": "resumable",
            "x-goog-upload-command": "start",
            "x-goog-upload-header-content-length": str(len(content)),
            "x-goog-upload-header-content-type": "application/jsonl",
        }
        file = canonical_json({"file": {"displayName": mark, "mimeType": "application/jsonl"}})
        begun = await self._post(f"/upload{API}/files", file.encode(), start)
        finish = {"x-goog-upload-command": "upload, finalize", "x-goog-upload-offset": "0"}
        path = self._own_path(begun.headers.get("x-goog-upload-url", ""))
        uploaded = json_object(await self._post(path, content, finish))
        return id_of(as_dict(uploaded.get("file")), "name")

    def _own_path(self, url: str) -> str:
        """Return the path of an upload at the configured host, to which alone the key goes."""
        try:
            parts = urlsplit(url)
        except ValueError:
            parts = urlsplit("")
        path = parts.path.removeprefix(urlsplit(self._endpoint.base_url).path)
        if not UPLOAD_PATH.fullmatch(f"{path}?{parts.query}"):
            raise BatchFailed("again", "the reply names no URL for the upload")
        return f"{path}?{parts.query}"

    def page_of(self, page: dict[str, Any]) -> tuple[list[Listed], str | None]:
        """See BatchService; the mark is the display name."""
        listed = []
        for batch in as_dicts(page.get("operations")):
            metadata = as_dict(batch.get("metadata"))
            created = moment_of(metadata.get("createTime"))
            listed.append(Listed(metadata.get("displayName"), created, batch))
        return listed, as_text(page.get("nextPageToken")) or None

    def batch_id_of(self, batch: dict[str, Any]) -> str:
        """Return the id in the name ``batches/ID``."""
        return id_of(batch, "name").rpartition("/")[2]

    def status_of(self, batch: dict[str, Any]) -> BatchStatus:
        """See BatchService."""
        state, error = _state(batch), as_dict(batch.get("error"))
        stats = as_dict(as_dict(batch.get("metadata")).get("batchStats"))
        total, pending = _count(stats, "requestCount"), _count(stats, "pendingRequestCount")
        why = read_error(_status_of(error)[0] if error else 400, {}, "", batch)
        return BatchStatus(
            state=state,
            done=None if total is None else max(0, total - (pending or 0)),
            total=total,
            results=_count(stats, "successfulRequestCount") or 0,
            message=as_message(error.get("message")),
            failure=self.failure_of(why) if state == "failed" else None,
            batch=batch,
        )

    def result_paths(self, batch_id: str, batch: Mapping[str, Any]) -> list[str]:
        """See BatchService."""
        metadata = as_dict(batch.get("metadata"))
        output = as_dict(metadata.get("output")) or as_dict(batch.get("response"))
        if not output and _word(batch).endswith("SUCCEEDED"):
            raise BatchFailed("again", "the results are not there yet")
        if not output.get("responsesFile"):
            return []
        return [f"{API}/{id_of(output, 'responsesFile')}:download?alt=media"]

    def read(self, key: str, line: dict[str, Any]) -> LineResult | None:
        """See BatchService."""
        response, error = line.get("response"), as_dict(line.get("error"))
        if isinstance(response, dict):
            return LineResult(key, as_reply(200, response))
        if not error:
            return None
        status, name = _status_of(error)
        if name in NOT_ASKED:
            return LineResult(key, None, as_message(error.get("message")))
        return LineResult(
            key, as_reply(status, {"error": {**error, "code": status, "status": name}})
        )


def _word(batch: Mapping[str, Any]) -> str:
    """The provider's word, whether it says JOB_STATE_ or BATCH_STATE_ before it."""
    return as_word(as_dict(batch.get("metadata")).get("state")).rpartition("_STATE_")[2]


def _state(batch: dict[str, Any]) -> Literal["waiting", "ended", "failed"]:
    """What a word means; of an operation that is done, it may be one that nobody knows."""
    word, done = _word(batch), batch.get("done") is True
    if word in ENDED:
        return "ended"
    if word == "FAILED" or (done and batch.get("error")):
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
