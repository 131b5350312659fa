"""The loop of a trial: observe, decide together, drive, and keep what there is when it ends."""

import asyncio
import re
from dataclasses import replace

import pytest

from merge_runner.config import ScenarioConfig
from merge_runner.drivers.base import Seat, take_seat
from merge_runner.drivers.pace import model_pace, program_pace
from merge_runner.drivers.registry import PROGRAMS
from merge_runner.errors import SweepStopped, TrialSuspended, UsageError
from merge_runner.records import SIDES, Attempt, CallFailed, ChatRequest, Decision, Slot
from merge_runner.results.database import SCHEMA
from merge_runner.trial import play_trial
from tests.support import driven_trials
from tests.support.driven_trials import both
from tests.support.specs import spec_of

EXECUTED = 5
ATTEMPTS = (Attempt(1, "http_500"), Attempt(2, "timeout"))
REQUEST = ChatRequest("key", "test", "test", "model", "/", {}, "{}", Slot("N_0_0", 1, "left", 0, 0))


async def play(left, right, condition="N_0_0", *, in_turn=False, **scenario):
    """A trial; a driver with a ``rate_hz`` keeps it."""
    drivers, task = {"left": left, "right": right}, ScenarioConfig(**scenario)
    for side, driver in drivers.items():
        rate_hz = getattr(driver, "rate_hz", None)
        pace = program_pace(task, rate_hz) if rate_hz else model_pace(task)
        driver.seat = Seat(task, side, pace, 0)
    return await play_trial(spec_of(condition), task, drivers, in_turn=in_turn)


async def play_constant(condition="N_0_0", **scenario):
    programs = both(PROGRAMS["constant"])
    return await driven_trials.play(programs, condition, scenario=ScenarioConfig(**scenario))


class Holding:
    """Holds one action, and remembers what it saw."""

    def __init__(self, action):
        self.action = action
        self.seen = {}

    async def decide(self, observation, number):
        assert number not in self.seen
        self.seen[number] = observation
        return self.seat.held(self.action)


class Meeting(Holding):
    """Notes before its answer whether the other driver has been asked as well."""

    def __init__(self, action):
        super().__init__(action)
        self.asked = 0
        self.met = []
        self.other = None

    async def decide(self, observation, number):
        self.asked += 1
        await asyncio.sleep(0)  # lets every other task begin, and none that nobody has made
        self.met.append(self.other.asked == self.asked)
        return await super().decide(observation, number)


class Waiting(Holding):
    """Waits for ever, and notes when it is given up."""

    given_up = False

    async def decide(self, observation, number):
        try:
            await asyncio.Event().wait()
        except asyncio.CancelledError:
            await asyncio.sleep(0)
            self.given_up = True
            raise


class Failing(Holding):
    """Gets no answer at one decision."""

    def __init__(self, action, at, error=None):
        super().__init__(action)
        self.at = at
        self.error = error or CallFailed("no answer", REQUEST, ATTEMPTS)

    async def decide(self, observation, number):
        if number == self.at:
            raise self.error
        return await super().decide(observation, number)


class Slow(Holding):
    """Answers long after the other driver."""

    async def decide(self, observation, number):
        for _ in range(100):
            await asyncio.sleep(0)
        return await super().decide(observation, number)


async def test_both_drivers_are_asked_before_either_has_answered():
    left, right = Meeting(0.0), Meeting(-1.0)
    left.other, right.other = right, left
    trial = await play(left, right)
    assert trial.status == "finished"
    assert left.met == right.met == [True] * 10


async def test_in_turn_the_trial_is_the_same_without_a_task_for_each_driver():
    at_once = await play(Holding(0.3), Holding(-0.6), "R_-4_8")
    left, right = Meeting(0.3), Meeting(-0.6)
    left.other, right.other = right, left
    assert await play(left, right, "R_-4_8", in_turn=True) == at_once
    assert not any(left.met)
    assert all(right.met)


async def test_both_drivers_observe_the_same_state():
    """Also where one of them answers late: neither sees what the other has decided."""
    left, right = Slow(0.3), Holding(-0.6)
    trial = await play(left, right, "R_-4_8")
    assert len(left.seen) == len(right.seen) > 5
    for number, from_left in left.seen.items():
        from_right = right.seen[number]
        at_step = {row.side: row for row in trial.states if row.step == number * EXECUTED}
        assert from_left.own_speed_mps == from_right.other_speed_mps
        assert from_right.own_speed_mps == from_left.other_speed_mps
        assert from_left.relative_distance_m == -from_right.relative_distance_m
        assert from_left.own_speed_mps == at_step["left"].velocity_mps
        assert from_right.own_speed_mps == at_step["right"].velocity_mps


async def test_decisions_are_made_once_a_second_from_time_0_on():
    trial = await play(Holding(0.0), Holding(-1.0))
    # The left car needs 10 s for 100 m; at the end of the track nobody is asked again.
    expected = [(number, float(number), side) for number in range(10) for side in SIDES]
    assert [(row.number, row.time_s, row.side) for row in trial.decisions] == expected
    assert (trial.status, trial.end_time_s, trial.merged_first) == ("finished", 10.0, "left")
    moved = {row.side: row.acceleration_mps2 for row in trial.states if row.step == 1}
    assert moved == {"left": 0.0, "right": -2.5}


async def test_the_prompt_rate_decides_when_the_drivers_are_asked():
    trial = await play_constant(prompt_rate_hz=2.5)
    times = [row.time_s for row in trial.decisions if row.side == "left"]
    assert times[:4] == [0.0, 0.4, 0.8, 1.2]


ACTIONS = (0.1, -0.2, 0.3, -0.4, 0.5)


class Wavering(Holding):
    """Decides on the same five actions each time."""

    async def decide(self, observation, number):
        return Decision(plan=ACTIONS * 4, applied=ACTIONS)


async def test_the_actions_of_a_decision_are_driven_in_their_order():
    trial = await play(Wavering(0), Holding(-1.0))
    driven = [row.acceleration_mps2 for row in trial.states if row.side == "left"]
    # The row of step 0 is the start of control; steps 1 to 10 are two decisions.
    assert driven[1:11] == pytest.approx([2.5 * a for a in ACTIONS * 2])


async def test_a_trial_ends_within_a_second_when_the_cars_collide():
    trial = await play_constant()
    # Level cars at 10 m/s are closer than 4.5 m from 82 m on: after 3.2 s, at 3.4 s in steps.
    assert (trial.status, trial.end_time_s, trial.merged_first) == ("collided", 3.4, None)
    assert trial.states[-1].step == 17
    assert len(trial.states) == 2 * 18
    assert len(trial.decisions) == 2 * 4


async def test_a_trial_in_which_both_stand_still_times_out():
    trial = await play(Holding(-1.0), Holding(-1.0))
    assert (trial.status, trial.end_time_s, trial.merged_first) == ("timeout", 30.0, None)
    assert len(trial.decisions) == 2 * 30
    assert trial.error is None


@pytest.mark.parametrize("failing", SIDES)
async def test_a_failed_call_ends_the_trial_and_keeps_what_was_played(failing):
    drivers = {side: Slow(-0.1) for side in SIDES}
    drivers[failing] = Failing(-0.1, at=2)
    (other,) = set(SIDES) - {failing}
    trial = await play(**drivers)
    assert (trial.status, trial.merged_first, trial.end_time_s) == ("failed", None, 2.0)
    assert trial.error == f"{failing}: no answer"
    (call,) = trial.failed_calls
    assert (call.number, call.side, call.request, call.attempts) == (2, failing, REQUEST, ATTEMPTS)
    # Two decisions were driven; the third is kept for the side that got its answer.
    assert [row.step for row in trial.states] == [step for step in range(11) for _ in SIDES]
    assert [(row.number, row.side) for row in trial.decisions] == [
        (0, "left"),
        (0, "right"),
        (1, "left"),
        (1, "right"),
        (2, other),
    ]


async def test_when_both_calls_fail_the_error_names_both_sides():
    left, right = Failing(0.0, at=0), Failing(0.0, at=0)
    trial = await play(left, right)
    assert trial.status == "failed"
    assert trial.error == "left: no answer; right: no answer"
    assert [call.side for call in trial.failed_calls] == list(SIDES)
    assert trial.decisions == ()
    assert [(row.step, row.side) for row in trial.states] == [(0, "left"), (0, "right")]


async def test_nobody_merged_first_in_a_trial_that_failed_after_the_merge():
    """The left car passes the merge point after 5 s."""
    trial = await play(Holding(0.0), Failing(-1.0, at=7))
    assert (trial.status, trial.end_time_s, trial.merged_first) == ("failed", 7.0, None)


async def test_under_own_exit_alone_the_driver_in_the_tunnel_is_not_asked():
    """In L_4_-8 the right car leaves its tunnel 0.785 s after the left one."""
    left, right = Holding(-0.5), Holding(-1.0)
    at_once = Holding(-1.0)
    await play(Holding(-0.5), at_once, "L_4_-8")
    assert list(at_once.seen)[:2] == [0, 1]
    trial = await play(left, right, "L_4_-8", control_start="own_exit")
    assert list(left.seen)[:3] == [0, 1, 2]
    assert list(right.seen)[:2] == [1, 2]
    assert [(row.number, row.side) for row in trial.decisions[:3]] == [
        (0, "left"),
        (1, "left"),
        (1, "right"),
    ]
    right_rows = [row for row in trial.states if row.side == "right"]
    assert [row.velocity_mps for row in right_rows[:6]] == [10.4] * 6
    assert right_rows[6].acceleration_mps2 == -2.5
    # Who waits for number 0 would never begin: the reference says what is counted.
    (said,) = re.findall(r"decisions\.decision IS (.*?);", SCHEMA.read_text(), re.DOTALL)
    assert "begins above 0 where it leaves its tunnel later" in said


FINE = {"step_s": 0.05, "plan_step_s": 0.2}


def deciding(rate_hz, action):
    """Holds an action, and decides so many times a second."""
    driver = Holding(action)
    driver.rate_hz = rate_hz
    return driver


def decided(trial, side):
    return [row for row in trial.decisions if row.side == side]


async def test_each_driver_decides_at_its_own_rate_and_counts_its_own_decisions():
    trial = await play(deciding(20, -0.1), deciding(5, -0.3), **FINE)
    left, right = decided(trial, "left"), decided(trial, "right")
    assert [row.number for row in left] == list(range(len(left)))
    assert [row.time_s for row in left] == pytest.approx([0.05 * n for n in range(len(left))])
    assert [row.time_s for row in right] == pytest.approx([0.2 * n for n in range(len(right))])
    assert len(left) > 3 * len(right) > 100
    assert {len(row.decision.applied) for row in left} == {1}
    assert {len(row.decision.applied) for row in right} == {4}


async def test_a_plan_in_steps_of_its_own_drives_the_same_way_in_a_finer_world():
    coarse = await play(Wavering(0), Holding(-1.0))
    fine = await play(Wavering(0), deciding(20, -1.0), **FINE)
    one, other = (
        {(row.side, row.time_s): (row.position_m, row.velocity_mps) for row in trial.states}
        for trial in (coarse, fine)
    )
    shared = sorted(one.keys() & other.keys())
    assert len(shared) > 80
    assert [other[t] for t in shared] == [pytest.approx(one[t]) for t in shared]


@pytest.mark.parametrize("failing", SIDES)
async def test_a_failed_call_has_the_number_of_its_own_driver(failing):
    drivers = {side: deciding(20, -0.1) for side in SIDES}
    drivers[failing] = Failing(-0.1, at=2)
    (other,) = set(SIDES) - {failing}
    trial = await play(**drivers, **FINE)
    (call,) = trial.failed_calls
    assert (call.number, call.side, trial.end_time_s) == (2, failing, 2.0)
    # Who was due at that instant too has decided, and it is not driven.
    assert decided(trial, other)[-1].number == 40
    assert [row.number for row in decided(trial, failing)] == [0, 1]


def test_a_seed_is_that_of_the_slot_and_of_no_driver():
    spec, task = spec_of("N_0_0"), ScenarioConfig()
    seed = take_seat(task, spec, "left", model_pace(task)).seed
    assert seed == 4387192367012543550
    others = {
        take_seat(task, other, side, model_pace(task)).seed
        for other, side in (
            (spec, "right"),
            (replace(spec, condition="L_4_0"), "left"),
            (replace(spec, repetition=2), "left"),
            (replace(spec, sample_set=1), "left"),
        )
    }
    assert len({seed, *others}) == 5
    renamed = replace(spec, model_left="another", variant="A1", order=7)
    assert take_seat(task, renamed, "left", model_pace(task)).seed == seed


class Short(Holding):
    """Decides on less than is to be driven."""

    async def decide(self, observation, number):
        return Decision(plan=None, applied=(0.5,))


async def test_what_cannot_be_driven_is_refused_in_one_line():
    with pytest.raises(UsageError, match=r"^the left driver decided 1\.5: -1 to 1 can be driven$"):
        await play(Holding(1.5), Holding(0.0))
    with pytest.raises(UsageError, match=r"the left driver decided on \(0.5,\), and is to drive 5"):
        await play(Short(0), Holding(0.0))


@pytest.mark.parametrize("kind", [TrialSuspended, SweepStopped, UsageError, KeyError])
@pytest.mark.parametrize("first", SIDES)
async def test_a_trial_that_is_left_takes_its_other_driver_with_it(kind, first):
    error, waiting = kind("no more"), Waiting(0.0)
    drivers = {first: Failing(0.0, at=0, error=error)}
    drivers = {side: drivers.get(side, waiting) for side in SIDES}
    with pytest.raises(kind) as told:
        await play(**drivers)
    assert told.value is error
    assert waiting.given_up


async def test_a_trial_that_is_cancelled_takes_both_drivers_with_it():
    drivers = Waiting(0.0), Waiting(0.0)
    trial = asyncio.create_task(play(*drivers))
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    trial.cancel()
    with pytest.raises(asyncio.CancelledError):
        await trial
    assert [driver.given_up for driver in drivers] == [True, True]
