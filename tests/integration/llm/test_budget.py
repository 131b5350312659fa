"""A cap that holds whatever happens, and money that ends trials instead of beginning many."""

import asyncio
import contextlib
import math
import threading
from collections import defaultdict
from functools import partial
from types import SimpleNamespace

import pytest

from merge_runner.errors import CacheFailed, RecordingError, TrialSuspended, UsageError
from merge_runner.llm import budget as admission
from merge_runner.llm.attempts import Meter
from merge_runner.llm.cache import ResponseCache
from merge_runner.llm.ledger import _SUMS, CallLabel, Cap, Ledger, Spending, reasons
from merge_runner.llm.store import CachedCall
from merge_runner.records import Attempt, Slot, make_request
from merge_runner.run.local_runner import LocalRunner
from merge_runner.run.plan import make_plan
from tests.support.cases import cases
from tests.support.clients import budget_of
from tests.support.gate import HANGS_S
from tests.support.harness import each


@pytest.fixture
def ledger(cache, request):
    return Ledger(cache, request.node.name)


def asked(worst, driver=""):
    return CallLabel(driver, "", worst)


def tried(actual, outcome="server_error"):
    return Attempt(1, outcome, cost_usd=actual)


async def attempt(budget, trial, worst, actual, turns=0, model="m"):
    """Spend on one attempt as a client does."""
    await budget.admit([trial])
    paid = await budget.reserve([trial], f"key {model}", asked(worst))
    with contextlib.closing(paid):
        await paid.begin(1)
        for _ in range(turns):
            await asyncio.sleep(0)
        await paid.book(tried(actual), nothing)


def nothing(execute):
    """Keeps nothing beside the money."""


def now(ledger, operation, *arguments):
    """Run an operation of a ledger."""
    return ledger.store.run_now([partial(operation, *arguments)])[0]


def set_aside(budget, trial, worst, driver=""):
    return budget.reserve([trial], f"key {trial}", asked(worst, driver))


class Trials:
    """Plays the steps of tests/cases/money.toml."""

    def __init__(self, cache, scope, case):
        self.cache, self.scope, self.case = cache, scope, case
        self.waiting, self.paid, self.calls = {}, {}, defaultdict(list)
        self.begin_a_run()

    def begin_a_run(self):
        trial = [each(self.case["trial"])] if "trial" in self.case else []
        self.budget = budget_of(Ledger(self.cache, self.scope), self.case.get("cap"), *trial)

    async def job(self, trial, verb, worst=0, actual="0"):
        shared = self.calls[trial] = self.calls[trial] or [trial]
        if verb == "begins":
            await self.budget.admit(shared)
        elif verb == "reserves":
            self.paid[trial] = await self.budget.reserve(shared, "", asked(float(worst)))
        else:
            spent = None if actual == "?" else float(actual)
            await attempt(self.budget, trial, float(worst), spent)

    async def play(self, step):
        trial, verb, *more = step.split()
        trial = trial if trial == "new" else int(trial)
        ends = more.pop() if more and more[-1] in ("waits", "suspended") else "goes"
        match verb:
            case "run":
                self.begin_a_run()
            case "leaves":
                self.budget.leave(trial)
            case "shares":
                self.calls[trial].append(int(more[0]))
                self.budget.queue.reorder()
            case "readmitted":
                self.budget.readmit(trial)
            case "returns":
                self.paid[trial].close()
            case "stays" | "goes" | "fails":
                ends = {"stays": "waits", "goes": "goes", "fails": "suspended"}[verb]
                await self.ends(trial, ends)
            case _:
                self.waiting[trial] = asyncio.create_task(self.job(trial, verb, *more))
                await self.ends(trial, ends)

    async def ends(self, trial, how):
        task = self.waiting[trial]
        if how == "waits":
            await asyncio.wait([task], timeout=0.01)
            assert not task.done()
        elif how == "goes":
            await asyncio.wait_for(task, 5)
        else:
            with pytest.raises(TrialSuspended, match=self.case.get("says")):
                await asyncio.wait_for(task, 5)


@pytest.mark.parametrize("case", cases("money"))
async def test_money_goes_to_trials_in_their_order_and_never_beyond_the_cap(cache, request, case):
    trials = Trials(cache, request.node.name, case)
    for step in case["steps"]:
        await trials.play(step)
    if "spent" in case:
        assert trials.budget.ledger.read().spent_usd == case["spent"]


async def test_the_ledger_refuses_what_two_processes_reserved_at_once(ledger, cache):
    both = [budget_of(Ledger(cache, "shared"), 1.0) for _ in range(2)]
    # Neither knows of the other's yet.
    paid = [await set_aside(budget, trial, 0.75) for trial, budget in enumerate(both)]
    await paid[0].begin(1)
    with pytest.raises(TrialSuspended, match="the cap was used up while the attempt waited"):
        await paid[1].begin(1)
    assert both[1].ledger.read().committed_usd == 0.75


async def test_what_another_process_has_freed_meanwhile_suspends_no_trial(ledger, cache):
    other = budget_of(ledger, 1.0)
    with contextlib.closing(await set_aside(other, 1, 0.75)) as paid:
        await paid.begin(1)
        budget = budget_of(Ledger(cache, ledger.scope), 1.0, each(0.5))
        await paid.book(tried(0.25), nothing)
    await budget.admit([2])
    assert (await set_aside(budget, 2, 0.5)).usd == 0.5


def test_a_sum_read_meanwhile_changes_no_check_of_a_transaction(ledger, cache):
    ledger.cap = Cap(1.0)

    def twice(execute):
        first = ledger.reserve("a", 1, 0.6, O3, execute)
        ledger.committed_usd = 0.0  # as another thread reads it from before the transaction
        return first, ledger.reserve("b", 1, 0.6, O3, execute)

    assert cache.run_now([twice]) == [(True, False)]


async def test_what_waits_reads_no_sum_from_before_a_reservation(ledger, monkeypatch):
    monkeypatch.setattr(admission, "READ_EVERY_S", 0.01)
    budget, sum_up, is_summed = budget_of(ledger, 1.0), ledger.refresh, threading.Event()
    before = ledger.store.rows(_SUMS, ledger.scope, "[]")

    def refresh(execute):
        sum_up(execute)
        is_summed.set()

    paid = await set_aside(budget, 1, 0.5)
    monkeypatch.setattr(ledger.store, "rows", lambda *_: before)
    monkeypatch.setattr(ledger, "refresh", refresh)
    waiting = asyncio.create_task(set_aside(budget, 2, 0.75))
    await paid.begin(1)
    is_summed.clear()
    assert await asyncio.to_thread(is_summed.wait, HANGS_S)
    assert ledger.committed_usd == 0.5
    waiting.cancel()


async def test_trials_that_wait_for_money_are_counted_once(ledger):
    budget = budget_of(ledger, 3.0, each(2.0))
    client = SimpleNamespace(meter=Meter(), budget=budget)
    runner = LocalRunner(make_plan("baseline"), {"one": client, "other": client}, 9)
    await budget.admit([1])
    both = [asyncio.create_task(budget.admit([trial])) for trial in (2, 2, 3)]
    await asyncio.sleep(0)
    assert (budget.queue.trials, runner.waiting_for_money) == ({2, 3}, 2)
    budget.leave(1)
    await asyncio.gather(*both[:2])
    assert (budget.queue.trials, runner.waiting_for_money) == ({3}, 1)
    budget.leave(2)
    await both[2]
    assert runner.waiting_for_money == 0


@pytest.mark.parametrize("usd", [-9.0, -math.inf])
async def test_spending_that_nobody_can_have_spent_is_not_believed(ledger, cache, usd):
    await attempt(budget_of(ledger), 1, 0.5, 0.25)
    cache.run_now([lambda execute: execute("UPDATE spent SET usd = ?", (usd,))])
    with pytest.raises(UsageError, match="so that no cap could hold"):
        ledger.read()
    cache.run_now([lambda execute: execute("DELETE FROM spent")])


O3 = CallLabel("o3 at gateway", "L_4_0 rep 1 left, decision 3", 0.25)


async def test_what_is_set_aside_is_told_with_the_reason_of_each_attempt(ledger, cache):
    retried = enumerate(("timeout", "connection_lost", "server_error"), 1)
    for key, number, outcome in (("a", 1, "timeout"), *(("b", *one) for one in retried)):
        now(ledger, ledger.reserve, key, number, 0.25, O3)
        actual = 0.0 if outcome == "connection_lost" else None
        ended = Attempt(number, outcome, cost_usd=actual)
        now(ledger, ledger.book, key, ended, O3.driver)
    now(ledger, ledger.reserve, "d", 1, 0.125, O3)
    now(ledger, ledger.reserve, "paid", 1, 0.25, O3)
    now(ledger, ledger.book, "paid", tried(0.1), O3.driver)
    why = reasons(cache, ledger.scope)
    assert [(r["outcome"], r["attempts"], r["usd"]) for r in why] == [
        ("timeout", 2, 0.5),
        ("server_error", 1, 0.25),
        ("in flight", 1, 0.125),
    ]
    assert sum(r["usd"] for r in why) == pytest.approx(ledger.read().reserved_usd)
    assert {(r["driver"], r["slot"]) for r in why} == {(O3.driver, O3.slot)}
    assert why[0]["first"] <= why[0]["last"]


def test_what_is_booked_counts_at_once_whoever_has_reserved_or_released_it(ledger, cache):
    other = Ledger(cache, "another sweep")
    for key in ("line", "released", "own"):
        now(other, other.reserve, key, 1, 0.25, O3)
    now(ledger, ledger.book, "line", tried(0.125), O3.driver)
    assert (ledger.committed_usd, other.read().committed_usd) == (0, 0.625)
    now(other, other.book, "own", tried(0.125), O3.driver)
    assert other.committed_usd == other.read().committed_usd == 0.5
    other.release()
    now(other, other.book, "released", tried(0.0625), O3.driver)
    assert other.committed_usd == other.read().committed_usd == 0.3125


def test_a_chunk_s_ledger_begins_with_the_overruns_that_are_known(ledger):
    now(ledger, ledger.add_overruns, {O3.driver: 2.0, "o4": 1.5})
    assert ledger.read() == Spending(overruns={O3.driver: 2.0, "o4": 1.5})


@pytest.mark.parametrize("fails", ["keep", "book"])
async def test_a_reply_and_its_cost_are_kept_together_or_not_at_all(ledger, cache, fails):
    named = dict.fromkeys(("provider", "endpoint", "model", "path"), "openai")
    slot = Slot("N_0_0", 1, "left", 0, 0)
    request = make_request(**named, headers={}, body={"test": fails}, slot=slot)
    answer = Attempt(1, "ok", 200, cost_usd=0.125, reply="{}")
    operations = {
        "keep": partial(cache.keep, CachedCall(request, (answer,))),
        "book": partial(ledger.book, request.key, answer, O3.driver),
    }

    def raising(execute):
        operations[fails](execute)
        raise RecordingError("nothing of this is kept")

    now(ledger, ledger.reserve, request.key, 1, 0.25, O3)
    both = {**operations, fails: raising}
    with pytest.raises(RecordingError):
        await cache.write(lambda execute: [each(execute) for each in both.values()])
    assert cache.get(request.key) is None
    assert (ledger.read().spent_usd, ledger.spending.reserved_usd) == (0, 0.25)
    await cache.write(lambda execute: [each(execute) for each in operations.values()])
    assert cache.get(request.key).attempts == (answer,)
    assert (ledger.read().spent_usd, ledger.spending.reserved_usd) == (0.125, 0)


def test_money_that_cannot_be_written_is_no_damaged_record(tmp_path):
    cache = ResponseCache(tmp_path)
    ledger = Ledger(cache, "sweep")
    cache.run_now([lambda execute: execute("PRAGMA max_page_count = 1")])
    with pytest.raises(CacheFailed, match="cannot be written: database or disk is full"):
        [now(ledger, ledger.reserve, str(n), 1, 0.25, O3) for n in range(1_000)]
    cache.close()


async def test_after_a_reply_that_cost_more_than_its_worst_case_as_much_is_set_aside(ledger, cache):
    budget = budget_of(ledger, 10.0)
    with contextlib.closing(await budget.reserve([1], "key", O3)) as paid:
        await paid.begin(1)
        await paid.book(tried(0.75), nothing)
    assert (ledger.spending.spent_usd, ledger.spending.overrun_usd) == (0.75, 0.5)
    assert ledger.spending.largest_overruns == "o3 at gateway up to 3.00 times as much"
    next_run = budget_of(Ledger(cache, ledger.scope), 10.0)
    assert (await set_aside(next_run, 2, 0.25, "another driver")).usd == 0.25
    with contextlib.closing(await next_run.reserve([1], "other", O3)) as paid:
        assert paid.usd == 0.75
        await paid.begin(1)
        # A reply within what is now set aside does not count as another overrun of it.
        await paid.book(tried(0.5), nothing)
    assert ledger.spending.overruns[O3.driver] == 3


async def test_a_suspended_trial_says_what_the_cap_is_needed_for(ledger):
    budget = budget_of(ledger, 5.0, each(2.0))
    await attempt(budget, 1, 1.0, 0.5)
    await attempt(budget, 1, 0.5, None)
    await budget.admit([2])
    with pytest.raises(TrialSuspended) as caught:
        await set_aside(budget, 1, 5.0)
    assert str(caught.value) == (
        "the next call may cost 5.0000 USD, and 1.0000 of 5 USD (--max-cost) are spent or reserved "
        "(0.5000 spent, 0.5000 reserved for 1 attempts whose cost is not known: "
        "`merge-runner ledger`); 3.0000 more are reserved for the trials that have begun"
    )


ENDS = {
    "cancelled before it was sent": (False, None, asyncio.CancelledError, (1.0, 0.0, 0.0)),
    "refused before it was sent": (False, None, UsageError, (1.0, 0.0, 0.0)),
    "dropped in flight": (True, None, asyncio.CancelledError, (0.5, 0.5, 0.0)),
    "of unknown cost": (True, tried(None), TrialSuspended, (0.5, 0.5, 0.0)),
    "free": (True, tried(0.0), TrialSuspended, (1.0, 0.0, 0.0)),
    "charged": (True, tried(0.25), TrialSuspended, (0.75, 0.0, 0.25)),
}


@pytest.mark.parametrize(("begun", "tried", "error", "money"), ENDS.values(), ids=list(ENDS))
async def test_however_an_attempt_ends_its_money_ends_in_the_right_place(
    ledger, begun, tried, error, money
):
    """``money``: what is kept for the trial, set aside for ever, and spent."""
    kept_usd, reserved_usd, spent_usd = money
    budget = budget_of(ledger, 1.0, each(1.0))
    await budget.admit([1])

    async def ended():
        with contextlib.closing(await budget.reserve([1], "key", asked(0.5))) as paid:
            if begun:
                await paid.begin(1)
            if tried:
                await paid.book(tried, nothing)
            raise error("whatever")

    with pytest.raises(error):
        await ended()
    spending = budget.ledger.read()
    assert (spending.reserved_usd, spending.spent_usd) == (reserved_usd, spent_usd)
    assert (budget.open_reservations, budget.queued_usd) == (0, 0)
    with pytest.raises(TrialSuspended, match=f"{kept_usd:.4f} more are reserved for the trials"):
        await set_aside(budget, 1, 5.0)
