import asyncio
from pathlib import Path

import pytest

from merge_runner.errors import CallFailed, QuotaExhausted, UsageError
from merge_runner.llm import http_outcome
from merge_runner.llm.http_outcome import (
    Deadline,
    OutOfTime,
    TryAgain,
    backoff_s,
)


class Call:
    """A call whose attempts end as told, on a clock that only moves as told."""

    def __init__(self, loop, *results, takes_s=0.0, queue_s=0.0):
        self.results = list(results)
        self.takes_s = takes_s
        self.queue_s = queue_s
        self.now = 0.0
        loop.time, self.loop_time = lambda: self.loop_time() + self.now, loop.time
        self.turns = 0
        self.attempts = []
        self.sleeps = []

    async def take_turn(self):
        self.turns += 1
        self.now += self.queue_s
        return f"turn {self.turns}"

    async def attempt(self, turn, seconds_left):
        self.attempts.append((turn, seconds_left))
        self.now += self.takes_s
        result = self.results.pop(0) if len(self.results) > 1 else self.results[0]
        if isinstance(result, Exception):
            raise result
        return result

    async def sleep(self, seconds):
        self.sleeps.append(seconds)
        self.now += seconds

    async def run(self, deadline_s=600.0):
        deadline = Deadline(deadline_s)

        async def attempt():
            turn = await self.take_turn()
            with deadline.attempt() as seconds_left:
                return await self.attempt(turn, seconds_left)

        return await deadline.keep(attempt, sleep=self.sleep)


@pytest.fixture
async def make_call():
    loop = asyncio.get_running_loop()
    yield lambda *results, **timing: Call(loop, *results, **timing)
    del loop.time


async def test_an_answer_at_once_is_one_attempt(make_call):
    call = make_call("answer")
    assert await call.run() == "answer"
    assert call.attempts == [("turn 1", 600.0)]
    assert call.sleeps == []


async def test_attempts_go_on_until_there_is_an_answer_each_with_its_own_turn(make_call):
    call = make_call(TryAgain("a"), TryAgain("b"), TryAgain("c"), "answer")
    assert await call.run() == "answer"
    assert [turn for turn, _ in call.attempts] == ["turn 1", "turn 2", "turn 3", "turn 4"]


async def test_waits_double_from_half_a_second_to_a_minute(make_call):
    call = make_call(*[TryAgain("again")] * 11, "answer")
    await call.run()
    for number, slept in enumerate(call.sleeps):
        assert min(0.5 * 2**number, 60) <= slept <= min(0.5 * 2**number + 0.5, 60)
        assert backoff_s(number + 1) == min(0.5 * 2**number, 60)


async def test_waits_differ_so_that_those_who_failed_together_do_not_return_together(make_call):
    calls = [make_call(TryAgain("again"), "answer") for _ in range(10)]
    for call in calls:
        await call.run()
    assert len({call.sleeps[0] for call in calls}) > 1


async def test_the_delay_that_a_server_asks_for_is_slept(make_call):
    call = make_call(TryAgain("wait", 17.5), TryAgain("wait", 90.0), "answer")
    await call.run()
    assert call.sleeps == [17.5, 90.0]


async def test_a_server_cannot_shorten_the_backoff(make_call):
    call = make_call(TryAgain("a", 0.001), TryAgain("b", 0.001), TryAgain("c", 0.001), "answer")
    await call.run()
    assert [slept >= wait for slept, wait in zip(call.sleeps, (0.5, 1, 2), strict=True)] == [
        True,
        True,
        True,
    ]


async def test_a_deadline_of_ten_minutes_holds_at_least_eight_attempts(make_call):
    call = make_call(TryAgain("again"), takes_s=1.0)
    with pytest.raises(OutOfTime):
        await call.run(deadline_s=600.0)
    assert len(call.attempts) >= 8
    assert sum(call.sleeps) + len(call.attempts) <= 600.0


async def test_attempts_and_waits_count_against_the_deadline(make_call):
    call = make_call(TryAgain("wait", 10.0), takes_s=25.0)
    with pytest.raises(OutOfTime, match="100 s"):
        await call.run(deadline_s=100.0)
    assert [left for _, left in call.attempts] == pytest.approx([100, 65, 30], abs=1)
    assert len(call.sleeps) == 2


async def test_the_wait_for_a_turn_does_not_count(make_call):
    call = make_call(TryAgain("wait", 10.0), TryAgain("wait", 10.0), "answer", queue_s=1000.0)
    assert await call.run(deadline_s=100.0) == "answer"
    assert [left for _, left in call.attempts] == pytest.approx([100, 90, 80], abs=1)


async def test_a_wait_that_would_pass_the_deadline_is_not_begun(make_call):
    call = make_call(TryAgain("wait", 50.0), "never asked")
    with pytest.raises(OutOfTime) as caught:
        await call.run(deadline_s=50.0)
    assert call.sleeps == []
    assert isinstance(caught.value.__cause__, TryAgain)


@pytest.mark.parametrize(
    "error",
    [
        QuotaExhausted("no credit"),
        UsageError("wrong"),
        CallFailed("stopped", None),
        KeyError("bug"),
    ],
    ids=repr,
)
async def test_any_other_error_passes_through_at_once(make_call, error):
    call = make_call(error)
    with pytest.raises(type(error)) as caught:
        await call.run()
    assert caught.value is error
    assert len(call.attempts) == 1
    assert call.sleeps == []


async def test_a_wait_that_the_deadline_does_not_allow_is_told(make_call):
    call = make_call(TryAgain("HTTP 503: come back later", 3600.0))
    with pytest.raises(OutOfTime, match="asks to wait 3600 s, longer than a call"):
        await call.run(deadline_s=60.0)
    assert (len(call.attempts), call.sleeps) == (1, [])


def test_the_backoff_has_no_end_of_numbers():
    assert backoff_s(10**9) == 60


def test_no_newer_tenacity_warns_of_how_it_is_used():
    """What it deprecates (names of its waits) is not used: only its loop is."""
    used = Path(http_outcome.__file__).read_text()
    assert "tenacity.wait" not in used
