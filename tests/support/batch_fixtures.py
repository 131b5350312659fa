from __future__ import annotations

import contextlib

import pytest
from aiohttp import web

from merge_runner.config import Endpoint, ModelEntry
from merge_runner.llm.batch.providers import SERVICES
from merge_runner.llm.formats import FORMATS
from merge_runner.llm.http import HttpTransport
from tests.support.mock_server import serve

# What stands before the paths of a provider: OpenAI's version belongs to its base URL.
PROVIDERS = {
    "openai-chat": ("openai", "/v1"),
    "openai-responses": ("openai", "/v1"),
    "anthropic": ("anthropic", ""),
    "gemini": ("gemini", ""),
}
KEY = "sk-dummy-0123456789"


def entry_of(form, provider=None, **options):
    return ModelEntry(
        provider=provider or PROVIDERS[form][0],
        format=form,
        id="some-model",
        max_output_tokens=1000,
        **options,
    )


@pytest.fixture(autouse=True)
def _no_certificates(monkeypatch, tmp_path):
    # Nothing here speaks TLS, and to load the certificates takes longer than most of the tests.
    monkeypatch.delenv("SSL_CERT_FILE", raising=False)
    monkeypatch.setenv("SSL_CERT_DIR", str(tmp_path))


@pytest.fixture(params=PROVIDERS)
def form(request):
    """Every wire format in turn."""
    return request.param


@pytest.fixture
async def emulator():
    """A function that starts an emulator with the given faults and returns its base URL."""
    async with contextlib.AsyncExitStack() as stack:

        async def start(faults=None):
            runner, url = await serve(0, faults)
            stack.push_async_callback(runner.cleanup)
            return url

        yield start


@pytest.fixture
async def transport_to():
    """A function that makes a transport to an endpoint."""
    async with contextlib.AsyncExitStack() as stack:

        def make(endpoint, **options):
            transport = HttpTransport(endpoint, connections=4, **options)
            stack.push_async_callback(transport.close)
            return transport

        yield make


def endpoint_at(url, form, provider=None):
    name = provider or PROVIDERS[form][0]
    headers = {"authorization": f"Bearer {KEY}"}
    return Endpoint(name, name, url + PROVIDERS[form][1], headers)


@pytest.fixture
def service_at(transport_to):
    """A function that makes the batch service of a format at a base URL."""

    def make(url, form, provider=None, **options):
        endpoint = endpoint_at(url, form, provider)
        transport = transport_to(endpoint, **options)
        return SERVICES[form](transport, endpoint, FORMATS[form])

    return make


class Says:
    """A server that answers each method and path as told, and keeps what it was asked."""

    def __init__(self):
        self.url = ""
        self.asked = []
        self.replies = {}

    async def handle(self, request):
        await request.read()
        self.asked.append((f"{request.method} {request.path}", dict(request.headers)))
        reply = self.replies.get(f"{request.method} {request.path}")
        if reply is None:
            return web.json_response({"error": {"message": "not found"}}, status=404)
        return await reply(request) if callable(reply) else reply_of(reply)


def reply_of(told):
    status, body, *headers = told
    if isinstance(body, bytes):
        return web.Response(status=status, body=body)
    return web.json_response(body, status=status, headers=headers[0] if headers else None)


@pytest.fixture
async def server():
    said = Says()
    app = web.Application(client_max_size=2**26)
    app.router.add_route("*", "/{path:.*}", said.handle)
    runner = web.AppRunner(app, access_log=None, shutdown_timeout=0.1)
    await runner.setup()
    await web.TCPSite(runner, "127.0.0.1", 0).start()
    said.url = f"http://127.0.0.1:{runner.addresses[0][1]}"
    yield said
    await runner.cleanup()
