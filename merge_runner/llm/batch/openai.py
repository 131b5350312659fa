"""OpenAI's batches of files, and those of servers that speak like it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any
from uuid import uuid4

from merge_runner.llm.batch.service import (
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
ENDED = frozenset({"COMPLETED", "EXPIRED", "CANCELLED"})
NOT_ASKED = frozenset({"batch_expired", "batch_cancelled"})


class OpenAIBatches(BatchService):
    """``/files`` and ``/batches``; see BatchService."""

    path, pages, cursor = "/batches", "limit=100", "after"

    def line(self, line: BatchLine) -> bytes:
        """See BatchService."""
        url, slot = canonical_json(API + line.request.path), self.slot_members(line)
        members = f'"method":"POST","url":{url},"body":{line.request.body}{slot}'
        return f'{{"custom_id":"{line.key}",{members}}}\n'.encode()

    async def upload(self, content: bytes, mark: str) -> str:
        """See BatchService."""
        boundary = uuid4().hex
        purpose = 'content-disposition: form-data; name="purpose"\r\n\r\nbatch'
        file = 'content-disposition: form-data; name="file"; filename="batch.jsonl"'
        head = f"--{boundary}\r\n{purpose}\r\n--{boundary}\r\n{file}\r\n"
        head += "content-type: application/jsonl\r\n\r\n"
        body = head.encode() + content + f"\r\n--{boundary}--\r\n".encode()
        form = {"content-type": f"multipart/form-data; boundary={boundary}"}
        return id_of(json_object(await self._ask("POST", "/files", body, form)))

    def creation(self, lines: Sequence[BatchLine], file: str, mark: str) -> tuple[str, bytes]:
        """See BatchService."""
        batch = {
            "input_file_id": file,
            "endpoint": API + lines[0].request.path,
            "completion_window": "24h",
            "metadata": {MARK: mark},
        }
        return self.path, canonical_json(batch).encode()

    def page_of(self, page: dict[str, Any]) -> Page:
        """See BatchService; the mark is among the metadata."""
        batches = as_dicts(page.get("data"))
        listed = [(as_dict(batch.get("metadata")).get(MARK), batch) for batch in batches]
        return listed, as_text(page.get("last_id")) if page.get("has_more") else None

    def status_of(self, batch: dict[str, Any]) -> BatchStatus:
        """See BatchService."""
        word = as_word(batch.get("status"))
        error = first_of(as_dict(batch.get("errors")).get("data"))
        why = read_error(400, {}, "", {"error": error})
        if why.names:
            why = replace(why, status=status_within(why))
        return BatchStatus(
            state="failed" if word == "FAILED" else "ended" if word in ENDED else "waiting",
            results=as_count(as_dict(batch.get("request_counts")).get("completed")) or 0,
            message=as_message(error.get("message")),
            failure=self.failure_of(why),
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
        return LineResult(key, as_reply(500, {"error": error}), message) if error else None
