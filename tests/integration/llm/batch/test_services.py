"""The services of all formats against the emulator."""

import asyncio

import httpx
import pytest

from merge_runner.llm.batch.service import BatchFailed
from merge_runner.llm.formats import FORMATS
from merge_runner.llm.http_outcome import judge
from tests.support.batch_fixtures import endpoint_at, lines
from tests.support.mock_server import BatchPlan, FaultPlan

MARK = "round-1"


def plan(seed=0, **batch):
    return FaultPlan(seed=seed, batch=BatchPlan(**batch))


def keys(batch):
    return {line.key for line in batch}


async def ended(service, batch_id):
    """The status of a batch once it no longer waits."""
    while (status := await service.status(batch_id)).paths is None:
        await asyncio.sleep(0.01)
    return status


async def results_of(service, batch_id):
    status = await ended(service, batch_id)
    return {key: raw async for key, raw in service.results(status.paths)}


async def answered_by(url):
    """How often each line was answered."""
    async with httpx.AsyncClient() as client:
        told = (await client.get(f"{url}/emulator/answered")).json()
    return {each["custom_id"]: each["answered"] for each in told}


@pytest.mark.parametrize("provider", [None, "emulator"])
async def test_a_line_has_the_reply_of_the_plain_endpoint(
    emulator, service_at, transport_to, form, provider
):
    batch = lines(form, 3, provider=provider)
    plain = transport_to(endpoint_at(await emulator(), form, provider))
    replies = {line.key: await plain.send(line, attempt=1, timeout_s=10) for line in batch}
    service = service_at(await emulator(), form, provider)
    results = await results_of(service, await service.create(batch, MARK))
    told = {key: (raw.status, raw.body) for key, raw in results.items()}
    assert told == {key: (200, raw.body) for key, raw in replies.items()}


async def test_failed_lines_are_judged_as_single_calls_and_others_were_never_asked(
    emulator, service_at, form
):
    url = await emulator(plan(seed=5, failed=0.3, expired=0.2))
    batch, service = lines(form, 44), service_at(url, form)
    results = await results_of(service, await service.create(batch, MARK))
    outcomes = {key: judge(raw, FORMATS[form]) for key, raw in results.items() if raw is not None}
    names = {"rate_limited", "server_error", "overloaded"}
    assert {each.name for each in outcomes.values() if each.action == "retry"} == names
    missing = keys(batch) - outcomes.keys()
    assert missing
    assert results.keys() - outcomes.keys() == (set() if form == "gemini" else missing)
    accepted = {key for key, outcome in outcomes.items() if outcome.action == "accept"}
    assert await answered_by(url) == dict.fromkeys(accepted, 1)


@pytest.mark.parametrize("form", ["openai-chat", "gemini"], indirect=True)
async def test_a_batch_whose_creation_was_not_answered_is_found(emulator, service_at, form):
    url = await emulator(plan(lost=1.0))
    batch, service = lines(form), service_at(url, form)
    for mark, each in (("other", lines(form, first=100)), (MARK, batch)):
        with pytest.raises(BatchFailed) as lost:
            await service.create(each, mark)
        assert (lost.value.kind, lost.value.sent) == ("again", True)
    found = await service.find(MARK)
    assert (await results_of(service, found)).keys() == keys(batch)
    assert await service.find("other") not in (found, None)
    assert await service.find("none") is None
    assert set((await answered_by(url)).values()) == {1}


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
    status = await service.status(await service.create(batch[6:9], "third"))
    assert (status.paths, status.failure) == (None, None)


async def test_results_that_come_late_and_in_part_can_be_read_again(emulator, service_at, form):
    service = service_at(await emulator(plan(late_results=2, short_results=1)), form)
    batch = lines(form)
    batch_id = await service.create(batch, MARK)
    assert (await ended(service, batch_id)).results == len(batch)
    for _ in range(2):
        with pytest.raises(BatchFailed) as failed:
            await results_of(service, batch_id)
        assert failed.value.kind == "again"
    assert len(await results_of(service, batch_id)) == 5
    assert (await results_of(service, batch_id)).keys() == keys(batch)
