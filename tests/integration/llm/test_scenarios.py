"""What becomes of a call in every scenario, in every format of it.

The real client asks an emulator over loopback, in virtual time: see virtual_time.py.
"""

from contextlib import asynccontextmanager

import pytest

from merge_runner.emulator.driver import answer
from merge_runner.errors import MergeRunnerError
from merge_runner.llm.delays import FIRST_BACKOFF_S, LONGEST_BACKOFF_S, backoff_s
from merge_runner.llm.http import HttpTransport
from merge_runner.providers import Endpoint, ModelEntry
from merge_runner.records import CallFailed, Slot
from tests.support.clients import client_of, reply_to
from tests.support.scenarios import CASES, MODELS, OPENAI, ScenarioPlan, playing
from tests.support.virtual_time import in_virtual_time, now_s

TIMEOUT_S, DEADLINE_S = 600, 1200
EXIT_CODES = {"CallFailed": 1, "EndpointRefused": 2, "QuotaExhausted": 3}


@asynccontextmanager
async def emulated(cache, wire, plan):
    """A client of an emulator that plays a plan."""
    named = {"provider": "openai", "format": wire, "id": MODELS[wire], "price": "free"}
    limits = {"max_output_tokens": 16000, "timeout_s": TIMEOUT_S, "deadline_s": DEADLINE_S}
    entry = ModelEntry(**named, **limits, shutdown="2026-12-11")
    identity = f"{plan} {wire}"
    async with playing(plan) as url:
        base_url = f"{url}/v1" if wire in OPENAI else url
        transport = HttpTransport(Endpoint("openai", identity, base_url, {}), connections=4)
        try:
            yield client_of("my-model", entry, identity, cache, transport)
        finally:
            await transport.close()


def always(case, **changes):
    """A hang lasts longer than any deadline."""
    return ScenarioPlan(scenario=case.name, hang_s=10 * DEADLINE_S, **changes)


def ask(client):
    return reply_to(client, "prompt", Slot("N_0_0", 1, "left", 0, 0))


def cases(kind, formats=slice(None)):
    """A case for each scenario and format, or some of its formats."""
    return pytest.mark.parametrize(
        ("case", "wire"),
        [
            pytest.param(case, wire, id=f"{case.name} {wire}")
            for case in CASES[kind]
            for wire in case.formats[formats]
        ],
    )


def attempts_until_deadline(case, jitter_s):
    """How many attempts there are if every wait has so much jitter."""
    used_s, attempts = 0.0, 0
    while used_s < DEADLINE_S:
        attempts += 1
        used_s += min(case.takes_s, DEADLINE_S - used_s)
        used_s += max(case.wait_s, min(backoff_s(attempts) + jitter_s, LONGEST_BACKOFF_S))
    return attempts


@cases("answers")
@in_virtual_time
async def test_an_answer_is_kept_as_what_it_is(cache, case, wire):
    async with emulated(cache, wire, always(case)) as client:
        reply = await ask(client)
        waited_s = now_s()
        mismatches = client.meter.mismatches
        again = await ask(client)
    assert [attempt.outcome for attempt in reply.attempts] == [case.outcome] * case.attempts
    assert reply.outcome == case.outcome
    assert case.says in f"{reply.text} {reply.attempts[-1]} {list(mismatches)}"
    assert (reply.text == answer("prompt", None)) == (case.outcome == "ok")
    retried = [backoff_s(n) for n in range(1, case.attempts)]
    least_s = case.after_s + sum(retried)
    assert least_s <= waited_s <= least_s + FIRST_BACKOFF_S * len(retried) + 0.1
    assert (again.cached_attempts, again.text) == (len(reply.attempts), reply.text)


@cases("stops")
@in_virtual_time
async def test_what_no_attempt_would_mend_is_not_tried_again(cache, case, wire):
    async with emulated(cache, wire, always(case)) as client:
        with pytest.raises(MergeRunnerError) as caught:
            await ask(client)
    message = str(caught.value)
    assert client.meter.outcomes == {case.outcome: 1}
    assert type(caught.value).__name__ == case.error
    assert caught.value.exit_code == EXIT_CODES[case.error]
    assert ("my-model" in message, case.says in message, "\n" in message) == (True, True, False)
    assert now_s() < 0.1


@cases("passes")
@in_virtual_time
async def test_what_passes_is_tried_again_after_the_servers_delay(cache, case, wire):
    async with emulated(cache, wire, always(case, first_alone=True)) as client:
        reply = await ask(client)
        waited_s = now_s() - case.takes_s
    assert [attempt.outcome for attempt in reply.attempts] == [case.outcome, "ok"]
    assert reply.text == answer("prompt", None)
    assert max(case.wait_s, FIRST_BACKOFF_S) - 0.1 <= waited_s
    assert waited_s <= max(case.wait_s, 2 * FIRST_BACKOFF_S) + 0.1


@cases("passes", slice(1))
@in_virtual_time
async def test_what_does_not_pass_fails_at_the_deadline(cache, case, wire):
    async with emulated(cache, wire, always(case)) as client:
        with pytest.raises(CallFailed) as caught:
            await ask(client)
        waited_s = now_s()
    attempts = [attempt.outcome for attempt in caught.value.attempts]
    assert set(attempts) == {case.outcome}
    fewest, most = (attempts_until_deadline(case, jitter_s) for jitter_s in (FIRST_BACKOFF_S, 0))
    assert fewest <= len(attempts) <= most
    assert DEADLINE_S - max(case.wait_s, LONGEST_BACKOFF_S) - 1 <= waited_s <= DEADLINE_S
    assert caught.value.exit_code == 1
    message = str(caught.value)
    for said in (f"no reply within {DEADLINE_S} s", case.says, f"{len(attempts)} attempts"):
        assert said in message
    assert "\n" not in message
