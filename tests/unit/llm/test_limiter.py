import asyncio
import random

import pytest
from asyncio_throttle.throttler import Throttler
from hypothesis import given, settings
from hypothesis import strategies as st

from merge_runner.errors import UsageError
from merge_runner.llm.limiter import Limiter
from tests.support.cases import cases
from tests.support.clients import ticks
from tests.support.virtual_time import fullest_window, in_virtual_time, now_s

pytestmark = pytest.mark.usefixtures("virtual_time")
MINUTE = 60.0


class Queue:
    """Asks a limiter for turns and notes who was served when."""

    def __init__(self, limiter):
        self.limiter = limiter
        self.tasks, self.names, self.times, self.tokens = [], [], [], []

    def ask(self, name="", tokens=0, order=0):
        task = asyncio.create_task(self._ask(name, tokens, order))
        self.tasks.append(task)
        return task

    async def _ask(self, name, tokens, order):
        correct = await self.limiter.acquire(tokens, order=order)
        self.names.append(name)
        self.times.append(now_s())
        self.tokens.append(tokens)
        return correct

    async def all_served(self):
        await asyncio.gather(*self.tasks)


async def served(limiter, count=1, tokens=0):
    """When so many who ask at once are served."""
    queue = Queue(limiter)
    for number in range(count):
        queue.ask(number, tokens)
    await queue.all_served()
    return queue.times


@pytest.mark.parametrize("case", cases("limiter"))
async def test_a_turn_is_given_as_soon_as_the_limits_allow_it(case):
    limiter, asked = Limiter(**case.get("limits", {})), {}
    queue = Queue(limiter)
    for step in case["steps"]:
        who, verb, *words = step.split()
        match verb, [int(word) for word in words]:
            case "asks", numbers:
                asked[who] = queue.ask(who, *numbers)
            case "uses", [tokens]:
                (await asked[who])(tokens)
            case "waits", []:
                assert not asked[who].done()
            case "leaves", []:
                asked[who].cancel()
            case "pauses", [seconds]:
                limiter.pause(seconds)
            case "passes", [seconds]:
                await asyncio.sleep(seconds)
        await ticks()
    await asyncio.gather(*queue.tasks, return_exceptions=True)
    served = zip(queue.names, queue.times, strict=True)
    assert [f"{name} {time:g}" for name, time in served] == case["served"]


@pytest.mark.parametrize("limits", [{}, {"rpm": 600}, {"tpm": 100}], ids=str)
async def test_the_lowest_order_goes_first_and_within_it_the_first_come(limits):
    limiter = Limiter(**limits)
    limiter.pause(1)
    queue = Queue(limiter)
    orders = [number % 5 for number in range(200)]
    random.Random(1).shuffle(orders)
    for arrival, order in enumerate(orders):
        queue.ask((order, arrival), tokens=1, order=order)
    await queue.all_served()
    assert queue.names == sorted(queue.names)


async def test_an_older_request_that_comes_while_the_throttle_waits_is_next(monkeypatch):
    acquire = Throttler.acquire

    async def slowly(throttle):
        await asyncio.sleep(1)
        await acquire(throttle)

    monkeypatch.setattr(Throttler, "acquire", slowly)
    queue = Queue(Limiter(rpm=60))
    for name, order in (("younger", 5), ("older", 1)):
        queue.ask(name, order=order)
        await ticks()
    await asyncio.wait_for(queue.all_served(), MINUTE)
    assert queue.names == ["younger", "older"]


@pytest.mark.parametrize("rpm", [1, 7, 50, 245, 500])
async def test_no_window_holds_more_requests_than_the_limit(rpm):
    times = await served(Limiter(rpm=rpm), int(rpm * 1.1) + 2)
    assert fullest_window(times, [1] * len(times)) <= rpm


@pytest.mark.parametrize("rpm", [60, 500])
async def test_requests_flow_evenly_and_not_a_window_at_once(rpm):
    times = await served(Limiter(rpm=rpm), rpm // 3)
    assert fullest_window(times, [1] * len(times), length=1.0) <= 2 * rpm / 60


async def test_an_idle_limiter_saves_up_no_requests():
    limiter = Limiter(rpm=10)
    await served(limiter)
    await asyncio.sleep(10 * MINUTE)
    assert fullest_window(await served(limiter, 30), [1] * 30) <= 10


async def test_a_turn_that_a_pause_holds_up_is_not_one_too_many_after_it():
    limiter = Limiter(rpm=4)
    queue = Queue(limiter)
    queue.ask()
    await ticks()
    for _ in range(8):
        queue.ask()
    await asyncio.sleep(5)
    limiter.pause(30)
    await queue.all_served()
    assert fullest_window(queue.times, [1] * 9) <= 4


async def test_short_windows_work_alike():
    times = await served(Limiter(rpm=20, tpm=100, window_s=0.3), 50, tokens=7)
    assert fullest_window(times, [1] * 50, 0.3) <= 20
    assert fullest_window(times, [7] * 50, 0.3) <= 100


@settings(max_examples=40)
@given(st.lists(st.tuples(st.integers(0, 100), st.integers(0, 3), st.integers(0, 30)), max_size=30))
@in_virtual_time
async def test_no_window_holds_more_tokens_than_the_limit(asked):
    queue = Queue(Limiter(tpm=100))
    for number, (tokens, order, pause) in enumerate(asked):
        queue.ask(number, tokens, order)
        await asyncio.sleep(pause)
    await queue.all_served()
    assert len(queue.names) == len(asked)
    assert fullest_window(queue.times, queue.tokens) <= 100


@settings(max_examples=40)
@given(
    st.lists(st.tuples(st.integers(0, 100), st.integers(0, 100), st.integers(0, 90)), max_size=20)
)
@in_virtual_time
async def test_corrected_tokens_are_what_counts(asked):
    """With every request corrected at once, the actual tokens alone fill the window."""
    queue = Queue(Limiter(tpm=100))
    times, actual = [], []
    for estimate, share, pause in asked:
        correct = await queue.ask(tokens=estimate)
        used = estimate * share // 100
        correct(used)
        times.append(now_s())
        actual.append(used)
        await asyncio.sleep(pause)
    assert fullest_window(times, actual) <= 100


async def test_a_request_above_the_token_limit_is_refused_with_advice():
    limiter = Limiter(tpm=100, place="[m] in my.toml")
    advice = r"101 tokens.*100 tokens.*--tpm.*max_output_tokens of \[m\] in my\.toml"
    with pytest.raises(UsageError, match=advice):
        await limiter.acquire(101)
    await limiter.acquire(100)
