"""Rounds through the client, over a batch mode in memory that misbehaves as told."""

import asyncio
import contextlib
import re
from collections import Counter
from datetime import UTC, datetime, timedelta

import pytest

from merge_runner.errors import CacheFailed, EndpointRefused, ProviderDown, QuotaExhausted
from merge_runner.llm.batch.rounds import BatchSender, Rounds
from merge_runner.llm.batch.service import BatchFailed, BatchStatus
from merge_runner.llm.cache import ResponseCache
from merge_runner.llm.ledger import Ledger
from merge_runner.providers import ModelEntry, Price
from merge_runner.records import CallFailed, Slot
from tests.support.batch_mode import Memory
from tests.support.clients import answer, budget_of, client_of, error, reply_to
from tests.support.virtual_time import now_s

pytestmark = pytest.mark.usefixtures("virtual_time")
PRICE = Price(input=1.0, output=100.0, source="made up")
# Of the tokens of an answer, in USD.
ONE_USD = (10 * 1.0 + 5 * 100.0) / 1e6


class Alone:
    """The plain endpoint."""

    def __init__(self):
        self.asked = []

    async def send(self, request, *, attempt, timeout_s):
        self.asked.append(request.slot.repetition)
        return answer(f"alone {request.slot.repetition}")


@pytest.fixture
def cache(tmp_path):
    cache = ResponseCache(tmp_path / "responses")
    yield cache
    cache.close()


class Run:
    """A run's client, and the rounds that it asks in."""

    def __init__(self, cache, service, *, cap=None, price=PRICE, scope="test", submits=True):
        self.cache, self.said, self.alone = cache, [], Alone()
        self.rounds = Rounds(cache, {"m"}, submits=submits, say=self.said.append)
        self.rounds.services["m"] = service
        self.ledger = Ledger(cache, scope)
        entry = ModelEntry(
            provider="openai", format="openai-chat", id="m-1", max_output_tokens=100, price=price
        )
        budget = budget_of(self.ledger, cap)
        batch = BatchSender(self.rounds, "m", 0.5)
        self.client = client_of("m", entry, "openai", cache, self.alone, budget=budget, batch=batch)

    async def ask(self, repetitions=1, decision=0):
        """The replies to several at once, or what each of them raised."""
        async with contextlib.AsyncExitStack() as stack:
            asks = [
                asyncio.create_task(
                    reply_to(
                        self.client, "prompt", Slot("A1", each, "left", decision, 0), order=each
                    )
                )
                for each in range(1, repetitions + 1)
            ]

            def is_idle():
                waiting = sum(not each.done() for each in asks)
                return bool(waiting) and waiting == self.client.calls.blocked_askers

            watching = asyncio.create_task(self.rounds.watch(is_idle))
            stack.callback(watching.cancel)
            return await asyncio.gather(*asks, return_exceptions=True)

    async def end(self):
        await self.client.calls.drain()
        await self.rounds.close()

    async def left(self):
        """The batches that the next run finds."""
        await self.end()
        return Rounds(self.cache, {"m"}, submits=True, say=print).batches


@pytest.fixture
def service():
    return Memory()


@pytest.fixture
def run(cache, service):
    return Run(cache, service)


def texts(replies):
    return [each.text for each in replies]


def outcomes(reply):
    return [(attempt.outcome, attempt.batch_id) for attempt in reply.attempts]


async def test_what_is_asked_together_is_one_batch_at_half_the_price(service, run):
    replies = await run.ask(20)
    assert texts(replies) == [f"batched {number}" for number in range(1, 21)]
    assert service.sizes == [20]
    assert {attempt.batch_id for reply in replies for attempt in reply.attempts} == {"batch-0"}
    (attempt,) = replies[0].attempts
    assert attempt.cost_usd == pytest.approx(ONE_USD / 2)
    assert datetime.now(UTC) - datetime.fromisoformat(attempt.started_at) < timedelta(minutes=5)
    assert attempt.latency_s is None
    assert run.ledger.read().spent_usd == pytest.approx(10 * ONE_USD)
    assert (run.ledger.read().reserved_usd, run.alone.asked) == (0.0, [])
    assert not await run.left()


async def test_what_is_set_aside_for_a_batch_is_half_of_its_worst_case(service, run):
    async def create(lines, mark):
        aside.append(run.ledger.read().reserved_usd)
        return await Memory.create(service, lines, mark)

    aside, service.create = [], create
    await run.ask(3)
    bytes_of_one = len(service.batches["batch-0"][0].body.encode())
    assert aside == [pytest.approx(3 * (bytes_of_one + 100 * 100.0) / 1e6 / 2)]


async def test_a_line_that_failed_expired_or_is_missing_is_asked_alone_at_the_full_price(
    service, run
):
    service.fates = {2: [error(500)], 3: [error(429)], 4: [None], 5: ["missing"]}
    service.fates[6] = [error(400, code="invalid_request_error")]
    replies = await run.ask(6)
    refused = replies.pop()
    assert isinstance(refused, CallFailed)
    assert texts(replies) == ["batched 1", "alone 2", "alone 3", "alone 4", "alone 5"]
    assert (service.sizes, sorted(run.alone.asked)) == ([6], [2, 3, 4, 5])
    ended = ("server_error", "rate_limited", "expired", "no_result")
    assert list(map(outcomes, replies[1:])) == [[(e, "batch-0"), ("ok", None)] for e in ended]
    # Only what has no result may have been charged.
    assert [reply.attempts[0].cost_usd for reply in replies[1:]] == [0.0, 0.0, 0.0, None]
    assert replies[3].attempts[1].cost_usd == pytest.approx(ONE_USD)
    spending = run.ledger.read()
    assert spending.spent_usd == pytest.approx((0.5 + 4) * ONE_USD)
    assert spending.open_attempts == 1


async def test_a_batch_that_is_too_large_goes_in_halves_and_so_do_later_ones(service, run):
    service.creations = [BatchFailed("smaller", "enqueued", sent=False)] * 2
    assert texts(await run.ask(8)) == [f"batched {number}" for number in range(1, 9)]
    assert sorted(service.sizes) == [2, 2, 4]
    assert len(run.said) == 1
    await run.ask(8, decision=1)
    assert service.sizes[3:] == [8]  # there is room again
    assert not run.ledger.read().reserved_usd
    assert not await run.left()


@pytest.mark.parametrize("named_late", [True, False])
async def test_results_that_are_fewer_than_the_provider_counts_are_read_again(
    named_late, service, run
):
    if named_late:  # the file that has them
        service.batches["early"] = []
        service.states = [BatchStatus(["early"], results=2)] * 2
    else:
        service.states, service.partial = [BatchStatus(["batch-0"], results=2)] * 2, 1
    assert texts(await run.ask(2)) == ["batched 1", "batched 2"]
    assert (run.alone.asked, service.partial) == ([], 0)


async def test_what_could_not_be_kept_is_fetched_again_and_not_paid_twice(
    cache, monkeypatch, service, run
):
    def is_full(*_):
        raise CacheFailed("the disk is full")

    with monkeypatch.context() as patch:
        patch.setattr(cache, "keep", is_full)
        assert {type(each) for each in await run.ask(2)} == {CacheFailed}
        await run.end()
    later = Run(cache, service)
    assert texts(await later.ask(2)) == ["batched 1", "batched 2"]
    assert (service.sizes, later.alone.asked) == ([2], [])
    assert not await later.left()


async def left_behind(cache, service, repetitions=1, **options):
    """A run that is interrupted while a batch waits."""
    service.states = [BatchStatus()] * 1000
    run = Run(cache, service, **options)
    asking = asyncio.create_task(run.ask(repetitions))
    await asyncio.sleep(5)
    (line,) = run.rounds.status_lines()
    assert re.fullmatch(
        f"{repetitions} calls? of m waits? in batch batch-0 since [0-9:]{{8}} UTC", line
    )
    asking.cancel()
    await run.end()
    service.states = []
    return run


async def test_two_caches_of_one_account_never_take_the_same_batch(service, run, tmp_path):
    async def status(batch_id):
        return BatchStatus(None if batch_id == "batch-0" else [batch_id])

    service.status, service.creations = status, [None, BatchFailed("again", "HTTP 504")]
    with contextlib.closing(ResponseCache(tmp_path / "other")) as other:
        asking, second = asyncio.create_task(run.ask()), Run(other, service)
        await asyncio.sleep(10)
        (reply,) = await second.ask()
        assert outcomes(reply) == [("ok", "batch-1")]
        asking.cancel()
        await run.end()
        await second.end()


async def test_a_creation_that_comes_into_effect_late_is_not_repeated(service, run):
    async def create(lines, mark):
        arriving.append(asyncio.create_task(arrive(lines, mark)))
        raise BatchFailed("again", "HTTP 504")

    async def arrive(lines, mark):
        await asyncio.sleep(20)
        await Memory.create(service, lines, mark)

    arriving, service.create = [], create
    assert texts(await run.ask(2)) == ["batched 1", "batched 2"]
    assert service.sizes == [2]


async def test_a_single_line_that_finds_no_room_is_asked_alone(service, run):
    service.creations = [BatchFailed("smaller", "enqueued", sent=False)] * 1000
    (reply,) = await asyncio.wait_for(run.ask(), 120)
    assert reply.text == "alone 1"
    assert len(service.creations) == 999


async def test_a_creation_under_way_is_not_repeated_once_the_run_ends(service, run):
    async def create(lines, mark):
        service.creations.append(mark)
        await asyncio.sleep(30)
        raise BatchFailed("again", "HTTP 502")

    service.create = create
    asking = asyncio.create_task(run.ask())
    await asyncio.sleep(5)
    asking.cancel()
    await run.end()
    assert (now_s() < 36, len(service.creations)) == (True, 1)


async def test_an_answer_whose_money_was_released_is_spent_and_is_no_overrun(cache, service):
    left = await left_behind(cache, service, cap=10)
    left.ledger.release()
    run = Run(cache, service, cap=10)
    await run.ask()
    spending = run.ledger.read()
    assert spending.spent_usd == pytest.approx(ONE_USD / 2)
    assert (spending.overruns, spending.overrun_usd, spending.open_attempts) == ({}, 0.0, 0)
    assert not run.client.meter.notes


@pytest.mark.parametrize(("broken", "hours"), [(False, 1), (True, 0)])
async def test_results_that_never_come_are_waited_for_an_hour_and_unreadable_ones_stay_set_aside(
    service, run, broken, hours
):
    async def results(paths):
        if not broken:
            raise BatchFailed("again", "HTTP 503")
        yield "", None
        yield "", None

    service.results = results
    service.states = [BatchStatus(["batch-0"], results=1 if broken else 0)] * 999
    (reply,) = await run.ask()
    assert outcomes(reply) == [("no_result", "batch-0"), ("ok", None)]
    assert [each.cost_usd for each in reply.attempts] == [None, pytest.approx(ONE_USD)]
    assert run.ledger.read().open_attempts == 1
    assert hours * 3500 <= now_s() < hours * 3500 + 300


@pytest.mark.parametrize(
    ("kind", "raised", "code"), [("quota", QuotaExhausted, 3), ("rejected", EndpointRefused, 2)]
)
async def test_a_creation_that_is_refused_for_good_ends_the_run_and_costs_nothing(
    kind, raised, code, service, run
):
    service.creations = [BatchFailed(kind, "no", sent=False)] * 1000
    replies = await run.ask(3)
    assert {(type(each), each.exit_code) for each in replies} == {(raised, code)}
    assert kind == "quota" or "leave --batch out" in str(replies[0])
    spending = run.ledger.read()
    assert (spending.committed_usd, spending.open_attempts, run.alone.asked) == (0.0, 0, [])
    assert not await run.left()


async def test_where_no_batch_can_be_created_the_next_run_looks_for_it_first(cache, service, run):
    service.creations = [BatchFailed("again", "no", sent=False)] * 99
    assert {type(each) for each in await run.ask(3)} == {ProviderDown}
    await run.end()
    assert run.ledger.read().open_attempts == 3  # whether it was created is not known yet
    service.creations = []
    assert texts(await Run(cache, service).ask(3)) == ["batched 1", "batched 2", "batched 3"]
    assert service.sizes == [3]
    assert Ledger(cache, "test").read().open_attempts == 0


async def test_a_provider_that_is_down_while_a_batch_waits_is_waited_for(service, run):
    service.states = [BatchFailed("again", "HTTP 503")] * 12
    assert texts(await run.ask()) == ["batched 1"]
    assert run.said == ["m: HTTP 503; it is asked again until it answers"]


async def killed(run, repetitions, service):
    """Ask, and end the run as a kill does at the service's step: nothing more is written."""
    asking = asyncio.create_task(run.ask(repetitions))
    await service.died.wait()
    asking.cancel()
    for batch in run.rounds.batches.values():
        batch.work and batch.work.cancel()
    await run.client.calls.drain()
    service.step = ""


@pytest.mark.parametrize("step", ["before the creation", "after the creation", "while it waits"])
async def test_a_run_that_dies_at_any_step_is_taken_up_and_nothing_is_paid_twice(
    cache, step, service
):
    service.step = step
    first = Run(cache, service)
    await killed(first, 5, service)
    assert first.ledger.read().open_attempts == 5
    second = Run(cache, service)
    replies = await second.ask(5)
    assert texts(replies) == [f"batched {number}" for number in range(1, 6)]
    assert [outcomes(reply) for reply in replies] == [[("ok", "batch-0")]] * 5
    assert (service.sizes, set(service.answered.values())) == ([5], {1})
    spending = second.ledger.read()
    assert spending.spent_usd == pytest.approx(5 * ONE_USD / 2)
    assert (spending.reserved_usd, spending.open_attempts) == (0.0, 0)
    assert not await second.left()


class SetBack(datetime):
    """A clock that goes an hour back with each batch."""

    hours = 0

    @classmethod
    def now(cls, tz=None):
        cls.hours += 1
        return datetime.now(tz) - timedelta(hours=cls.hours)


async def test_of_a_failed_batch_and_its_smaller_ones_the_smaller_are_taken_up_whatever_the_clock(
    cache, service, monkeypatch
):
    async def status(batch_id):
        if batch_id == "batch-0":
            return BatchStatus(failure=BatchFailed("smaller", "enqueued"))
        return await Memory.status(service, batch_id)

    monkeypatch.setattr("merge_runner.llm.batch.rounds.datetime", SetBack)
    service.status, service.step = status, "while it waits"
    await killed(Run(cache, service), 4, service)
    assert service.sizes == [4, 2]
    run = Run(cache, service)
    assert texts(await run.ask(4)) == [f"batched {number}" for number in range(1, 5)]
    paid = Counter(line.key for each in list(service.batches.values())[1:] for line in each)
    assert sorted(paid.values()) == [1] * 4


@pytest.mark.parametrize("dies", [False, True])
async def test_a_batch_that_may_have_been_created_where_it_takes_no_mark_is_asked_alone(
    cache, dies, service
):
    service.takes_mark = False
    if dies:  # before its id is noted
        service.step = "after the creation"
        await killed(Run(cache, service), 2, service)
    else:
        service.creations = [BatchFailed("again", "connection lost", sent=True)]
    run = Run(cache, service)
    replies = await run.ask(2)
    assert [outcomes(each) for each in replies] == [[("batch_lost", None), ("ok", None)]] * 2
    assert run.ledger.read().open_attempts == 2  # what the lost batch may cost stays set aside
    await run.ask(2, decision=1)
    assert service.sizes == [2, 2]  # the next round is a batch again


async def test_a_run_that_asks_singly_waits_for_what_is_in_a_batch(cache, service):
    await left_behind(cache, service, repetitions=2)
    later = Run(cache, service, submits=False)
    assert texts(await later.ask(3)) == ["batched 1", "batched 2", "alone 3"]
    assert later.alone.asked == [3]


async def test_another_sweeps_batch_is_booked_in_that_sweeps_ledger(cache, service):
    first = await left_behind(cache, service, repetitions=2, scope="first")
    second = Run(cache, service, scope="second")
    assert texts(await second.ask(2)) == ["batched 1", "batched 2"]
    assert first.ledger.read().spent_usd == pytest.approx(ONE_USD)
    assert first.ledger.read().open_attempts == second.ledger.read().open_attempts == 0
    assert second.ledger.read().spent_usd == 0.0


async def test_a_batch_that_is_gone_stops_the_run_unless_it_asks_singly(cache, service):
    await left_behind(cache, service)
    service.batches.clear()
    (stopped,) = await Run(cache, service).ask()
    assert isinstance(stopped, EndpointRefused)
    assert "the same command without --batch" in str(stopped)
    anew = Run(cache, service, submits=False)
    (reply,) = await anew.ask()
    assert [attempt.outcome for attempt in reply.attempts] == ["batch_lost", "ok"]
    assert anew.ledger.read().open_attempts == 1  # nobody knows what it cost


@pytest.mark.parametrize("kind", ["rejected", "quota"])
async def test_a_batch_that_is_refused_to_a_key_is_never_asked_anew(cache, kind, service):
    await left_behind(cache, service)
    for _ in range(2):
        service.states = [BatchFailed(kind, "HTTP 401", sent=False)]
        run = Run(cache, service, submits=False)
        (stopped,) = await run.ask()
        assert isinstance(stopped, EndpointRefused)
        await run.end()
    (reply,) = await Run(cache, service).ask()
    assert outcomes(reply) == [("ok", "batch-0")]


async def test_under_a_cap_a_round_takes_what_fits_and_the_next_ones_the_rest(cache, service):
    run = Run(cache, service, cap=0.06)
    replies = await run.ask(20)
    assert texts(replies) == [f"batched {number}" for number in range(1, 21)]
    assert len(service.sizes) > 1
    assert max(service.sizes) * 0.005 <= 0.06
    assert run.ledger.read().spent_usd == pytest.approx(10 * ONE_USD)
