"""The addresses of the batch modes at the emulator."""

from __future__ import annotations

import itertools
import json
import re
from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import Any

from merge_runner.chance import draw
from merge_runner.emulator import batch_formats as formats
from merge_runner.emulator.batches import Batch, Batches
from merge_runner.emulator.exchange import BrokenOff, Request, Response, as_error, as_json
from merge_runner.emulator.faults import STATUS_FAULTS
from merge_runner.emulator.formats import CHAT, GEMINI, MESSAGES, ServedFormat
from merge_runner.emulator.replies import UNREADABLE, marked
from merge_runner.errors import UsageError

OPENAI, ANTHROPIC, GOOGLE = "batch_", "msgbatch_", "g"
ID = "(?P<id>[^/]+?)"
VERSION = r"/(?P<version>v1\w+)"
Handler = Callable[[Request], Response]


class NotThere(Exception):
    """There is no such batch or file, or not yet."""


class BatchRoutes:
    """Serves the batch modes of OpenAI, Anthropic and Gemini."""

    def __init__(self, batches: Batches) -> None:
        self._batches = batches
        self._files: dict[str, bytes] = {}
        self._file_number = itertools.count()
        self._requests: Counter[str] = Counter()

    def routes(self) -> list[tuple[str, str, Handler]]:
        """The method, the pattern of paths and the handler of each."""
        openai, anthropic, gemini = CHAT, MESSAGES, GEMINI
        served: list[tuple[str, str, ServedFormat, Handler]] = [
            ("POST", "/v1/files", openai, self._upload_openai),
            ("GET", f"/v1/files/{ID}", openai, self._openai_file),
            ("GET", f"/v1/files/{ID}/content", openai, self._openai_content),
            ("DELETE", f"/v1/files/{ID}", openai, self._delete_file),
            ("POST", "/v1/batches", openai, self._create_openai),
            ("GET", "/v1/batches", openai, self._list_openai),
            ("GET", f"/v1/batches/{ID}", openai, self._openai_batch),
            ("POST", f"/v1/batches/{ID}/cancel", openai, self._cancel_openai),
            ("POST", "/v1/messages/batches", anthropic, self._create_anthropic),
            ("GET", "/v1/messages/batches", anthropic, self._list_anthropic),
            ("GET", f"/v1/messages/batches/{ID}", anthropic, self._anthropic_batch),
            ("POST", f"/v1/messages/batches/{ID}/cancel", anthropic, self._cancel_anthropic),
            ("GET", f"/v1/messages/batches/{ID}/results", anthropic, self._anthropic_results),
            (
                "POST",
                f"{VERSION}/models/(?P<model>[^/]+?):batchGenerateContent",
                gemini,
                self._create_gemini,
            ),
            ("GET", f"{VERSION}/batches", gemini, self._list_gemini),
            ("GET", f"{VERSION}/batches/{ID}", gemini, self._gemini_batch),
            ("POST", f"{VERSION}/batches/{ID}:cancel", gemini, self._cancel_gemini),
            ("POST", f"/upload{VERSION}/files", gemini, self._upload_gemini),
            ("GET", f"{VERSION}/files/{ID}:download", gemini, self._gemini_content),
        ]
        return [
            (method, pattern, partial(self._guarded, wire, handler))
            for method, pattern, wire, handler in served
        ]

    def _guarded(self, wire: ServedFormat, handler: Handler, request: Request) -> Response:
        """Answer with the faults of a service, and with errors in the provider's form."""
        faults = self._batches.faults
        where = f"{request.method} {request.path}"
        self._requests[where] += 1
        fault = faults.fault(where, self._requests[where])
        if fault == "rate_limit":
            delay_s = faults.wait_s(where, self._requests[where])
            return as_error(wire, 429, "Rate limit reached.", delay_s)
        if fault in STATUS_FAULTS:
            return as_error(wire, STATUS_FAULTS[fault], "An emulated fault.")
        try:
            return handler(request)
        except UsageError as exc:
            return as_error(wire, 400, str(exc))
        except NotThere:
            return as_error(wire, 404, "There is no such thing.")
        except UNREADABLE:
            return as_error(wire, 400, "The body is not valid.")

    def _answered(self, body: dict[str, Any]) -> Response:
        """The reply to a creation, which may get lost on its way."""
        faults = self._batches.faults
        self._requests["created"] += 1
        chance = draw("lost", faults.seed, self._requests["created"])
        if chance < faults.batch.lost:
            raise BrokenOff("lost")
        return as_json(body)

    def _polled(self, request: Request) -> Batch:
        """The batch of a path; raises NotThere."""
        batch = self._batches.poll(request.named["id"])
        if batch is None:
            raise NotThere
        return batch

    def _uploaded(self, file_id: str) -> bytes:
        """The bytes of an input file; raises NotThere."""
        if file_id not in self._files:
            raise NotThere
        return self._files[file_id]

    def _shown(self, name: str, results: bytes) -> bytes:
        """What is there of a file of results; raises NotThere."""
        plan = self._batches.faults.batch
        self._requests[name] += 1
        times = self._requests[name]
        if times <= plan.late_results:
            raise NotThere
        if times > plan.late_results + plan.short_results:
            return results
        lines = results.splitlines(keepends=True)
        return b"".join(lines[: len(lines) // 2])

    # OpenAI

    def _upload_openai(self, request: Request) -> Response:
        form = request.form()
        if form.get("purpose") != b"batch" or "file" not in form:
            raise UsageError("A file and the purpose batch are needed.")
        return as_json(self._openai_file_object(self._keep_file(form["file"])))

    def _keep_file(self, content: bytes) -> str:
        name = f"file-{next(self._file_number):06x}"
        self._files[name] = content
        return name

    def _openai_file_object(self, file_id: str) -> dict[str, Any]:
        content = self._content(file_id)
        return marked(
            {
                "id": file_id,
                "object": "file",
                "bytes": len(content),
                "created_at": int(self._batches.now_s()),
                "filename": "batch.jsonl",
                "purpose": "batch" if file_id in self._files else "batch_output",
                "status": "processed",
            }
        )

    def _content(self, file_id: str) -> bytes:
        """The bytes of a file; raises NotThere."""
        named = re.fullmatch(r"file-(batch_\w+)-(output|error)", file_id)
        if named is None:
            return self._uploaded(file_id)
        batch = self._batches.poll(named[1])
        if batch is None or not batch.ended:
            raise NotThere
        return formats.openai_results(batch, answered=named[2] == "output")

    def _openai_file(self, request: Request) -> Response:
        return as_json(self._openai_file_object(request.named["id"]))

    def _openai_content(self, request: Request) -> Response:
        file_id = request.named["id"]
        content = self._content(file_id)
        return _lines(content if file_id in self._files else self._shown(file_id, content))

    def _delete_file(self, request: Request) -> Response:
        file_id = request.named["id"]
        self._uploaded(file_id)
        del self._files[file_id]
        return as_json(marked({"id": file_id, "object": "file", "deleted": True}))

    def _create_openai(self, request: Request) -> Response:
        asked = request.json()
        file_id, endpoint = asked["input_file_id"], asked["endpoint"]
        if endpoint not in formats.OPENAI_URLS or asked["completion_window"] != "24h":
            raise UsageError("There is no such endpoint, or the completion_window is not 24h.")
        details = {
            "endpoint": endpoint,
            "input_file_id": file_id,
            "metadata": asked.get("metadata"),
        }
        lines = formats.openai_lines(self._uploaded(file_id), endpoint)
        batch = self._batches.create(OPENAI, "", lines, details)
        if batch.refused:
            self._batches.keep(batch)
        return self._answered(formats.openai_batch(batch, self._batches.now_s()))

    def _list_openai(self, request: Request) -> Response:
        page, more = _page(self._batches.listed(OPENAI), request, "after", "limit", 20)
        data = [formats.openai_batch(batch, self._batches.now_s()) for batch in page]
        return as_json(marked({"object": "list", "data": data, "has_more": more, **_ends(page)}))

    def _openai_batch(self, request: Request) -> Response:
        return as_json(formats.openai_batch(self._polled(request), self._batches.now_s()))

    def _cancel_openai(self, request: Request) -> Response:
        batch = self._polled(request)
        self._batches.cancel(batch)
        return as_json(formats.openai_batch(batch, self._batches.now_s()))

    # Anthropic

    def _create_anthropic(self, request: Request) -> Response:
        lines = formats.anthropic_lines(request.json())
        batch = self._batches.create(ANTHROPIC, "", lines, {})
        if batch.refused:
            return as_error(MESSAGES, 429, batch.refused)
        return self._answered(formats.anthropic_batch(batch, _own_url(request)))

    def _list_anthropic(self, request: Request) -> Response:
        page, more = _page(self._batches.listed(ANTHROPIC), request, "after_id", "limit", 20)
        data = [formats.anthropic_batch(batch, _own_url(request)) for batch in page]
        return as_json(marked({"data": data, "has_more": more, **_ends(page)}))

    def _anthropic_batch(self, request: Request) -> Response:
        return as_json(formats.anthropic_batch(self._polled(request), _own_url(request)))

    def _cancel_anthropic(self, request: Request) -> Response:
        batch = self._polled(request)
        self._batches.cancel(batch)
        return as_json(formats.anthropic_batch(batch, _own_url(request)))

    def _anthropic_results(self, request: Request) -> Response:
        batch = self._polled(request)
        if not batch.ended:
            raise NotThere
        return _lines(self._shown(batch.id, formats.anthropic_results(batch)))

    # Gemini

    def _create_gemini(self, request: Request) -> Response:
        asked = (request.json())["batch"]
        source = asked["inputConfig"]
        from_file = "fileName" in source
        if from_file:
            content = self._uploaded(source["fileName"].removeprefix("files/"))
            requests = [json.loads(line) for line in filter(None, content.splitlines())]
        else:
            requests = source["requests"]["requests"]
        version, model = request.named["version"], request.named["model"]
        lines = formats.gemini_lines(requests, version, model)
        details = {"model": model, "from_file": from_file}
        batch = self._batches.create(GOOGLE, str(asked["displayName"]), lines, details)
        if batch.refused:
            return as_error(GEMINI, 429, batch.refused)
        return self._answered(formats.gemini_batch(batch, self._batches.now_s()))

    def _list_gemini(self, request: Request) -> Response:
        page, more = _page(self._batches.listed(GOOGLE), request, "pageToken", "pageSize", 50)
        listed = [formats.gemini_batch(batch, self._batches.now_s()) for batch in page]
        following = {"nextPageToken": page[-1].id} if more else {}
        return as_json(marked({"operations": listed, **following}))

    def _gemini_batch(self, request: Request) -> Response:
        return as_json(formats.gemini_batch(self._polled(request), self._batches.now_s()))

    def _cancel_gemini(self, request: Request) -> Response:
        self._batches.cancel(self._polled(request))
        return as_json(marked({}))

    def _upload_gemini(self, request: Request) -> Response:
        """A resumable upload: it is announced, and then sent in as many pieces as it takes."""
        command = request.headers.get("x-goog-upload-command", "")
        if command == "start":
            file_id = self._keep_file(b"")
            url = f"{_own_url(request)}{request.path}?upload_id={file_id}&upload_protocol=resumable"
            return as_json(marked({}), {"x-goog-upload-url": url, "x-goog-upload-status": "active"})
        file_id = request.query["upload_id"]
        self._files[file_id] = self._uploaded(file_id) + request.body
        if "finalize" not in command:
            return as_json(marked({}), {"x-goog-upload-status": "active"})
        size = str(len(self._files[file_id]))
        told = {"name": f"files/{file_id}", "sizeBytes": size, "mimeType": "application/jsonl"}
        return as_json(marked({"file": told}), {"x-goog-upload-status": "final"})

    def _gemini_content(self, request: Request) -> Response:
        batch = self._batches.poll(request.named["id"].removeprefix("batch-"))
        if batch is None or not batch.ended:
            raise NotThere
        return _lines(self._shown(batch.id, formats.gemini_results(batch)))


def _page(
    batches: list[Batch], request: Request, cursor: str, size: str, usual: int
) -> tuple[list[Batch], bool]:
    """The batches of one page, and whether there are more."""
    after = request.query.get(cursor)
    ids = [batch.id for batch in batches]
    start = ids.index(after) + 1 if after else 0
    count = int(request.query.get(size, usual))
    return batches[start : start + count], len(batches) > start + count


def _ends(page: list[Batch]) -> dict[str, str | None]:
    ids = [batch.id for batch in page]
    return {"first_id": ids[0] if ids else None, "last_id": ids[-1] if ids else None}


def _own_url(request: Request) -> str:
    return f"http://{request.host}"


def _lines(body: bytes) -> Response:
    return Response(body, headers={"content-type": "application/octet-stream"})
