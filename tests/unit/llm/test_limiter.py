import asyncio
import random

import pytest
from asyncio_throttle.throttler import Throttler
from hypothesis import given, settings
from hypothesis import strategies as st

from merge_runner.errors import UsageError
from merge_runner.llm.limiter import Limiter, Pause
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


async def test_a_late_arrival_of_an_older_trial_goes_first():
    queue = Queue(Limiter(rpm=1))
    for name in ("first", "second"):
        queue.ask(name, order=5)
    await asyncio.sleep(1)
    queue.ask("oldest", order=1)
    await queue.all_served()
    assert queue.names == ["first", "oldest", "second"]


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


async def test_tokens_come_back_after_a_window_and_without_limits_everybody_passes_at_once():
    assert await served(Limiter(), 50, tokens=10**9) == [0.0] * 50
    assert await served(Limiter(tpm=100), 4, tokens=50) == [0, 0, MINUTE, MINUTE]


async def test_a_heavy_request_at_the_head_is_not_overtaken():
    queue = Queue(Limiter(tpm=100))
    for name, tokens in [("filling", 60), ("heavy", 100), ("light", 1), ("lighter", 0)]:
        queue.ask(name, tokens)
    await ticks()
    assert queue.names == ["filling"]
    await queue.all_served()
    assert queue.names == ["filling", "heavy", "light", "lighter"]


async def test_correcting_lower_frees_tokens_for_those_who_wait():
    queue = Queue(Limiter(tpm=100))
    correct = await queue.ask("first", 90)
    waiting = queue.ask("second", 50)
    await ticks()
    assert not waiting.done()
    correct(50)
    await queue.all_served()
    assert queue.times == [0, 0]


async def test_correcting_higher_holds_others_back():
    queue = Queue(Limiter(tpm=100))
    (await queue.ask("first", 10))(80)
    queue.ask("second", 50)
    await queue.all_served()
    assert queue.times == [0, MINUTE]


async def test_correcting_after_the_window_changes_nothing():
    queue = Queue(Limiter(tpm=100))
    correct = await queue.ask("first", 50)
    await asyncio.sleep(MINUTE)
    await queue.ask("second", 50)
    correct(0)
    correct(100)
    queue.ask("third", 50)
    queue.ask("fourth", 1)
    await queue.all_served()
    assert queue.times == [0, MINUTE, MINUTE, 2 * MINUTE]


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


async def test_who_has_given_up_is_skipped_and_takes_no_place():
    queue = Queue(Limiter(rpm=1))
    tasks = [queue.ask(number) for number in range(5)]
    await ticks()
    for number in (1, 3):
        tasks[number].cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    assert queue.names == [0, 2, 4]
    assert queue.times[-1] < 2.1 * MINUTE


async def test_who_has_given_up_holds_back_nobody_with_its_tokens():
    queue = Queue(Limiter(tpm=100))
    queue.ask("first", 90)
    heavy = queue.ask("heavy", 50)
    light = queue.ask("light", 10)
    await asyncio.sleep(1)
    heavy.cancel()
    await light
    assert queue.times == [0, 1]


async def test_a_pause_holds_everybody_and_a_shorter_one_does_not_end_it():
    limiter = Limiter()
    queue = Queue(limiter)
    limiter.pause(30)
    limiter.pause(5)
    queue.ask(0)
    await asyncio.sleep(20)
    limiter.pause(20)
    queue.ask(1)
    await queue.all_served()
    assert queue.times == [40, 40]


async def test_a_pause_is_shared_by_all_limiters_of_one_key():
    shared = Pause()
    one, other, stranger = Limiter(pause=shared), Limiter(pause=shared), Limiter()
    one.pause(30)
    times = await asyncio.gather(*map(served, (one, other, stranger)))
    assert times == [[30], [30], [0]]


async def test_a_request_above_the_token_limit_is_refused_with_advice():
    limiter = Limiter(tpm=100, place="[m] in my.toml")
    advice = r"101 tokens.*100 tokens.*--tpm.*max_output_tokens of \[m\] in my\.toml"
    with pytest.raises(UsageError, match=advice):
        await limiter.acquire(101)
    await limiter.acquire(100)
