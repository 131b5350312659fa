"""Batch services over HTTP: to the emulator, or to a server that says what a test tells it."""

import pytest
from aiohttp import web

from merge_runner.llm.batch.providers import SERVICES
from merge_runner.llm.formats import FORMATS
from merge_runner.llm.http import HttpTransport
from merge_runner.providers import Endpoint, ModelEntry
from merge_runner.records import Slot, make_request
from merge_runner.scenarios.merge.conditions import CONDITIONS
from tests.support.emulator_fixtures import first_prompt
from tests.support.harness import listening

KEY = "sk-dummy-0123456789"


def provider_of(form):
    return form.partition("-")[0]


def entry_of(form, provider=None, **options):
    named = {"provider": provider or provider_of(form), "format": form, "id": "some-model"}
    return ModelEntry(max_output_tokens=1000, **named, **options)


def lines(form, count=11, *, provider=None, first=0):
    """So many different requests with real prompts, each of another slot."""
    entry, made = entry_of(form, provider), []
    for number in range(first, first + count):
        condition = list(CONDITIONS)[number % len(CONDITIONS)]
        slot = Slot(condition, 1 + number // len(CONDITIONS), "left", 0, 0)
        sent = FORMATS[form].request(entry, f"{first_prompt(condition)}\n{slot.repetition}")
        named = {"provider": entry.provider, "endpoint": entry.provider, "model": entry.id}
        sent = {"path": sent.path, "headers": sent.headers, "body": sent.body}
        made.append(make_request(slot=slot, **named, **sent))
    return made


@pytest.fixture(params=FORMATS)
def form(request):
    """Every wire format in turn."""
    return request.param


@pytest.fixture
async def transport_to():
    """A function that makes a transport to an endpoint."""
    made = []

    def make(endpoint, **options):
        made.append(HttpTransport(endpoint, connections=4, **options))
        return made[-1]

    yield make
    for transport in made:
        await transport.close()


def endpoint_at(url, form, provider=None):
    """OpenAI's version belongs to its base URL."""
    name = provider or provider_of(form)
    base_url = f"{url}/v1" if form.startswith("openai") else url
    return Endpoint(name, name, base_url, {"authorization": f"Bearer {KEY}"})


@pytest.fixture
def service_at(transport_to):
    """A function that makes the batch service of a format at a base URL."""

    def make(url, form, provider=None, **options):
        endpoint = endpoint_at(url, form, provider)
        return SERVICES[form](transport_to(endpoint, **options), endpoint, FORMATS[form])

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
        told = self.replies.get(f"{request.method} {request.path}", (404, {"error": "not found"}))
        if callable(told):
            return await told(request)
        status, body, *headers = told
        if isinstance(body, bytes):
            return web.Response(status=status, body=body)
        return web.json_response(body, status=status, headers=headers[0] if headers else None)


@pytest.fixture
async def server():
    said = Says()
    async with listening(said.handle) as said.url:
        yield said
