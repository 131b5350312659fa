"""The providers' own libraries take the emulator, and the mock's batch modes, for the real ones."""

import io
import json

import pytest

from merge_runner.prompts.parse import parse_reply
from tests.support.mock_server import BatchPlan, FaultPlan
from tests.support.sdks import anthropic_client, gemini_client, openai_client

MODEL = "some-model"
# One of the libraries inherits from a class of aiohttp that is not made for it.
pytestmark = [
    pytest.mark.filterwarnings("ignore:Inheritance class:DeprecationWarning"),
    pytest.mark.usefixtures("no_settings_of_the_user"),
]


@pytest.fixture
async def limited(emulator):
    return await emulator(FaultPlan(rates={"rate_limit": 1.0}, delay_s=0.2))


async def ask_openai(url, prompt):
    """A chat completion and a response."""
    async with openai_client(url) as client:
        messages = [{"role": "user", "content": prompt}]
        chat = await client.chat.completions.create(model=MODEL, messages=messages)
        return chat, await client.responses.create(model=MODEL, input=prompt)


async def ask_anthropic(url, prompt):
    async with anthropic_client(url) as client:
        messages = [{"role": "user", "content": prompt}]
        return await client.messages.create(model=MODEL, max_tokens=1000, messages=messages)


async def ask_gemini(url, prompt, api_version="v1beta"):
    async with gemini_client(url, api_version).aio as client:
        return await client.models.generate_content(model=MODEL, contents=prompt)


async def test_openai_reads_a_chat_completion_a_response_and_the_models(emulator, driving_prompt):
    url = await emulator()
    chat, response = await ask_openai(url, driving_prompt)
    assert parse_reply(chat.choices[0].message.content, 20).plan
    assert parse_reply(response.output_text, 20).plan
    assert (chat.choices[0].finish_reason, response.status) == ("stop", "completed")
    assert (chat.model, response.model) == (MODEL, MODEL)
    assert chat.usage.prompt_tokens == response.usage.input_tokens == len(driving_prompt) // 4
    assert 0 < chat.usage.completion_tokens_details.reasoning_tokens < chat.usage.completion_tokens
    assert 0 < response.usage.output_tokens_details.reasoning_tokens < response.usage.output_tokens
    async with openai_client(url) as client:
        assert [model.id async for model in client.models.list()] == ["scripted-driver"]


async def test_anthropic_reads_a_message(emulator, driving_prompt):
    reply = await ask_anthropic(await emulator(), driving_prompt)
    assert parse_reply(reply.content[0].text, 20).plan
    assert (reply.stop_reason, reply.model) == ("end_turn", MODEL)
    assert reply.usage.input_tokens == len(driving_prompt) // 4
    assert 0 < reply.usage.output_tokens_details.thinking_tokens < reply.usage.output_tokens


# Without a version the library chooses the newest one that it knows.
@pytest.mark.parametrize("api_version", [None, "v1beta"])
async def test_gemini_reads_its_content(emulator, driving_prompt, api_version):
    reply = await ask_gemini(await emulator(), driving_prompt, api_version)
    usage = reply.usage_metadata
    assert parse_reply(reply.text, 20).plan
    assert (reply.candidates[0].finish_reason.name, reply.model_version) == ("STOP", MODEL)
    assert usage.prompt_token_count == len(driving_prompt) // 4
    parts = (usage.prompt_token_count, usage.candidates_token_count, usage.thoughts_token_count)
    assert usage.total_token_count == sum(parts)


async def test_every_library_raises_its_rate_limit_error(limited, driving_prompt):
    import anthropic
    import openai
    from google.genai.errors import ClientError

    with pytest.raises(openai.RateLimitError, match="Please try again in") as limit:
        await ask_openai(limited, driving_prompt)
    assert limit.value.code == "rate_limit_exceeded"
    with pytest.raises(anthropic.RateLimitError) as limit:
        await ask_anthropic(limited, driving_prompt)
    assert limit.value.response.headers["retry-after"] == "0.2"
    with pytest.raises(ClientError) as limit:
        await ask_gemini(limited, driving_prompt)
    assert (limit.value.code, limit.value.status) == (429, "RESOURCE_EXHAUSTED")


@pytest.fixture
async def batches(emulator):
    """A server of batches that end at the third look."""
    return await emulator(FaultPlan(batch=BatchPlan(polls=2)))


def jsonl(*lines):
    return "".join(json.dumps(line) + "\n" for line in lines).encode()


async def test_openai_creates_polls_lists_and_reads_a_batch(batches, driving_prompt):
    url = "/v1/chat/completions"
    body = {"model": MODEL, "messages": [{"role": "user", "content": driving_prompt}]}
    line = {"custom_id": "line-0", "method": "POST", "url": url, "body": body}
    terms = {"endpoint": url, "completion_window": "24h", "metadata": {"mark": "m1"}}
    async with openai_client(batches) as client:
        file = await client.files.create(file=("in.jsonl", jsonl(line)), purpose="batch")
        created = await client.batches.create(input_file_id=file.id, **terms)
        assert (created.status, created.metadata) == ("in_progress", {"mark": "m1"})
        states = [(await client.batches.retrieve(created.id)).status for _ in range(3)]
        assert states == ["in_progress", "in_progress", "completed"]
        (batch,) = [batch async for batch in client.batches.list(limit=2)]
        assert (batch.request_counts.completed, batch.error_file_id) == (1, None)
        (result,) = (await client.files.content(batch.output_file_id)).text.splitlines()
    told = json.loads(result)
    assert (told["custom_id"], told["response"]["status_code"]) == ("line-0", 200)
    assert parse_reply(told["response"]["body"]["choices"][0]["message"]["content"], 20).plan


async def test_anthropic_creates_polls_and_reads_a_batch(batches, driving_prompt):
    messages = [{"role": "user", "content": driving_prompt}]
    params = {"model": MODEL, "max_tokens": 1000, "messages": messages}
    async with anthropic_client(batches) as client:
        service = client.messages.batches
        created = await service.create(requests=[{"custom_id": "line-0", "params": params}])
        assert (created.request_counts.processing, created.results_url) == (1, None)
        states = [(await service.retrieve(created.id)).processing_status for _ in range(3)]
        assert states == ["in_progress", "in_progress", "ended"]
        (result,) = [result async for result in await service.results(created.id)]
    assert result.custom_id == "line-0"
    assert parse_reply(result.result.message.content[0].text, 20).plan


async def test_gemini_creates_polls_and_reads_a_batch(batches, driving_prompt):
    request = {"contents": [{"role": "user", "parts": [{"text": driving_prompt}]}]}
    async with gemini_client(batches).aio as client:
        file = await client.files.upload(
            file=io.BytesIO(jsonl({"key": "line-0", "request": request})),
            config={"mime_type": "application/jsonl"},
        )
        named = {"display_name": "m1"}
        created = await client.batches.create(model=MODEL, src=file.name, config=named)
        assert (created.state.name, created.display_name) == ("JOB_STATE_PENDING", "m1")
        states = [(await client.batches.get(name=created.name)).state.name for _ in range(3)]
        assert states == ["JOB_STATE_PENDING", "JOB_STATE_RUNNING", "JOB_STATE_SUCCEEDED"]
        batch = await client.batches.get(name=created.name)
        content = await client.files.download(file=batch.dest.file_name)
    told = json.loads(content)
    assert told["key"] == "line-0"
    assert parse_reply(told["response"]["candidates"][0]["content"]["parts"][0]["text"], 20).plan
