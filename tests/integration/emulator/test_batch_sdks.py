"""The providers' own libraries take the emulator's batch modes for the real ones."""

from __future__ import annotations

import io
import json

import pytest

from merge_runner.prompts.parse import parse_reply
from tests.integration.emulator.test_sdks import (
    MODEL,
    _no_settings_of_the_user,  # noqa: F401 # a fixture of every test here
    anthropic_client,
    gemini_client,
    openai_client,
)
from tests.support.mock_server import BatchPlan, FaultPlan

pytestmark = pytest.mark.filterwarnings("ignore:Inheritance class:DeprecationWarning")
TWO_POLLS = FaultPlan(batch=BatchPlan(polls=2))
FULL = FaultPlan(batch=BatchPlan(enqueued_tokens=100))
NEVER = FaultPlan(batch=BatchPlan(delay_s=1000.0))
CHAT, RESPONSES = "/v1/chat/completions", "/v1/responses"


def chat_body(prompt):
    return {"model": MODEL, "messages": [{"role": "user", "content": prompt}]}


def openai_lines(prompt, url=CHAT, count=3):
    body = chat_body(prompt) if url == CHAT else {"model": MODEL, "input": prompt}
    lines = [
        {"custom_id": f"line-{n}", "method": "POST", "url": url, "body": {**body, "seed": n}}
        for n in range(count)
    ]
    return "".join(json.dumps(line) + "\n" for line in lines).encode()


async def create_openai(client, content, url=CHAT):
    file = await client.files.create(file=("in.jsonl", content), purpose="batch")
    return await client.batches.create(
        input_file_id=file.id, endpoint=url, completion_window="24h", metadata={"mark": "m1"}
    )


async def jsonl(client, file_id):
    content = await client.files.content(file_id)
    return [json.loads(line) for line in content.text.splitlines()]


@pytest.mark.parametrize("url", [CHAT, RESPONSES])
async def test_openai_creates_polls_and_reads_a_batch(emulator, driving_prompt, url):
    async with openai_client(await emulator(TWO_POLLS)) as client:
        created = await create_openai(client, openai_lines(driving_prompt, url), url)
        assert (created.status, created.metadata) == ("in_progress", {"mark": "m1"})
        assert created.request_counts.total == 3
        states = [(await client.batches.retrieve(created.id)).status for _ in range(3)]
        assert states == ["in_progress", "in_progress", "completed"]
        batch = await client.batches.retrieve(created.id)
        assert batch.request_counts.completed == 3
        assert batch.error_file_id is None
        results = await jsonl(client, batch.output_file_id)
    assert {result["custom_id"] for result in results} == {"line-0", "line-1", "line-2"}
    assert all(result["response"]["status_code"] == 200 for result in results)
    (body, *_) = [result["response"]["body"] for result in results]
    text = (
        body["choices"][0]["message"]["content"]
        if url == CHAT
        else body["output"][-1]["content"][0]["text"]
    )
    assert parse_reply(text, 20).plan


async def test_openai_lists_its_batches_page_by_page_the_newest_first(emulator, driving_prompt):
    async with openai_client(await emulator()) as client:
        created = [(await create_openai(client, openai_lines(driving_prompt))).id for _ in "abc"]
        listed = [batch.id async for batch in client.batches.list(limit=2)]
    assert listed == created[::-1]


async def test_openai_cancels_a_batch(emulator, driving_prompt):
    async with openai_client(await emulator(NEVER)) as client:
        created = await create_openai(client, openai_lines(driving_prompt))
        assert (await client.batches.cancel(created.id)).status == "cancelling"
        batch = await client.batches.retrieve(created.id)
        assert batch.status == "cancelled"
        errors = await jsonl(client, batch.error_file_id)
    assert [error["error"]["code"] for error in errors] == ["batch_cancelled"] * 3


async def test_openai_sees_a_batch_of_too_many_tokens_fail(emulator, driving_prompt):
    async with openai_client(await emulator(FULL)) as client:
        created = await create_openai(client, openai_lines(driving_prompt))
        assert (created.status, created.errors.data[0].code) == ("failed", "token_limit_exceeded")


async def test_openai_raises_its_errors_for_what_there_is_not_and_what_cannot_be(emulator):
    from openai import BadRequestError, NotFoundError

    async with openai_client(await emulator()) as client:
        with pytest.raises(NotFoundError):
            await client.batches.retrieve("batch_none")
        with pytest.raises(BadRequestError, match="not valid"):
            await create_openai(client, b"no json\n")
        with pytest.raises(BadRequestError, match="unique"):
            await create_openai(client, openai_lines("a", count=1) * 2)


def messages(prompt, count=3):
    return [
        {
            "custom_id": f"line-{n}",
            "params": {
                "model": MODEL,
                "max_tokens": 1000 + n,
                "messages": [{"role": "user", "content": prompt}],
            },
        }
        for n in range(count)
    ]


async def test_anthropic_creates_polls_and_reads_a_batch(emulator, driving_prompt):
    async with anthropic_client(await emulator(TWO_POLLS)) as client:
        batches = client.messages.batches
        created = await batches.create(requests=messages(driving_prompt))
        assert created.processing_status == "in_progress"
        assert (created.request_counts.processing, created.results_url) == (3, None)
        states = [(await batches.retrieve(created.id)).processing_status for _ in range(3)]
        assert states == ["in_progress", "in_progress", "ended"]
        assert (await batches.retrieve(created.id)).request_counts.succeeded == 3
        results = [result async for result in await batches.results(created.id)]
    assert {result.custom_id for result in results} == {"line-0", "line-1", "line-2"}
    assert parse_reply(results[0].result.message.content[0].text, 20).plan


async def test_anthropic_cancels_a_batch(emulator, driving_prompt):
    async with anthropic_client(await emulator(NEVER)) as client:
        batches = client.messages.batches
        created = await batches.create(requests=messages(driving_prompt))
        cancelled = await batches.cancel(created.id)
        assert cancelled.processing_status == "canceling"
        ended = await batches.retrieve(created.id)
        assert (ended.processing_status, ended.request_counts.canceled) == ("ended", 3)
        results = [result async for result in await batches.results(created.id)]
    assert {result.result.type for result in results} == {"canceled"}


async def test_anthropic_raises_its_errors(emulator, driving_prompt):
    from anthropic import BadRequestError, NotFoundError, RateLimitError

    async with anthropic_client(await emulator(FULL)) as client:
        with pytest.raises(RateLimitError, match="Enqueued token limit"):
            await client.messages.batches.create(requests=messages(driving_prompt))
        with pytest.raises(NotFoundError):
            await client.messages.batches.retrieve("msgbatch_none")
        with pytest.raises(BadRequestError, match="unique"):
            await client.messages.batches.create(requests=messages("a", 1) * 2)


async def create_gemini(client, prompt, count=3, name="m"):
    lines = [
        {
            "key": f"line-{n}",
            "request": {
                "contents": [{"role": "user", "parts": [{"text": prompt}]}],
                "generationConfig": {"maxOutputTokens": 1000 + n},
            },
        }
        for n in range(count)
    ]
    content = "".join(json.dumps(line) + "\n" for line in lines).encode()
    file = await client.files.upload(
        file=io.BytesIO(content), config={"mime_type": "application/jsonl"}
    )
    return await client.batches.create(model=MODEL, src=file.name, config={"display_name": name})


async def gemini_results(client, batch):
    content = await client.files.download(file=batch.dest.file_name)
    return [json.loads(line) for line in content.decode().splitlines()]


async def test_gemini_creates_polls_and_reads_a_batch(emulator, driving_prompt):
    async with gemini_client(await emulator(TWO_POLLS)).aio as client:
        created = await create_gemini(client, driving_prompt, name="m1")
        assert (created.state.name, created.display_name) == ("JOB_STATE_PENDING", "m1")
        states = [(await client.batches.get(name=created.name)).state.name for _ in range(3)]
        assert states == ["JOB_STATE_PENDING", "JOB_STATE_RUNNING", "JOB_STATE_SUCCEEDED"]
        results = await gemini_results(client, await client.batches.get(name=created.name))
    assert {line["key"] for line in results} == {"line-0", "line-1", "line-2"}
    text = results[0]["response"]["candidates"][0]["content"]["parts"][0]["text"]
    assert parse_reply(text, 20).plan


async def test_gemini_cancels_a_batch(emulator, driving_prompt):
    async with gemini_client(await emulator(NEVER)).aio as client:
        created = await create_gemini(client, driving_prompt)
        await client.batches.cancel(name=created.name)
        assert (await client.batches.get(name=created.name)).state.name == "JOB_STATE_CANCELLED"


async def test_gemini_raises_its_errors(emulator, driving_prompt):
    from google.genai.errors import ClientError

    async with gemini_client(await emulator(FULL)).aio as client:
        with pytest.raises(ClientError, match="Enqueued token limit") as full:
            await create_gemini(client, driving_prompt)
        assert full.value.code == 429
        with pytest.raises(ClientError) as missing:
            await client.batches.get(name="batches/none")
        assert missing.value.code == 404
