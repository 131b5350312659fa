"""What becomes of batches at the emulator, on a clock of the test's own."""

from __future__ import annotations

import json

import aiohttp
import pytest

from merge_runner.emulator.handler import CHAT, Asked
from merge_runner.errors import UsageError
from merge_runner.records import SLOT_HEADER
from tests.support.mock_server import BatchPlan, FaultPlan, FaultyEmulator
from tests.support.mock_server.batches import Batches, Line


class Clock:
    def __init__(self):
        self.now_s = 1000.0

    def __call__(self):
        return self.now_s


@pytest.fixture
def clock():
    return Clock()


def batches_of(clock, seed=0, **plan):
    return Batches(FaultyEmulator(FaultPlan(seed=seed, batch=BatchPlan(**plan))), clock)


def chat(prompt, number=0):
    body = {"model": "m", "messages": [{"role": "user", "content": prompt}], "seed": number}
    return Line(f"line-{number}", Asked(CHAT, CHAT.path, json.dumps(body).encode()))


def some(prompt, count=20):
    return [chat(prompt, number) for number in range(count)]


def test_a_batch_ends_on_the_clock_with_its_last_line(clock, driving_prompt):
    batches = batches_of(clock, delay_s=100.0)
    batch = batches.create("b", some(driving_prompt), {})
    counts = []
    while batches.poll(batch.id).results is None:
        counts.append(batch.finished(clock.now_s))
        clock.now_s += 10
    assert counts == sorted(counts)
    assert counts[0] == 0 < counts[5] < 20
    assert 1020 < 1000 + max(fate.after_s for fate in batch.fates) <= clock.now_s <= 1110
    assert [each.custom_id for each in batch.results] != [each.custom_id for each in batch.lines]


def test_a_slow_line_keeps_its_batch_waiting(clock, driving_prompt):
    tailed = batches_of(clock, delay_s=100.0, slow=0.1, slow_factor=50.0)
    slow = tailed.create("b", some(driving_prompt), {})
    late = [fate.after_s for fate in slow.fates if fate.after_s > 100]
    assert 0 < len(late) < 10


def test_the_fate_of_a_line_is_a_function_of_the_seed_and_of_how_often_it_was_submitted(
    clock, driving_prompt
):
    def fates(seed, times):
        batches = batches_of(clock, seed, failed=0.3, expired=0.3)
        created = [batches.create("b", some(driving_prompt), {}) for _ in range(times)]
        return [fate.kind for fate in created[-1].fates]

    assert fates(0, 1) == fates(0, 1)
    assert len({tuple(each) for each in (fates(0, 1), fates(1, 1), fates(0, 2))}) == 3


def test_each_kind_of_line_occurs_at_its_rate(clock, driving_prompt):
    batches = batches_of(clock, failed=0.1, expired=0.05)
    kinds = [fate.kind for fate in batches.create("b", some("x", 4000), {}).fates]
    assert kinds.count("failed") == pytest.approx(400, abs=80)
    assert kinds.count("not asked") == pytest.approx(200, abs=60)


def test_tokens_wait_until_their_batch_has_ended(clock, driving_prompt):
    lines = some(driving_prompt)
    tokens = sum(len(line.asked.raw) for line in lines) // 4
    batches = batches_of(clock, delay_s=10.0, enqueued_tokens=tokens)
    assert not batches.create("b", lines, {}).refused
    assert "Limit" in batches.create("b", lines[:1], {}).refused
    clock.now_s += 20
    assert not batches.create("b", lines[:1], {}).refused


def test_a_line_that_cannot_be_read_fails_alone(clock, driving_prompt):
    batches = batches_of(clock)
    odd = Line("odd", Asked(CHAT, CHAT.path, b'{"messages": 7}'))
    batch = batches.create("b", [chat(driving_prompt), odd], {})
    batches.settle()
    assert {each.custom_id: each.status for each in batch.results} == {"line-0": 200, "odd": 400}


def test_a_batch_has_a_line(clock):
    with pytest.raises(UsageError, match="needs lines"):
        batches_of(clock).create("b", [], {})


async def test_the_emulator_counts_its_answers_singly_and_in_batches(emulator, driving_prompt):
    body = {"model": "m", "messages": [{"role": "user", "content": driving_prompt}]}
    slot = json.dumps(
        {"condition": "N_0_0", "repetition": 1, "side": "left", "decision": 0, "sample_set": 0}
    )
    line = {"custom_id": "k", "params": {**body, "max_tokens": 9}}
    async with aiohttp.ClientSession(await emulator()) as session:
        for _ in range(2):
            await session.post("/v1/chat/completions", json=body, headers={SLOT_HEADER: slot})
        await session.post("/v1/messages/batches", json={"requests": [line]})
        async with session.get("/emulator/answered") as reply:
            counted = await reply.json()
    assert [(each["custom_id"], each["slot"], each["answered"]) for each in counted] == [
        (None, slot, 2),
        ("k", None, 1),
    ]
