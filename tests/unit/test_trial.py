"""The loop of a trial: observe, decide together, drive, and keep what there is when it ends."""

import asyncio
import re
from dataclasses import replace

import pytest

from merge_runner.config import ScenarioConfig
from merge_runner.drivers.base import make_context
from merge_runner.drivers.language_model import LlmDriver, Question
from merge_runner.drivers.pace import model_pace, program_pace
from merge_runner.drivers.registry import PROGRAMS
from merge_runner.errors import UsageError
from merge_runner.records import SIDES, Attempt, CallFailed, ChatRequest, Decision, Slot
from merge_runner.results.database import SCHEMA
from merge_runner.trial import Trial, play_trial
from tests.support import driven_trials
from tests.support.driven_trials import both
from tests.support.specs import spec_of

EXECUTED = 5
ATTEMPTS = (Attempt(1, "http_500"), Attempt(2, "timeout"))
REQUEST = ChatRequest("key", "test", "test", "model", "/", {}, "{}", Slot("N_0_0", 1, "left", 0, 0))


def begin(left, right, condition="N_0_0", **scenario):
    """A trial before its first decision; a driver with a ``rate_hz`` keeps it."""
    spec, task = spec_of(condition), ScenarioConfig(**scenario)
    drivers = {"left": left, "right": right}
    for side, driver in drivers.items():
        rate_hz = getattr(driver, "rate_hz", None)
        pace = program_pace(task, rate_hz) if rate_hz else model_pace(task)
        driver.context = make_context(task, spec, side, pace)
    return Trial(spec, task, drivers)


def decide(question):
    return question.decision(question.prompt, None)


def play(*drivers, **scenario):
    return play_trial(begin(*drivers, **scenario), decide)


def play_constant(condition="N_0_0", **scenario):
    programs = both(PROGRAMS["constant"])
    return driven_trials.play(programs, condition, scenario=ScenarioConfig(**scenario))


class Holding:
    """Holds one action, and remembers what it saw."""

    def __init__(self, action):
        self.action = action
        self.seen = {}

    async def decide(self, observation, number):
        assert number not in self.seen
        self.seen[number] = observation
        return self.context.held(self.action)


class Asking(Holding, LlmDriver):
    """Asks a model, and holds its action whatever the model says."""

    def ask(self, observation, number):
        self.seen[number] = observation
        slot = Slot("N_0_0", 1, self.context.side, number, 0)
        return Question("model", slot, "prompt", None, self.answered)

    def answered(self, prompt, reply):
        return self.context.held(self.action)


class Failing(Asking):
    """Gets no answer at one decision."""

    def __init__(self, action, at):
        super().__init__(action)
        self.at = at

    def answered(self, prompt, reply):
        if max(self.seen) == self.at:
            raise CallFailed("no answer", REQUEST, ATTEMPTS)
        return super().answered(prompt, reply)


def test_both_questions_of_an_instant_are_pending_until_they_are_answered():
    trial = begin(Asking(0.0), Asking(-1.0))
    for number in range(10):
        questions = trial.pending()
        assert [(q.slot.side, q.slot.decision) for q in questions] == [(s, number) for s in SIDES]
        assert trial.pending() == questions
        trial.answer({question.slot.side: decide(question) for question in reversed(questions)})
    assert trial.pending() == []
    assert trial.record() == play(Holding(0.0), Holding(-1.0))


def test_a_program_decides_at_once_beside_a_driver_that_asks():
    left, right = Holding(0.3), Asking(-0.6)
    trial = begin(left, right, "R_-4_8")
    assert [question.slot.side for question in trial.pending()] == ["right"]
    assert list(left.seen) == [0]
    assert play_trial(trial, decide) == play(Asking(0.3), Holding(-0.6), "R_-4_8")


class Waiting(Holding):
    """A program that waits, for its action in seconds: without an event loop there is no clock."""

    async def decide(self, observation, number):
        await asyncio.sleep(self.action)


class Faulty(Holding):
    """A program that fails."""

    async def decide(self, observation, number):
        raise KeyError("speed\nlimit")


def test_a_program_that_fails_is_told_in_one_line_with_its_place():
    with pytest.raises(UsageError, match=r"^the left driver fails in test_trial.py, line \d+: Key"):
        play(Faulty(0.0), Holding(0.0))


@pytest.mark.parametrize("delay_s", [0.0, 0.5])
def test_a_program_that_waits_is_refused(delay_s):
    with pytest.raises(UsageError, match=r"^the right driver waits .*: a program decides at once$"):
        play(Holding(0.0), Waiting(delay_s))


def test_both_drivers_observe_the_same_state():
    """Neither sees what the other has decided."""
    left, right = Asking(0.3), Holding(-0.6)
    trial = play(left, right, "R_-4_8")
    assert len(left.seen) == len(right.seen) > 5
    for number, from_left in left.seen.items():
        from_right = right.seen[number]
        at_step = {row.side: row for row in trial.states if row.step == number * EXECUTED}
        assert from_left.own_speed_mps == from_right.other_speed_mps
        assert from_right.own_speed_mps == from_left.other_speed_mps
        assert from_left.relative_distance_m == -from_right.relative_distance_m
        assert from_left.own_speed_mps == at_step["left"].velocity_mps
        assert from_right.own_speed_mps == at_step["right"].velocity_mps


def test_decisions_are_made_once_a_second_from_time_0_on():
    trial = play(Holding(0.0), Holding(-1.0))
    # The left car needs 10 s for 100 m; at the end of the track nobody is asked again.
    expected = [(number, float(number), side) for number in range(10) for side in SIDES]
    assert [(row.number, row.time_s, row.side) for row in trial.decisions] == expected
    assert (trial.status, trial.end_time_s, trial.merged_first) == ("finished", 10.0, "left")
    moved = {row.side: row.acceleration_mps2 for row in trial.states if row.step == 1}
    assert moved == {"left": 0.0, "right": -2.5}


ACTIONS = (0.1, -0.2, 0.3, -0.4, 0.5)


class Wavering(Holding):
    """Decides on the same five actions each time."""

    async def decide(self, observation, number):
        return Decision(plan=ACTIONS * 4, applied=ACTIONS)


def test_the_actions_of_a_decision_are_driven_in_their_order():
    trial = play(Wavering(0), Holding(-1.0))
    driven = [row.acceleration_mps2 for row in trial.states if row.side == "left"]
    # The row of step 0 is the start of control; steps 1 to 10 are two decisions.
    assert driven[1:11] == pytest.approx([2.5 * a for a in ACTIONS * 2])


def test_a_trial_ends_within_a_second_when_the_cars_collide():
    trial = play_constant()
    # Level cars at 10 m/s are closer than 4.5 m from 82 m on: after 3.2 s, at 3.4 s in steps.
    assert (trial.status, trial.end_time_s, trial.merged_first) == ("collided", 3.4, None)
    assert trial.states[-1].step == 17
    assert len(trial.states) == 2 * 18
    assert len(trial.decisions) == 2 * 4


@pytest.mark.parametrize("failing", SIDES)
def test_a_failed_call_ends_the_trial_and_keeps_what_was_played(failing):
    drivers = {side: Asking(-0.1) for side in SIDES}
    drivers[failing] = Failing(-0.1, at=2)
    (other,) = set(SIDES) - {failing}
    trial = play(**drivers)
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


def test_when_both_calls_fail_the_error_names_both_sides():
    left, right = Failing(0.0, at=0), Failing(0.0, at=0)
    trial = play(left, right)
    assert trial.status == "failed"
    assert trial.error == "left: no answer; right: no answer"
    assert [call.side for call in trial.failed_calls] == list(SIDES)
    assert trial.decisions == ()
    assert [(row.step, row.side) for row in trial.states] == [(0, "left"), (0, "right")]


def test_nobody_merged_first_in_a_trial_that_failed_after_the_merge():
    """The left car passes the merge point after 5 s."""
    trial = play(Holding(0.0), Failing(-1.0, at=7))
    assert (trial.status, trial.end_time_s, trial.merged_first) == ("failed", 7.0, None)


def test_under_own_exit_alone_the_driver_in_the_tunnel_is_not_asked():
    """In L_4_-8 the right car leaves its tunnel 0.785 s after the left one."""
    left, right = Holding(-0.5), Holding(-1.0)
    at_once = Holding(-1.0)
    play(Holding(-0.5), at_once, "L_4_-8")
    assert list(at_once.seen)[:2] == [0, 1]
    trial = play(left, right, "L_4_-8", control_start="own_exit")
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
    # Who waits for number 0 would never begin: the comment says what is counted.
    (comment,) = re.findall(r"decisions\.decision IS (.*?);\n", SCHEMA.read_text(), re.DOTALL)
    assert "a driver that leaves its tunnel later" in comment


FINE = {"step_s": 0.05, "plan_step_s": 0.2}


def deciding(rate_hz, action):
    """Holds an action, and decides so many times a second."""
    driver = Holding(action)
    driver.rate_hz = rate_hz
    return driver


def decided(trial, side):
    return [row for row in trial.decisions if row.side == side]


def test_each_driver_decides_at_its_own_rate_and_counts_its_own_decisions():
    trial = play(deciding(20, -0.1), deciding(5, -0.3), **FINE)
    left, right = decided(trial, "left"), decided(trial, "right")
    assert [row.number for row in left] == list(range(len(left)))
    assert [row.time_s for row in left] == pytest.approx([0.05 * n for n in range(len(left))])
    assert [row.time_s for row in right] == pytest.approx([0.2 * n for n in range(len(right))])
    assert len(left) > 3 * len(right) > 100
    assert {len(row.decision.applied) for row in left} == {1}
    assert {len(row.decision.applied) for row in right} == {4}


def test_a_plan_in_steps_of_its_own_drives_the_same_way_in_a_finer_world():
    coarse = play(Wavering(0), Holding(-1.0))
    fine = play(Wavering(0), deciding(20, -1.0), **FINE)
    one, other = (
        {(row.side, row.time_s): (row.position_m, row.velocity_mps) for row in trial.states}
        for trial in (coarse, fine)
    )
    shared = sorted(one.keys() & other.keys())
    assert len(shared) > 80
    assert [other[t] for t in shared] == [pytest.approx(one[t]) for t in shared]


@pytest.mark.parametrize("failing", SIDES)
def test_a_failed_call_has_the_number_of_its_own_driver(failing):
    drivers = {side: deciding(20, -0.1) for side in SIDES}
    drivers[failing] = Failing(-0.1, at=2)
    (other,) = set(SIDES) - {failing}
    trial = play(**drivers, **FINE)
    (call,) = trial.failed_calls
    assert (call.number, call.side, trial.end_time_s) == (2, failing, 2.0)
    # Who was due at that instant too has decided, and it is not driven.
    assert decided(trial, other)[-1].number == 40
    assert [row.number for row in decided(trial, failing)] == [0, 1]


def test_a_seed_is_that_of_the_slot_and_of_no_driver():
    spec, task = spec_of("N_0_0"), ScenarioConfig()
    seed = make_context(task, spec, "left", model_pace(task)).seed
    assert seed == 4387192367012543550
    others = {
        make_context(task, other, side, model_pace(task)).seed
        for other, side in (
            (spec, "right"),
            (replace(spec, condition="L_4_0"), "left"),
            (replace(spec, repetition=2), "left"),
            (replace(spec, sample_set=1), "left"),
        )
    }
    assert len({seed, *others}) == 5
    renamed = replace(spec, model_left="another", variant="A1", order=7)
    assert make_context(task, renamed, "left", model_pace(task)).seed == seed


class Short(Holding):
    """Decides on less than is to be driven."""

    async def decide(self, observation, number):
        return Decision(plan=None, applied=(0.5,))


def test_what_cannot_be_driven_is_refused_in_one_line():
    with pytest.raises(UsageError, match=r"^the left driver decided 1\.5: -1 to 1 can be driven$"):
        play(Holding(1.5), Holding(0.0))
    with pytest.raises(UsageError, match=r"the left driver decided on \(0.5,\), and is to drive 5"):
        play(Short(0), Holding(0.0))
