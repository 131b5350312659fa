"""The addresses of the batch modes at the emulator."""

from __future__ import annotations

import itertools
import json
import re
from collections import Counter
from collections.abc import Awaitable, Callable
from typing import Any

from aiohttp import web

from merge_runner.chance import draw
from merge_runner.emulator import batch_formats as formats
from merge_runner.emulator.batches import Batch, Batches
from merge_runner.emulator.faults import STATUS_FAULTS
from merge_runner.emulator.formats import CHAT, GEMINI, MESSAGES, ServedFormat
from merge_runner.emulator.replies import UNREADABLE, dumps, marked
from merge_runner.errors import UsageError

MOST_BYTES = 2**29
OPENAI, ANTHROPIC, GOOGLE = "batch_", "msgbatch_", "g"
Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


class NotThere(Exception):
    """There is no such batch or file, or not yet."""


class BatchRoutes:
    """Serves the batch modes of OpenAI, Anthropic and Gemini."""

    def __init__(self, batches: Batches) -> None:
        self._batches = batches
        self._files: dict[str, bytes] = {}
        self._file_number = itertools.count()
        self._requests: Counter[str] = Counter()

    def routes(self) -> list[web.RouteDef]:
        """All of them."""
        openai, anthropic, gemini = CHAT, MESSAGES, GEMINI
        served: list[tuple[str, str, ServedFormat, Handler]] = [
            ("POST", "/v1/files", openai, self._upload_openai),
            ("GET", "/v1/files/{id}", openai, self._openai_file),
            ("GET", "/v1/files/{id}/content", openai, self._openai_content),
            ("DELETE", "/v1/files/{id}", openai, self._delete_file),
            ("POST", "/v1/batches", openai, self._create_openai),
            ("GET", "/v1/batches", openai, self._list_openai),
            ("GET", "/v1/batches/{id}", openai, self._openai_batch),
            ("POST", "/v1/batches/{id}/cancel", openai, self._cancel_openai),
            ("POST", "/v1/messages/batches", anthropic, self._create_anthropic),
            ("GET", "/v1/messages/batches", anthropic, self._list_anthropic),
            ("GET", "/v1/messages/batches/{id}", anthropic, self._anthropic_batch),
            ("POST", "/v1/messages/batches/{id}/cancel", anthropic, self._cancel_anthropic),
            ("GET", "/v1/messages/batches/{id}/results", anthropic, self._anthropic_results),
            (
                "POST",
                r"/{version:v1\w+}/models/{model}:batchGenerateContent",
                gemini,
                self._create_gemini,
            ),
            ("GET", r"/{version:v1\w+}/batches", gemini, self._list_gemini),
            ("GET", r"/{version:v1\w+}/batches/{id}", gemini, self._gemini_batch),
            ("POST", r"/{version:v1\w+}/batches/{id}:cancel", gemini, self._cancel_gemini),
            ("POST", r"/upload/{version:v1\w+}/files", gemini, self._upload_gemini),
            ("GET", r"/{version:v1\w+}/files/{id}:download", gemini, self._gemini_content),
        ]
        return [
            web.route(method, path, self._guarded(wire, handler))
            for method, path, wire, handler in served
        ]

    def _guarded(self, wire: ServedFormat, handler: Handler) -> Handler:
        """A handler with the faults of a service, and with errors in the provider's form."""

        async def handle(request: web.Request) -> web.StreamResponse:
            faults = self._batches.faults
            where = f"{request.method} {request.path}"
            self._requests[where] += 1
            fault = faults.fault(where, self._requests[where])
            if fault == "rate_limit":
                delay_s = faults.wait_s(where, self._requests[where])
                return _error(wire, 429, "Rate limit reached.", delay_s)
            if fault in STATUS_FAULTS:
                return _error(wire, STATUS_FAULTS[fault], "An emulated fault.")
            try:
                return await handler(request.clone(client_max_size=MOST_BYTES))
            except UsageError as exc:
                return _error(wire, 400, str(exc))
            except NotThere:
                return _error(wire, 404, "There is no such thing.")
            except UNREADABLE:
                return _error(wire, 400, "The body is not valid.")

        return handle

    def _answered(self, request: web.Request, body: dict[str, Any]) -> web.StreamResponse:
        """The reply to a creation, which may get lost on its way."""
        faults = self._batches.faults
        self._requests["created"] += 1
        chance = draw("lost", faults.seed, self._requests["created"])
        if chance < faults.batch.lost and request.transport is not None:
            request.transport.abort()
        return _json(body)

    def _polled(self, request: web.Request) -> Batch:
        """The batch of a path; raises NotThere."""
        batch = self._batches.poll(request.match_info["id"])
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

    async def _upload_openai(self, request: web.Request) -> web.StreamResponse:
        form = await request.post()
        upload = form.get("file")
        if form.get("purpose") != "batch" or not isinstance(upload, web.FileField):
            raise UsageError("A file and the purpose batch are needed.")
        return _json(self._openai_file_object(self._keep_file(upload.file.read())))

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

    async def _openai_file(self, request: web.Request) -> web.StreamResponse:
        return _json(self._openai_file_object(request.match_info["id"]))

    async def _openai_content(self, request: web.Request) -> web.StreamResponse:
        file_id = request.match_info["id"]
        content = self._content(file_id)
        return _lines(content if file_id in self._files else self._shown(file_id, content))

    async def _delete_file(self, request: web.Request) -> web.StreamResponse:
        file_id = request.match_info["id"]
        self._uploaded(file_id)
        del self._files[file_id]
        return _json(marked({"id": file_id, "object": "file", "deleted": True}))

    async def _create_openai(self, request: web.Request) -> web.StreamResponse:
        asked = await request.json()
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
        return self._answered(request, formats.openai_batch(batch, self._batches.now_s()))

    async def _list_openai(self, request: web.Request) -> web.StreamResponse:
        page, more = _page(self._batches.listed(OPENAI), request, "after", "limit", 20)
        data = [formats.openai_batch(batch, self._batches.now_s()) for batch in page]
        return _json(marked({"object": "list", "data": data, "has_more": more, **_ends(page)}))

    async def _openai_batch(self, request: web.Request) -> web.StreamResponse:
        return _json(formats.openai_batch(self._polled(request), self._batches.now_s()))

    async def _cancel_openai(self, request: web.Request) -> web.StreamResponse:
        batch = self._polled(request)
        self._batches.cancel(batch)
        return _json(formats.openai_batch(batch, self._batches.now_s()))

    # Anthropic

    async def _create_anthropic(self, request: web.Request) -> web.StreamResponse:
        lines = formats.anthropic_lines(await request.json())
        batch = self._batches.create(ANTHROPIC, "", lines, {})
        if batch.refused:
            return _error(MESSAGES, 429, batch.refused)
        return self._answered(request, formats.anthropic_batch(batch, _own_url(request)))

    async def _list_anthropic(self, request: web.Request) -> web.StreamResponse:
        page, more = _page(self._batches.listed(ANTHROPIC), request, "after_id", "limit", 20)
        data = [formats.anthropic_batch(batch, _own_url(request)) for batch in page]
        return _json(marked({"data": data, "has_more": more, **_ends(page)}))

    async def _anthropic_batch(self, request: web.Request) -> web.StreamResponse:
        return _json(formats.anthropic_batch(self._polled(request), _own_url(request)))

    async def _cancel_anthropic(self, request: web.Request) -> web.StreamResponse:
        batch = self._polled(request)
        self._batches.cancel(batch)
        return _json(formats.anthropic_batch(batch, _own_url(request)))

    async def _anthropic_results(self, request: web.Request) -> web.StreamResponse:
        batch = self._polled(request)
        if not batch.ended:
            raise NotThere
        return _lines(self._shown(batch.id, formats.anthropic_results(batch)))

    # Gemini

    async def _create_gemini(self, request: web.Request) -> web.StreamResponse:
        asked = (await request.json())["batch"]
        source = asked["inputConfig"]
        from_file = "fileName" in source
        if from_file:
            content = self._uploaded(source["fileName"].removeprefix("files/"))
            requests = [json.loads(line) for line in filter(None, content.splitlines())]
        else:
            requests = source["requests"]["requests"]
        version, model = request.match_info["version"], request.match_info["model"]
        lines = formats.gemini_lines(requests, version, model)
        details = {"model": model, "from_file": from_file}
        batch = self._batches.create(GOOGLE, str(asked["displayName"]), lines, details)
        if batch.refused:
            return _error(GEMINI, 429, batch.refused)
        return self._answered(request, formats.gemini_batch(batch, self._batches.now_s()))

    async def _list_gemini(self, request: web.Request) -> web.StreamResponse:
        page, more = _page(self._batches.listed(GOOGLE), request, "pageToken", "pageSize", 50)
        listed = [formats.gemini_batch(batch, self._batches.now_s()) for batch in page]
        following = {"nextPageToken": page[-1].id} if more else {}
        return _json(marked({"operations": listed, **following}))

    async def _gemini_batch(self, request: web.Request) -> web.StreamResponse:
        return _json(formats.gemini_batch(self._polled(request), self._batches.now_s()))

    async def _cancel_gemini(self, request: web.Request) -> web.StreamResponse:
        self._batches.cancel(self._polled(request))
        return _json(marked({}))

    async def _upload_gemini(self, request: web.Request) -> web.StreamResponse:
        """A resumable upload: it is announced, and then sent in as many pieces as it takes."""
        command = request.headers.get("x-goog-upload-command", "")
        if command == "start":
            file_id = self._keep_file(b"")
            url = f"{_own_url(request)}{request.path}?upload_id={file_id}&upload_protocol=resumable"
            return _json(marked({}), {"x-goog-upload-url": url, "x-goog-upload-status": "active"})
        file_id = request.query["upload_id"]
        self._files[file_id] = self._uploaded(file_id) + await request.read()
        if "finalize" not in command:
            return _json(marked({}), {"x-goog-upload-status": "active"})
        size = str(len(self._files[file_id]))
        told = {"name": f"files/{file_id}", "sizeBytes": size, "mimeType": "application/jsonl"}
        return _json(marked({"file": told}), {"x-goog-upload-status": "final"})

    async def _gemini_content(self, request: web.Request) -> web.StreamResponse:
        batch = self._batches.poll(request.match_info["id"].removeprefix("batch-"))
        if batch is None or not batch.ended:
            raise NotThere
        return _lines(self._shown(batch.id, formats.gemini_results(batch)))


def _page(
    batches: list[Batch], request: web.Request, cursor: str, size: str, usual: int
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


def _own_url(request: web.Request) -> str:
    return f"http://{request.host}"


def _error(wire: ServedFormat, status: int, message: str, delay_s: float = 0.0) -> web.Response:
    body, headers = wire.error(status, message, delay_s)
    return _json(marked(body), headers, status)


def _json(
    body: dict[str, Any], headers: dict[str, str] | None = None, status: int = 200
) -> web.Response:
    return web.Response(
        body=dumps(body), status=status, headers=headers, content_type="application/json"
    )


def _lines(body: bytes) -> web.Response:
    return web.Response(body=body, content_type="application/octet-stream")
