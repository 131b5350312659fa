"""When a call is tried again, and until when: by the clock of its server."""

import asyncio
from itertools import pairwise

import pytest

from merge_runner.llm.delays import backoff_s
from merge_runner.llm.limiter import Limiter
from merge_runner.records import CallFailed
from tests.support.clients import answer, error, reply_to, slot
from tests.support.virtual_time import now_s

pytestmark = pytest.mark.usefixtures("virtual_time")
BUSY = error(503)


def waits(client):
    """The waits in s between the attempts that the server saw."""
    return [later - earlier for earlier, later in pairwise(client.direct.transport.times)]


async def test_waits_double_from_half_a_second_to_a_minute(make):
    client = make(*[BUSY] * 11, answer())
    await reply_to(client, "prompt", slot())
    for number, wait_s in enumerate(waits(client)):
        assert min(0.5 * 2**number, 60) - 0.001 <= wait_s <= min(0.5 * 2**number + 0.5, 60) + 0.001
        assert backoff_s(number + 1) == min(0.5 * 2**number, 60)
    assert backoff_s(10**9) == 60


async def test_waits_differ_so_that_those_who_failed_together_do_not_return_together(make):
    clients = [make(BUSY, answer()) for _ in range(10)]
    await asyncio.gather(*(reply_to(client, "p", slot(n)) for n, client in enumerate(clients, 1)))
    assert len({waits(client)[0] for client in clients}) > 1


async def test_attempts_and_waits_count_against_the_deadline(make):
    client = make(error(503, "no room", retry_after="30"), deadline_s=100.0, timeout_s=60)
    with pytest.raises(CallFailed, match=r"no reply within 100 s.*no room") as caught:
        await reply_to(client, "prompt", slot())
    assert client.direct.transport.timeouts == pytest.approx([60, 60, 40, 10], abs=0.01)
    assert [attempt.outcome for attempt in caught.value.attempts] == ["overloaded"] * 4
    assert now_s() < 91, "a wait that would pass the deadline is not begun"


async def test_the_wait_for_a_turn_does_not_count(make):
    again = error(503, retry_after="10")
    client = make(again, again, answer(), deadline_s=50.0, limiter=Limiter(rpm=1))
    assert (await reply_to(client, "prompt", slot())).outcome == "ok"
    assert now_s() > 100
    assert client.direct.transport.timeouts == pytest.approx([50, 40, 30], abs=0.01)
