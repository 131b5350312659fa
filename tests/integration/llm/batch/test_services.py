"""The services of all formats against the emulator."""

from __future__ import annotations

import asyncio
from collections import Counter

import httpx
import pytest

from merge_runner.llm.batch.providers import BatchFailed
from merge_runner.llm.formats import FORMATS
from merge_runner.llm.http_outcome import judge
from tests.support.batch_fixtures import endpoint_at
from tests.support.batch_lines import keys, lines
from tests.support.mock_server import BatchPlan, FaultPlan

MARK = "round-1"


def plan(seed=0, **batch):
    return FaultPlan(seed=seed, batch=BatchPlan(**batch))


async def ended(service, batch_id):
    """The status of a batch once it no longer waits."""
    while (status := await service.status(batch_id)).paths is None:
        await asyncio.sleep(0.01)
    return status


async def results_of(service, batch_id):
    status = await ended(service, batch_id)
    return {key: raw async for key, raw in service.results(status.paths)}


async def answered_by(url):
    async with httpx.AsyncClient() as client:
        return (await client.get(f"{url}/emulator/answered")).json()


@pytest.mark.parametrize("provider", [None, "emulator"])
async def test_a_line_has_the_reply_of_the_plain_endpoint(
    emulator, service_at, transport_to, form, provider
):
    batch = lines(form, provider=provider)
    plain = transport_to(endpoint_at(await emulator(), form, provider))
    replies = {line.key: await plain.send(line, attempt=1, timeout_s=10) for line in batch}
    service = service_at(await emulator(), form, provider)
    results = await results_of(service, await service.create(batch, MARK))
    assert {key: raw.body for key, raw in results.items()} == {
        key: raw.body for key, raw in replies.items()
    }
    assert all(raw.status == 200 for raw in results.values())


async def test_failed_lines_are_judged_as_single_calls_and_others_were_never_asked(
    emulator, service_at, form
):
    url = await emulator(plan(seed=5, failed=0.3, expired=0.2))
    batch, service = lines(form, 44), service_at(url, form)
    results = await results_of(service, await service.create(batch, MARK))
    replies = {key: raw for key, raw in results.items() if raw is not None}
    outcomes = [judge(raw, FORMATS[form]) for raw in replies.values()]
    assert Counter(outcome.action for outcome in outcomes).keys() == {"accept", "retry"}
    assert {outcome.name for outcome in outcomes if outcome.action == "retry"} == {
        "rate_limited",
        "server_error",
        "overloaded",
    }
    missing = set(keys(batch)) - replies.keys()
    assert missing
    told = results.keys() - replies.keys()
    assert told == (set() if form == "gemini" else missing)
    count = await answered_by(url)
    assert {each["custom_id"] for each in count} == {
        key for key, outcome in zip(replies, outcomes, strict=True) if outcome.action == "accept"
    }
    assert {each["answered"] for each in count} == {1}


MARKED = ["openai-chat", "gemini"]


@pytest.mark.parametrize("form", MARKED, indirect=True)
async def test_a_batch_whose_creation_was_not_answered_is_found(emulator, service_at, form):
    url = await emulator(plan(lost=1.0))
    batch, service = lines(form), service_at(url, form)
    for mark, each in (("other", lines(form, first=100)), (MARK, batch)):
        with pytest.raises(BatchFailed) as lost:
            await service.create(each, mark)
        assert (lost.value.kind, lost.value.sent) == ("again", True)
    found = await service.find(MARK)
    assert (await results_of(service, found)).keys() == set(keys(batch))
    assert await service.find("other") not in (found, None)
    assert await service.find("none") is None
    assert {each["answered"] for each in await answered_by(url)} == {1}


@pytest.mark.parametrize("oldest_first", [False, True])
@pytest.mark.parametrize("form", MARKED, indirect=True)
async def test_a_batch_is_found_among_many_in_any_order(emulator, service_at, form, oldest_first):
    service = service_at(await emulator(plan(oldest_first=oldest_first)), form)
    for number in range(110):
        if number == (100 if oldest_first else 5):
            created = await service.create(lines(form, 1, first=500), MARK)
        await service.create(lines(form, 2, first=number), f"other-{number}")
    assert await service.find(MARK) == created


async def test_too_many_enqueued_tokens_ask_for_smaller_batches(emulator, service_at, form):
    batch = lines(form)
    tokens = sum(len(line.body) for line in batch) // 4
    service = service_at(await emulator(plan(delay_s=1000.0, enqueued_tokens=tokens)), form)
    await service.create(batch[:6], MARK)
    if form.startswith("openai"):
        status = await service.status(await service.create(batch, "second"))
        assert (status.paths, status.failure.kind) == (None, "smaller")
        assert "Enqueued token limit" in str(status.failure)
    else:
        with pytest.raises(BatchFailed, match="Enqueued token limit") as full:
            await service.create(batch, "second")
        assert (full.value.kind, full.value.sent) == ("smaller", False)
    third = await service.create(batch[6:9], "third")
    status = await service.status(third)
    assert (status.paths, status.failure) == (None, None)


async def test_results_that_come_late_and_in_part_can_be_read_again(emulator, service_at, form):
    service = service_at(await emulator(plan(late_results=2, short_results=1)), form)
    batch = lines(form)
    batch_id = await service.create(batch, MARK)
    status = await ended(service, batch_id)
    for _ in range(2):
        with pytest.raises(BatchFailed) as failed:
            await results_of(service, batch_id)
        assert failed.value.kind == "again"
    assert len(await results_of(service, batch_id)) == 5
    assert status.results == len(batch)
    assert sorted(await results_of(service, batch_id)) == sorted(keys(batch))
