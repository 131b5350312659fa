"""Batch modes of three providers, and the terms of each model."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from typing import Any
from urllib.parse import urlsplit
from uuid import uuid4

from merge_runner.llm.batch.service import (
    BatchFailed,
    BatchService,
    BatchStatus,
    id_of,
    json_object,
)
from merge_runner.llm.formats.server_error import read_error
from merge_runner.llm.formats.wire import as_count, as_dict, as_text, at
from merge_runner.llm.http_outcome import RawReply, status_within
from merge_runner.providers import PROVIDERS, BatchTerms, ModelEntry, endpoint_identity
from merge_runner.records import LARGEST_STATUS, ChatRequest, canonical_json

# Prefixes of a provider's paths, whatever the base URL of the server is.
OPENAI, GEMINI = "/v1", "/v1beta"
NOT_ASKED = frozenset({"batch_expired", "batch_cancelled"})
# ASCII, as in URLs; it may contain a long token.
UPLOAD_PATH = re.compile("/[!-~]{1,8000}")
# Statuses of the normal endpoint for errors of which a result has only the type or the code
# (google/rpc/code.proto). All others may be transient.
ANTHROPIC_STATUSES = {
    "invalid_request_error": 400,
    "request_too_large": 413,
    "rate_limit_error": 429,
    "overloaded_error": 529,
}
GEMINI_STATUSES = {1: 499, 3: 400, 7: 403, 8: 429, 12: 501, 14: 503}
CANCELLED = 499


class OpenAIBatches(BatchService):
    """``/files`` and ``/batches`` of OpenAI, and of servers that speak like it."""

    template = (
        f'{{{{"custom_id":"{{key}}","method":"POST","url":"{OPENAI}{{path}}",'
        '"body":{body}{slot}}}\n'
    )
    path, pages, cursor = "/batches", "limit=100", "after"
    list_member, next_member, mark_member = "data", "last_id", "merge_runner_mark"

    async def _upload(self, content: bytes, mark: str) -> str:
        boundary = uuid4().hex
        purpose = 'content-disposition: form-data; name="purpose"\r\n\r\nbatch'
        file = 'content-disposition: form-data; name="file"; filename="batch.jsonl"'
        head = f"--{boundary}\r\n{purpose}\r\n--{boundary}\r\n{file}\r\n"
        head += "content-type: application/jsonl\r\n\r\n"
        body = head.encode() + content + f"\r\n--{boundary}--\r\n".encode()
        form = {"content-type": f"multipart/form-data; boundary={boundary}"}
        return id_of(json_object(await self._ask("POST", "/files", body, form)))

    def _creation(self, requests: Sequence[ChatRequest], file: str, mark: str) -> tuple[str, bytes]:
        batch = {
            "input_file_id": file,
            "endpoint": OPENAI + requests[0].path,
            "completion_window": "24h",
            "metadata": {self.mark_member: mark},
        }
        return self.path, canonical_json(batch).encode()

    def _status_of(self, batch: dict[str, Any]) -> BatchStatus:
        word = (as_text(batch.get("status")) or "").upper()
        answered = as_count(as_dict(batch.get("request_counts")).get("completed")) or 0
        error, errors = at(batch, "errors.data.0"), batch.get("errors")
        why = read_error(400, {}, json.dumps(errors) if errors else "", {"error": error})
        why = why._replace(status=status_within(why) if why.names else 400)
        failure = self._failure_of(why) if word == "FAILED" else None
        if word not in ("COMPLETED", "EXPIRED", "CANCELLED"):
            return BatchStatus(failure=failure)
        names = [name for name in ("output_file_id", "error_file_id") if batch.get(name)]
        return BatchStatus([f"/files/{id_of(batch, name)}/content" for name in names], answered)

    def _read(self, line: dict[str, Any]) -> RawReply | None:
        response, error = as_dict(line.get("response")), as_dict(line.get("error"))
        status, body = as_count(response.get("status_code")), response.get("body")
        if status and status <= LARGEST_STATUS and isinstance(body, dict):
            return _reply(status, body)
        if as_text(error.get("code")) in NOT_ASKED:
            return None
        if not error:
            raise ValueError("neither a response nor an error")
        return _reply(500, {"error": error})


class AnthropicBatches(BatchService):
    """``/v1/messages/batches``, with all requests in the body; a batch takes no mark."""

    template = '{{"custom_id":"{key}","params":{body}{slot}}}'
    takes_mark = False
    path = "/v1/messages/batches"

    def _creation(self, requests: Sequence[ChatRequest], file: str, mark: str) -> tuple[str, bytes]:
        return self.path, b'{"requests":[' + b",".join(map(self.line, requests)) + b"]}"

    def _status_of(self, batch: dict[str, Any]) -> BatchStatus:
        if (as_text(batch.get("processing_status")) or "").upper() != "ENDED":
            return BatchStatus()
        counts = as_dict(batch.get("request_counts")).values()
        # Not at the URL that the batch names: only the configured host may get the key.
        path = f"{self.path}/{id_of(batch)}/results"
        return BatchStatus([path], sum(as_count(count) or 0 for count in counts))

    def _read(self, line: dict[str, Any]) -> RawReply | None:
        result = as_dict(line.get("result"))
        match result.get("type"):
            case "succeeded":
                return _reply(200, as_dict(result.get("message")))
            case "errored":
                error = as_dict(result.get("error"))
                kind = as_text(as_dict(error.get("error")).get("type")) or ""
                return _reply(ANTHROPIC_STATUSES.get(kind, 500), error)
            case "expired" | "canceled":
                return None
        raise ValueError("a result of an unknown type")


class GeminiBatches(BatchService):
    """``models/MODEL:batchGenerateContent`` and ``batches``, with the requests in a file.

    The body of the creation could contain them, too; a file has room for more, and each of its
    results has the key of its request.
    """

    template = '{{"key":"{key}","request":{body}{slot}}}\n'
    # A page has few batches, since one may come with all its results.
    path, pages, cursor = f"{GEMINI}/batches", "pageSize=10", "pageToken"
    list_member, next_member, mark_member = "operations", "nextPageToken", "displayName"

    async def _upload(self, content: bytes, mark: str) -> str:
        start = {
            "x-goog-upload-protocol": "resumable",
            "x-goog-upload-command": "start",
            "x-goog-upload-header-content-length": str(len(content)),
            "x-goog-upload-header-content-type": "application/jsonl",
        }
        file = canonical_json({"file": {"displayName": mark, "mimeType": "application/jsonl"}})
        begun = await self._ask("POST", f"/upload{GEMINI}/files", file.encode(), start)
        # At the configured host, whatever the URL names: no other may get the key.
        url = begun.headers.get("x-goog-upload-url", "")
        path = "/" + url.partition("://")[2].partition("/")[2]
        path = path.removeprefix(urlsplit(self.endpoint.base_url).path)
        if not UPLOAD_PATH.fullmatch(path):
            raise BatchFailed("again", "the reply names no URL for the upload")
        finish = {"x-goog-upload-command": "upload, finalize", "x-goog-upload-offset": "0"}
        uploaded = json_object(await self._ask("POST", path, content, finish))
        return id_of(as_dict(uploaded.get("file")), "name")

    def _creation(self, requests: Sequence[ChatRequest], file: str, mark: str) -> tuple[str, bytes]:
        batch = {"displayName": mark, "inputConfig": {"fileName": file}}
        path = requests[0].path.replace(":generateContent", ":batchGenerateContent")
        return path, canonical_json({"batch": batch}).encode()

    def _status_of(self, batch: dict[str, Any]) -> BatchStatus:
        # The state of an operation that is done may be unknown.
        metadata, error = as_dict(batch.get("metadata")), as_dict(batch.get("error"))
        # It has the prefix JOB_STATE_ or BATCH_STATE_.
        word = (as_text(metadata.get("state")) or "").upper().rpartition("_STATE_")[2]
        done = batch.get("done") is True
        if word not in ("SUCCEEDED", "PARTIALLY_SUCCEEDED", "CANCELLED", "EXPIRED"):
            if word == "FAILED" or (done and error):
                why = read_error(_http_status(error) if error else 400, {}, "", batch)
                return BatchStatus(failure=self._failure_of(why))
            if not done:
                return BatchStatus()
        output = as_dict(metadata.get("output")) or as_dict(batch.get("response"))
        if not output and word.endswith("SUCCEEDED"):
            raise BatchFailed("again", "the results are not there yet")
        file = id_of(output, "responsesFile") if output.get("responsesFile") else ""
        answered = str(as_dict(metadata.get("batchStats")).get("successfulRequestCount"))
        return BatchStatus(
            [f"{GEMINI}/{file}:download?alt=media"] if file else [],
            int(answered) if re.fullmatch("[0-9]{1,18}", answered) else 0,  # numbers are texts
        )

    def _read(self, line: dict[str, Any]) -> RawReply | None:
        response, error = line.get("response"), as_dict(line.get("error"))
        if isinstance(response, dict):
            return _reply(200, response)
        if not error:
            raise ValueError("neither a response nor an error")
        status = _http_status(error)
        return None if status == CANCELLED else _reply(status, {"error": error})


def _reply(status: int, body: dict[str, Any]) -> RawReply:
    # In ASCII, since JSON can spell half of a surrogate pair, which no file can hold.
    return RawReply(status, {}, json.dumps(body))


def _http_status(error: dict[str, Any]) -> int:
    """Return the HTTP status of an error of Gemini, whose code may be one already."""
    code = as_count(error.get("code")) or 2
    return code if 400 <= code < 600 else GEMINI_STATUSES.get(code, 500)


# By wire format.
SERVICES: Mapping[str, type[BatchService]] = {
    "openai-chat": OpenAIBatches,
    "openai-responses": OpenAIBatches,
    "gemini": GeminiBatches,
    "anthropic": AnthropicBatches,
}


def batch_terms(entry: ModelEntry) -> BatchTerms | None:
    """Return the terms of a model's batch mode; None: it has no known one."""
    # A path of its own leads to one deployment, which no batch can name.
    if entry.batch == "none" or entry.path is not None or entry.format not in SERVICES:
        return None
    if isinstance(entry.batch, BatchTerms):
        return entry.batch
    # A provider's price holds at its own address.
    is_its_own = endpoint_identity(entry) == entry.provider
    return PROVIDERS.require(entry.provider).batch if is_its_own else None
