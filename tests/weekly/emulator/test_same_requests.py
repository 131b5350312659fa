"""What we send for a model is what its provider's own library sends for the same call.

The calls are written out here, and not read from the registry: a changed parameter there is seen.
"""

import email
import json
import re
from contextlib import asynccontextmanager
from dataclasses import replace
from email.policy import HTTP
from typing import NamedTuple

import pytest
from aiohttp import web

from merge_runner.llm.batch.providers import SERVICES
from merge_runner.llm.formats import FORMATS
from merge_runner.llm.http import HttpTransport
from merge_runner.llm.models import read_models
from merge_runner.providers import resolve_endpoint
from merge_runner.records import Slot, make_request
from tests.support.harness import PROJECT, listening, watched
from tests.support.sdks import gemini_client, openai_client

pytestmark = [
    pytest.mark.filterwarnings("ignore:Inheritance class:DeprecationWarning"),
    pytest.mark.usefixtures("no_settings_of_the_user"),
]
MODELS = read_models(PROJECT / "experiments/models.toml")
CAP = 16000
# What stands for the key that both send.
KEY = "dummy"


class Sent(NamedTuple):
    """A request as a server sees it, without what names the library and this one request."""

    call: str
    key: str
    content_type: str
    upload: dict
    body: object


async def seen(request):
    """A request, with its form or its JSON read."""
    content_type = request.headers.get("content-type", "")
    raw = await request.read()
    if content_type.startswith("multipart/"):
        head = f"content-type: {content_type}\r\n\r\n".encode()
        parts = email.message_from_bytes(head + raw, policy=HTTP).iter_parts()
        named = ((part.get_param("name", header="content-disposition"), part) for part in parts)
        body = {name: part.get_content() for name, part in named}
    else:
        body = json.loads(raw)
        if "/v1beta/" in request.path:
            body = camel(body)
    headers = {name.lower(): value for name, value in request.headers.items()}
    return Sent(
        f"{request.method} {request.path_qs}",
        headers.get("authorization") or headers.get("x-goog-api-key"),
        content_type.partition(";")[0],
        {name: value for name, value in headers.items() if name.startswith("x-goog-upload-")},
        body,
    )


def camel(value):
    """JSON of protobuf in one spelling: a server takes a field's name in both."""
    if isinstance(value, list):
        return [camel(each) for each in value]
    if not isinstance(value, dict):
        return value
    return {
        re.sub("_([a-z])", lambda match: match[1].upper(), name): camel(each)
        for name, each in value.items()
    }


@asynccontextmanager
async def recorded():
    """An emulator, and what it was asked."""
    requests = []

    async def watch(request, handler):
        requests.append(await seen(request))
        return await handler(request)

    async with watched(watch) as server:
        yield server.url, requests


@asynccontextmanager
async def transport_of(name, url):
    """The connection of a model of the registry to a server, with a key."""
    env = {"OPENAI_BASE_URL": f"{url}/v1", "GOOGLE_GEMINI_BASE_URL": url}
    env |= {"OPENAI_API_KEY": KEY, "GEMINI_API_KEY": KEY}
    endpoint = resolve_endpoint(name, MODELS[name], env)
    transport = HttpTransport(endpoint, connections=1)
    yield transport, endpoint
    await transport.close()


def request_of(name, prompt):
    """What a model is asked in a sweep."""
    entry = MODELS[name]
    wire = FORMATS[entry.format].request(entry, prompt)
    named = {"provider": entry.provider, "endpoint": entry.provider, "model": entry.id}
    sent = {"path": wire.path, "headers": wire.headers, "body": wire.body}
    return make_request(**named, **sent, slot=Slot("N_0_0", 1, "left", 0, 0))


async def ask_chat(url, prompt, **call):
    async with openai_client(url) as client:
        messages = [{"role": "user", "content": prompt}]
        await client.chat.completions.create(messages=messages, **call)


async def ask_responses(url, prompt, **call):
    async with openai_client(url) as client:
        await client.responses.create(input=prompt, **call)


async def ask_gemini(url, prompt, model, **config):
    from google.genai import types

    async with gemini_client(url).aio as client:
        await client.models.generate_content(
            model=model, contents=prompt, config=types.GenerateContentConfig(**config)
        )


NO_SAMPLING = {"max_output_tokens": CAP}
CALLS = {
    "o3": (
        ask_chat,
        {"model": "o3-2025-04-16", "reasoning_effort": "medium", "max_completion_tokens": CAP},
    ),
    "gpt-5.6-sol": (ask_responses, {"model": "gpt-5.6-sol", "store": False, **NO_SAMPLING}),
    "gpt-6-sol": (ask_responses, {"model": "gpt-6-sol", "store": False, **NO_SAMPLING}),
    "gemini-2.5-pro": (
        ask_gemini,
        {
            "model": "gemini-2.5-pro",
            "temperature": 1.0,
            "thinking_config": {"thinking_budget": -1},
            **NO_SAMPLING,
        },
    ),
    "gemini-3.8-flash": (ask_gemini, {"model": "gemini-3.8-flash", **NO_SAMPLING}),
    "gemini-3.1-pro-preview": (ask_gemini, {"model": "gemini-3.1-pro-preview", **NO_SAMPLING}),
}


def test_the_models_of_the_paper_and_their_successors_are_compared():
    closing = {name for name, entry in MODELS.items() if entry.shutdown}
    assert closing | {MODELS[name].successor for name in closing} <= CALLS.keys()


@pytest.mark.parametrize("name", CALLS)
async def test_a_request_is_field_by_field_that_of_the_providers_library(name, driving_prompt):
    ask, call = CALLS[name]
    async with recorded() as (url, requests), transport_of(name, url) as (transport, _):
        await transport.send(request_of(name, driving_prompt), attempt=1, timeout_s=10)
        await ask(url, driving_prompt, **call)
    ours, theirs = requests
    assert ours == theirs
    assert KEY in ours.key


@asynccontextmanager
async def batch_server():
    """A server that takes any file and any batch, and what it was asked."""
    requests = []

    async def handle(request):
        requests.append(await seen(request))
        upload = {"x-goog-upload-url": f"{url}/upload/v1beta/files?upload_id=a"}
        reply = {
            "id": "file-1" if "file" in request.path else "batch-1",
            "name": "batches/1",
            "file": {"name": "files/1", "uri": f"{url}/v1beta/files/1"},
        }
        return web.json_response(reply, headers=upload | {"x-goog-upload-status": "final"})

    async with listening(handle) as url:
        yield url, requests


async def submitted(name, url, prompt):
    """Submit a batch of one line as a sweep does."""
    async with transport_of(name, url) as (transport, endpoint):
        # Some members are sent to the provider's own host alone.
        own = replace(endpoint, identity=endpoint.provider)
        form = MODELS[name].format
        service = SERVICES[form](transport, own, FORMATS[form])
        await service.create([request_of(name, prompt)], "a-mark")


async def test_a_batch_of_o3_is_created_as_by_openais_library(driving_prompt):
    async with batch_server() as (url, requests):
        await submitted("o3", url, driving_prompt)
        ours, requests[:] = requests[:], []
        content = ours[0].body["file"]
        async with openai_client(url) as client:
            file = await client.files.create(
                file=("batch.jsonl", content, "application/jsonl"), purpose="batch"
            )
            await client.batches.create(
                input_file_id=file.id,
                endpoint="/v1/chat/completions",
                completion_window="24h",
                metadata={"merge_runner_mark": "a-mark"},
            )
    assert ours == requests


async def test_a_batch_of_gemini_is_created_as_by_googles_library(driving_prompt, tmp_path):
    from google.genai import types

    async with batch_server() as (url, requests):
        await submitted("gemini-2.5-pro", url, driving_prompt)
        ours, requests[:] = requests[:], []
        content = json.dumps(ours[1].body, separators=(",", ":")) + "\n"
        (tmp_path / "batch.jsonl").write_text(content)
        async with gemini_client(url).aio as client:
            file = await client.files.upload(
                file=tmp_path / "batch.jsonl",
                config=types.UploadFileConfig(display_name="a-mark", mime_type="application/jsonl"),
            )
            await client.batches.create(
                model="gemini-2.5-pro", src=file.name, config={"display_name": "a-mark"}
            )
    assert [each.call for each in ours] == [each.call for each in requests]
    upload, content, create = ours
    their_upload, their_content, their_create = requests
    # The library repeats the file's size and name, and leaves the key out of the second step.
    assert upload.upload.items() <= their_upload.upload.items()
    assert upload.body["file"].items() <= their_upload.body["file"].items()
    assert content.upload.items() <= their_content.upload.items()
    assert create == their_create
