"""How a trial is played live: what it asks at an instant is asked side by side."""

import asyncio
from collections import Counter
from dataclasses import replace
from types import SimpleNamespace

import pytest

from merge_runner.errors import ProviderDown, SweepStopped, TrialSuspended, UsageError
from merge_runner.llm.attempts import Meter
from merge_runner.records import SIDES, CallFailed, ChatReply, ChatRequest, Slot
from merge_runner.run.local_runner import A_FEW, LocalRunner
from merge_runner.run.plan import make_plan

REPLY = f"Y\nI yield.\n```python\n{[-0.4] * 20}\n```"
REQUEST = ChatRequest("key", "test", "test", "model", "/", {}, "{}", Slot("N_0_0", 1, "left", 0, 0))


class Client:
    """Answers when both sides have asked, but for the ``errors`` by side."""

    def __init__(self, **errors):
        self.errors, self.asked, self.given_up = errors, [], []
        self.meter, self.budget = Meter(), SimpleNamespace(leave=lambda order: None)

    async def answer(self, question, *, order):
        self.asked.append(question.slot.side)
        try:
            for _ in range(100):
                await asyncio.sleep(0)
        except asyncio.CancelledError:
            self.given_up.append(question.slot.side)
            raise
        assert len(self.asked) == 2 * (1 + question.slot.decision)
        if question.slot.side in self.errors:
            raise self.errors[question.slot.side]
        return question.decision(question.prompt, ChatReply(REPLY, "ok", None, (), 0))


@pytest.fixture
def play(monkeypatch):
    plan = make_plan("baseline", "emulator", conditions=["N_0_0"])

    async def played(client):
        return await LocalRunner(plan, {"emulator": client}, 1).play_one(plan.trial_specs()[0])

    return played


async def test_both_drivers_are_asked_before_either_has_answered(play):
    client = Client()
    trial = await play(client)
    assert trial.status == "collided"
    assert client.asked == [row.side for row in trial.decisions]
    assert len(client.asked) > 4


@pytest.mark.parametrize("failing", SIDES)
async def test_a_failed_call_leaves_the_other_one_its_answer(play, failing):
    trial = await play(Client(**{failing: CallFailed("no answer", REQUEST)}))
    assert (trial.status, trial.error) == ("failed", f"{failing}: no answer")
    assert [row.side for row in trial.decisions] == [side for side in SIDES if side != failing]


@pytest.mark.parametrize(
    ("key", "trials"), [("shared", None), ("of {order}", 10), ("of {order}, {side}", 5)]
)
async def test_different_failed_calls_are_an_outage_and_none_that_trials_share(key, trials):
    class Failing(Client):
        async def answer(self, question, *, order):
            named = key.format(order=order, side=question.slot.side)
            raise CallFailed("HTTP 400", replace(REQUEST, key=named))

    plan, failed = make_plan("baseline", "emulator", conditions=["N_0_0"], repetitions=12), []
    runner = LocalRunner(plan, {"emulator": Failing()}, 1)
    playing = runner.play(plan.trial_specs(), lambda _, trial: failed.append(trial.status))
    if trials is None:
        await playing
    else:
        with pytest.raises(ProviderDown, match="10 different calls to emulator failed"):
            await playing
    assert failed == ["failed"] * (trials or 12)


async def test_few_trials_begin_or_go_on_in_one_round_of_the_event_loop():
    """Thousands of recorded replies would all be ready at once."""
    begun, asked, rounds = Counter(), Counter(), 0

    class Recorded(Client):
        async def answer(self, question, *, order):
            asked[rounds] += 1
            return question.decision(question.prompt, ChatReply(REPLY, "ok", None, (), 0))

    async def capacity():
        begun[rounds] += 1

    async def watch():
        nonlocal rounds
        while True:
            await asyncio.sleep(0)
            rounds += 1

    plan = make_plan("baseline", "emulator", conditions=["N_0_0"], repetitions=5 * A_FEW)
    runner = LocalRunner(plan, {"emulator": Recorded()}, 5 * A_FEW)
    watching = asyncio.create_task(watch())
    await runner.play(plan.trial_specs(), lambda *_: None, capacity)
    watching.cancel()
    assert begun.total() == 5 * A_FEW
    assert max(begun.values()) <= A_FEW
    assert max(asked.values()) <= 2 * A_FEW, "both drivers ask at once"


async def test_a_trial_that_is_cancelled_takes_both_calls_with_it(play):
    client = Client()
    trial = asyncio.create_task(play(client))
    while len(client.asked) < 2:
        await asyncio.sleep(0)
    trial.cancel()
    await asyncio.wait([trial])
    assert trial.cancelled()
    assert client.given_up == [*SIDES]


@pytest.mark.parametrize("kind", [TrialSuspended, SweepStopped, UsageError, KeyError])
@pytest.mark.parametrize("first", SIDES)
async def test_a_trial_that_is_left_takes_its_other_call_with_it(play, kind, first):
    error = kind("no more")

    class Waiting(Client):
        async def answer(self, question, *, order):
            if question.slot.side == first:
                raise error
            return await super().answer(question, order=order)

    client = Waiting()
    with pytest.raises(kind) as told:
        await play(client)
    assert told.value is error
    assert client.given_up == client.asked
