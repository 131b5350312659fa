"""OpenAI's batches of files, and those of servers that speak like it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any
from uuid import uuid4

from merge_runner.config import is_own_host
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
)
from merge_runner.llm.content_hashes import canonical_json
from merge_runner.llm.formats.base import (
    as_count,
    as_dict,
    as_dicts,
    as_text,
    first_of,
    read_error,
)
from merge_runner.llm.http_outcome import status_within
from merge_runner.llm.verify import LARGEST_STATUS

# Where the files of a batch stand, whatever the base URL of the server is.
API = "/v1"
MARK = "merge_runner_mark"
# What OpenAI itself does with input files.
KEPT_S = 30 * 86400
ENDED = frozenset({"COMPLETED", "EXPIRED", "CANCELLED"})
NOT_ASKED = frozenset({"batch_expired", "batch_cancelled"})


class OpenAIBatches(BatchService):
    """``/files`` and ``/batches``; see BatchService."""

    most_bytes = 200_000_000
    path, pages, cursor = "/batches", "limit=100", "after"

    def line(self, line: BatchLine) -> bytes:
        """See BatchService."""
        url, slot = canonical_json(API + line.request.path), self.slot_members(line)
        members = f'"method":"POST","url":{url},"body":{line.request.body}{slot}'
        return f'{{"custom_id":"{line.key}",{members}}}\n'.encode()

    async def create(self, lines: Sequence[BatchLine], mark: str) -> str:
        """See BatchService."""
        batch: dict[str, Any] = {
            "input_file_id": await self._upload(b"".join(map(self.line, lines))),
            "endpoint": API + lines[0].request.path,
            "completion_window": "24h",
            "metadata": {MARK: mark},
        }
        if is_own_host("openai", self._endpoint.identity):  # others may not know the member
            batch["output_expires_after"] = {"anchor": "created_at", "seconds": KEPT_S}
        return id_of(json_object(await self._post(self.path, canonical_json(batch).encode())))

    async def _upload(self, content: bytes) -> str:
        """Return the id of a file with these lines."""
        boundary = uuid4().hex
        purpose = 'content-disposition: form-data; name="purpose"\r\n\r\nbatch'
        file = 'content-disposition: form-data; name="file"; filename="batch.jsonl"'
        head = f"--{boundary}\r\n{purpose}\r\n--{boundary}\r\n{file}\r\n"
        head += "content-type: application/jsonl\r\n\r\n"
        body = head.encode() + content + f"\r\n--{boundary}--\r\n".encode()
        form = {"content-type": f"multipart/form-data; boundary={boundary}"}
        try:
            return id_of(json_object(await self._post("/files", body, form)))
        except BatchFailed as exc:
            exc.sent = False  # a file is no batch yet
            raise

    def page_of(self, page: dict[str, Any]) -> tuple[list[Listed], str | None]:
        """See BatchService; the mark is among the metadata."""
        batches = as_dicts(page.get("data"))
        last = as_text(page.get("last_id")) or next(
            (as_text(batch.get("id")) for batch in reversed(batches)), None
        )
        listed = [
            Listed(as_dict(batch.get("metadata")).get(MARK), _created(batch), batch)
            for batch in batches
        ]
        return listed, last if page.get("has_more") else None

    def status_of(self, batch: dict[str, Any]) -> BatchStatus:
        """See BatchService."""
        word = as_word(batch.get("status"))
        counts = as_dict(batch.get("request_counts"))
        answered = as_count(counts.get("completed")) or 0
        error = first_of(as_dict(batch.get("errors")).get("data"))
        why = read_error(400, {}, "", {"error": error})
        why = replace(why, status=status_within(why) if why.names else 400)
        failed = word == "FAILED"
        return BatchStatus(
            state="failed" if failed else "ended" if word in ENDED else "waiting",
            done=answered + (as_count(counts.get("failed")) or 0) if counts else None,
            total=as_count(counts.get("total")) or None,
            results=answered,
            message=as_message(error.get("message")),
            failure=self.failure_of(why) if failed else None,
            batch=batch,
        )

    def result_paths(self, batch_id: str, batch: Mapping[str, Any]) -> list[str]:
        """Return those of its files of answers and of errors."""
        names = [name for name in ("output_file_id", "error_file_id") if batch.get(name)]
        return [f"/files/{id_of(batch, name)}/content" for name in names]

    def read(self, key: str, line: dict[str, Any]) -> LineResult | None:
        """See BatchService."""
        response, error = as_dict(line.get("response")), as_dict(line.get("error"))
        status, body = as_count(response.get("status_code")), response.get("body")
        if status and status <= LARGEST_STATUS and isinstance(body, dict):
            return LineResult(key, as_reply(status, body))
        message = as_message(error.get("message"))
        if as_text(error.get("code")) in NOT_ASKED:
            return LineResult(key, None, message)
        if error:
            return LineResult(key, as_reply(500, {"error": error}), message)
        return None


def _created(batch: dict[str, Any]) -> datetime | None:
    created_s = as_count(batch.get("created_at"))
    return None if created_s is None else datetime.fromtimestamp(created_s, UTC)
