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
    Page,
    as_message,
    as_reply,
    as_word,
    id_of,
    json_object,
)
from merge_runner.llm.content_hashes import canonical_json
from merge_runner.llm.formats.base import as_count, as_dict, as_dicts, as_text, read_error

API = "/v1beta"
METHOD, BATCH_METHOD = ":generateContent", ":batchGenerateContent"
# Of ASCII, as a URL is; it may carry a long token.
UPLOAD_PATH = re.compile("/[!-~]{0,8000}")
ENDED = frozenset({"SUCCEEDED", "PARTIALLY_SUCCEEDED", "CANCELLED", "EXPIRED"})
# The HTTP status of an error by its code (google/rpc/code.proto); of all others it is 500.
STATUSES = {
    1: 499,
    3: 400,
    4: 504,
    5: 404,
    6: 409,
    7: 403,
    8: 429,
    9: 400,
    10: 409,
    11: 400,
    12: 501,
    14: 503,
    16: 401,
}
CANCELLED = 499


class GeminiBatches(BatchService):
    """``models/MODEL:batchGenerateContent`` and ``batches``; see BatchService."""

    # A page has few batches, since one may come with all its results.
    path, pages, cursor = f"{API}/batches", "pageSize=10", "pageToken"
    id_member, key_member = "name", "key"

    def line(self, line: BatchLine) -> bytes:
        """See BatchService."""
        slot = self.slot_members(line)
        return f'{{"key":"{line.key}","request":{line.request.body}{slot}}}\n'.encode()

    async def upload(self, content: bytes, mark: str) -> str:
        """See BatchService."""
        start = {
            "x-goog-upload-protocol": "resumable",
            "x-goog-upload-command": "start",
            "x-goog-upload-header-content-length": str(len(content)),
            "x-goog-upload-header-content-type": "application/jsonl",
        }
        file = canonical_json({"file": {"displayName": mark, "mimeType": "application/jsonl"}})
        begun = await self._ask("POST", f"/upload{API}/files", file.encode(), start)
        finish = {"x-goog-upload-command": "upload, finalize", "x-goog-upload-offset": "0"}
        path = self._own_path(begun.headers.get("x-goog-upload-url", ""))
        uploaded = json_object(await self._ask("POST", path, content, finish))
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

    def creation(self, lines: Sequence[BatchLine], file: str, mark: str) -> tuple[str, bytes]:
        """See BatchService."""
        batch = {"displayName": mark, "inputConfig": {"fileName": file}}
        path = lines[0].request.path.replace(METHOD, BATCH_METHOD)
        return path, canonical_json({"batch": batch}).encode()

    def page_of(self, page: dict[str, Any]) -> Page:
        """See BatchService; the mark is the display name."""
        batches = as_dicts(page.get("operations"))
        listed = [(as_dict(batch.get("metadata")).get("displayName"), batch) for batch in batches]
        return listed, as_text(page.get("nextPageToken")) or None

    def status_of(self, batch: dict[str, Any]) -> BatchStatus:
        """See BatchService."""
        error = as_dict(batch.get("error"))
        stats = as_dict(as_dict(batch.get("metadata")).get("batchStats"))
        answered = str(stats.get("successfulRequestCount"))  # 64-bit numbers are texts
        return BatchStatus(
            state=_state(batch),
            results=int(answered) if re.fullmatch("[0-9]{1,18}", answered) else 0,
            message=as_message(error.get("message")),
            failure=self.failure_of(read_error(_status_of(error) if error else 400, {}, "", batch)),
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
        status = _status_of(error)
        if status == CANCELLED:
            return LineResult(key, None, as_message(error.get("message")))
        return LineResult(key, as_reply(status, {"error": {**error, "code": status}}))


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


def _status_of(error: dict[str, Any]) -> int:
    """The HTTP status of an error, whose code may be one already."""
    code = as_count(error.get("code")) or 2
    return code if 400 <= code < 600 else STATUSES.get(code, 500)
