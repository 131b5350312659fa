"""The services of all formats against the emulator."""

import asyncio

import httpx
import pytest

from merge_runner.llm.formats import FORMATS
from merge_runner.llm.http_outcome import judge
from tests.support.batch_fixtures import endpoint_at, lines
from tests.support.mock_server import BatchPlan, FaultPlan


async def results_of(service, batch):
    """The results of a new batch, once it has ended, by key."""
    batch_id = await service.create(batch, "a mark")
    while (status := await service.status(batch_id)).paths is None:
        await asyncio.sleep(0.01)
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
    results = await results_of(service, batch)
    told = {key: (raw.status, raw.body) for key, raw in results.items()}
    assert told == {key: (200, raw.body) for key, raw in replies.items()}


async def test_failed_lines_are_judged_as_single_calls_and_others_were_never_asked(
    emulator, service_at, form
):
    url = await emulator(FaultPlan(seed=5, batch=BatchPlan(failed=0.3, expired=0.2)))
    batch, service = lines(form, 44), service_at(url, form)
    results = await results_of(service, batch)
    outcomes = {key: judge(raw, FORMATS[form]) for key, raw in results.items() if raw is not None}
    names = {"rate_limited", "server_error", "overloaded"}
    assert {each.name for each in outcomes.values() if each.action == "retry"} == names
    missing = {line.key for line in batch} - outcomes.keys()
    assert missing
    assert results.keys() - outcomes.keys() == (set() if form == "gemini" else missing)
    accepted = {key for key, outcome in outcomes.items() if outcome.action == "accept"}
    assert await answered_by(url) == dict.fromkeys(accepted, 1)
