"""The providers' own libraries take the emulator for the real thing."""

from __future__ import annotations

import os

import pytest

from merge_runner.prompts.parse import parse_reply
from tests.support.mock_server import FaultPlan

RATE_LIMITED = FaultPlan(rates={"rate_limit": 1.0}, delay_s=0.2)
MODEL = "some-model"
# One of the libraries inherits from a class of aiohttp that is not made for it.
pytestmark = pytest.mark.filterwarnings("ignore:Inheritance class:DeprecationWarning")


@pytest.fixture(autouse=True)
def _no_settings_of_the_user(monkeypatch, tmp_path):
    # Proxies would lead away from loopback, and the libraries read much more than keys.
    for name in list(os.environ):
        if name.upper().endswith("_PROXY") or name.startswith(("OPENAI_", "ANTHROPIC_", "GOOGLE_")):
            monkeypatch.delenv(name)
    # Nothing here speaks TLS, and to load the certificates takes longer than most of the tests.
    monkeypatch.delenv("SSL_CERT_FILE", raising=False)
    monkeypatch.setenv("SSL_CERT_DIR", str(tmp_path))


def openai_client(url):
    from openai import AsyncOpenAI

    return AsyncOpenAI(api_key="dummy", base_url=f"{url}/v1", max_retries=0, timeout=10)


def anthropic_client(url):
    from anthropic import AsyncAnthropic

    return AsyncAnthropic(api_key="dummy", base_url=url, max_retries=0, timeout=10)


def gemini_client(url, api_version="v1beta"):
    from google import genai

    # Its timeout is in ms; it does not retry unless told to.
    options = genai.types.HttpOptions(base_url=url, timeout=10_000, api_version=api_version)
    return genai.Client(api_key="dummy", http_options=options)


async def ask_openai_chat(url, prompt):
    async with openai_client(url) as client:
        return await client.chat.completions.create(
            model=MODEL, messages=[{"role": "user", "content": prompt}]
        )


async def ask_openai_responses(url, prompt):
    async with openai_client(url) as client:
        return await client.responses.create(model=MODEL, input=prompt)


async def ask_anthropic(url, prompt):
    async with anthropic_client(url) as client:
        return await client.messages.create(
            model=MODEL, max_tokens=1000, messages=[{"role": "user", "content": prompt}]
        )


async def ask_gemini(url, prompt, api_version="v1beta"):
    async with gemini_client(url, api_version).aio as client:
        return await client.models.generate_content(model=MODEL, contents=prompt)


@pytest.mark.slow
async def test_openai_reads_a_chat_completion(emulator, driving_prompt):
    reply = await ask_openai_chat(await emulator(), driving_prompt)
    (choice,) = reply.choices
    assert parse_reply(choice.message.content, 20).plan
    assert choice.finish_reason == "stop"
    assert reply.model == MODEL
    assert reply.usage.prompt_tokens == len(driving_prompt.encode()) // 4
    reasoning = reply.usage.completion_tokens_details.reasoning_tokens
    assert 0 < reasoning < reply.usage.completion_tokens


async def test_openai_reads_a_response(emulator, driving_prompt):
    reply = await ask_openai_responses(await emulator(), driving_prompt)
    assert parse_reply(reply.output_text, 20).plan
    assert reply.status == "completed"
    assert reply.incomplete_details is None
    assert reply.model == MODEL
    assert reply.usage.input_tokens == len(driving_prompt.encode()) // 4
    reasoning = reply.usage.output_tokens_details.reasoning_tokens
    assert 0 < reasoning < reply.usage.output_tokens


@pytest.mark.slow
async def test_anthropic_reads_a_message(emulator, driving_prompt):
    reply = await ask_anthropic(await emulator(), driving_prompt)
    (block,) = reply.content
    assert parse_reply(block.text, 20).plan
    assert reply.stop_reason == "end_turn"
    assert reply.model == MODEL
    assert reply.usage.input_tokens == len(driving_prompt.encode()) // 4
    assert 0 < reply.usage.output_tokens_details.thinking_tokens < reply.usage.output_tokens


# Without a version the library chooses the newest one that it knows.
@pytest.mark.parametrize("api_version", [None, "v1beta"])
async def test_gemini_reads_its_content(emulator, driving_prompt, api_version):
    reply = await ask_gemini(await emulator(), driving_prompt, api_version)
    assert parse_reply(reply.text, 20).plan
    assert reply.candidates[0].finish_reason.name == "STOP"
    assert reply.model_version == MODEL
    usage = reply.usage_metadata
    assert usage.prompt_token_count == len(driving_prompt.encode()) // 4
    assert usage.thoughts_token_count > 0
    assert usage.total_token_count == (
        usage.prompt_token_count + usage.candidates_token_count + usage.thoughts_token_count
    )


@pytest.mark.parametrize("ask", [ask_openai_chat, ask_openai_responses])
async def test_openai_raises_its_rate_limit_error(emulator, driving_prompt, ask):
    from openai import RateLimitError

    with pytest.raises(RateLimitError, match="Please try again in") as limit:
        await ask(await emulator(RATE_LIMITED), driving_prompt)
    assert limit.value.code == "rate_limit_exceeded"


async def test_anthropic_raises_its_rate_limit_error(emulator, driving_prompt):
    from anthropic import RateLimitError

    with pytest.raises(RateLimitError) as limit:
        await ask_anthropic(await emulator(RATE_LIMITED), driving_prompt)
    assert limit.value.body["error"]["type"] == "rate_limit_error"
    assert 0.1 <= float(limit.value.response.headers["retry-after"]) <= 0.3


async def test_gemini_raises_its_client_error_with_code_429(emulator, driving_prompt):
    from google.genai.errors import ClientError

    with pytest.raises(ClientError, match="Please retry in") as limit:
        await ask_gemini(await emulator(RATE_LIMITED), driving_prompt)
    assert (limit.value.code, limit.value.status) == (429, "RESOURCE_EXHAUSTED")


async def test_every_library_sees_a_refusal_as_one(emulator, driving_prompt):
    url = await emulator(FaultPlan(rates={"refused": 1.0}))
    chat = await ask_openai_chat(url, driving_prompt)
    assert chat.choices[0].message.content is None
    assert chat.choices[0].message.refusal
    response = await ask_openai_responses(url, driving_prompt)
    assert response.output[-1].content[0].refusal
    assert response.output_text == ""
    assert (await ask_anthropic(url, driving_prompt)).stop_reason == "refusal"
    gemini = await ask_gemini(url, driving_prompt)
    assert gemini.candidates[0].finish_reason.name == "SAFETY"
    assert gemini.text is None


async def test_openai_lists_the_models(emulator):
    async with openai_client(await emulator()) as client:
        assert [model.id async for model in client.models.list()] == ["scripted-driver"]
