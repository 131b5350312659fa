"""Closed loop of one trial: both drivers observe one state, and decide at their decision steps.

A trial does no I/O. A program decides at once. A language model's prompt is a question; the caller
gets the answer from a server, a recording or a person.
"""

from __future__ import annotations

from collections.abc import Callable, Coroutine, Mapping
from functools import partial
from typing import Any

from merge_runner.config import PERFECT, ScenarioConfig
from merge_runner.drivers.base import Driver
from merge_runner.drivers.language_model import LlmDriver, Question
from merge_runner.errors import UsageError
from merge_runner.perception import NoisyObserver
from merge_runner.records import SIDES, CallFailed, Decision, Observation, ReplayMiss, Side
from merge_runner.registry import FAULTS, fault_of
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner.scenarios.merge.world import World
from merge_runner.trial_records import DecisionRow, FailedCall, TrialRecord, TrialSpec


class Trial:
    """Trial under way, which ends when its world ends or a call has failed."""

    def __init__(
        self,
        spec: TrialSpec,
        scenario: ScenarioConfig,
        drivers: Mapping[Side, Driver | LlmDriver],
    ) -> None:
        # A driver may set the start of its side, and of the other side if that driver sets none.
        by_driver = {side: d.starts for side, d in drivers.items() if hasattr(d, "starts")}
        starts = {}
        for set_by_other in by_driver.values():
            for side in SIDES:
                starts[side] = by_driver.get(side, set_by_other)[side]
        self._spec = spec
        self._world = World(scenario, spec.kinematics, TRACK, starts)
        self._states = {
            side: _DriverState(drivers[side], side, scenario, self._world) for side in SIDES
        }
        self._questions: list[Question] = []
        self._decided: dict[Side, Decision] = {}
        self._failures: dict[Side, CallFailed] = {}
        self._rows: list[DecisionRow] = []

    def pending(self) -> list[Question]:
        """Advance to the next decision step with questions and return them; none: the trial ended.

        Raises UsageError if a program's decision cannot be executed.
        """
        while not (self._questions or self._failures or self._world.status):
            for side, state in self._states.items():
                if state.decides_now():
                    outcome = state.decide()
                    if isinstance(outcome, Question):
                        self._questions.append(outcome)
                    else:
                        self._decided[side] = outcome
            if not self._questions:
                self._advance()
        return self._questions

    def answer(self, decisions: Mapping[Side, Decision]) -> None:
        """Take the decisions for all pending questions except the failed ones, and execute them."""
        self._decided.update(decisions)
        self._questions = []
        self._advance()

    def fail(self, side: Side, error: CallFailed) -> None:
        """Note that a side's question gets no answer; the trial then ends before the next step."""
        self._failures[side] = error

    def record(self) -> TrialRecord:
        """Return the trial up to now as a record."""
        world = self._world
        failures = {side: self._failures[side] for side in SIDES if side in self._failures}
        return TrialRecord(
            spec=self._spec,
            status="failed" if failures else world.status or "failed",
            merged_first=None if failures else world.merged_first(),
            end_time_s=world.time_s,
            error="; ".join(f"{side}: {failure}" for side, failure in failures.items()) or None,
            states=world.states(),
            decisions=tuple(self._rows),
            failed_calls=tuple(
                FailedCall(
                    self._states[side].number,
                    side,
                    failure.request,
                    failure.attempts,
                    failure.cached_attempts,
                    missed=isinstance(failure, ReplayMiss),
                )
                for side, failure in failures.items()
            ),
        )

    def _advance(self) -> None:
        """Drive the decisions until the next decision step of a driver, unless a call failed."""
        world, (left, right) = self._world, self._states.values()
        time_s = world.time_s
        for state in (left, right):
            if state.side in self._decided:
                decision = self._decided.pop(state.side)
                state.take(decision)
                row = DecisionRow(state.number, time_s, state.side, decision, state.observed)
                self._rows.append(row)
        if not self._failures:
            steps = min(left.steps_left, right.steps_left)
            world.drive(left.actions(steps), right.actions(steps))


def play_trial(trial: Trial, answer: Callable[[Question], Decision]) -> TrialRecord:
    """Play a trial to its end with an answer for each question; a CallFailed ends the trial."""
    while questions := trial.pending():
        decisions: dict[Side, Decision] = {}
        for question in questions:
            side = question.slot.side
            try:
                decisions[side] = answer(question)
            except CallFailed as failure:
                trial.fail(side, failure)
        trial.answer(decisions)
    return trial.record()


class _DriverState:
    """Driver in its trial, with its last decision and the step of that decision.

    ``observed`` is its last noisy observation, None under perfect perception.
    """

    def __init__(
        self, driver: Driver | LlmDriver, side: Side, scenario: ScenarioConfig, world: World
    ) -> None:
        self.driver, self.side, self._world = driver, side, world
        self._pace = driver.context.pace
        self._interval = self._pace.interval_steps
        perception, self._observer = scenario.perception(side), None
        if perception != PERFECT:
            observe = partial(world.observe, side)
            self._observer = NoisyObserver(
                perception, driver.context.seed, scenario.step_s, observe
            )
        self.number = 0  # of the last decision step, counted from the start of the trial
        self.observed: Observation | None = None
        self._driven: list[float] | None = None  # by step since the decision
        self._decided_at = 0
        self._in_control = False

    @property
    def steps_left(self) -> int:
        """Number of the world's steps until the driver's next decision step."""
        return self._interval - self._world.step % self._interval

    def decides_now(self) -> bool:
        """Return whether the driver decides at this step. Once in control, it stays in control."""
        self._in_control = self._in_control or self._world.in_control(self.side)
        return self._in_control and self._world.step % self._interval == 0

    def decide(self) -> Decision | Question:
        """Return the decision of a program, or the question to a language model."""
        self.number = self._world.step // self._interval
        self.observed = self._observer.observe(self._world.step) if self._observer else None
        observation = self.observed or self._world.observe(self.side)
        if isinstance(self.driver, LlmDriver):
            return self.driver.ask(observation, self.number)
        return _result_of(self.driver.decide(observation, self.number), self.side)

    def take(self, decision: Decision) -> None:
        """Drive by a decision from now on; raises UsageError if it cannot be executed."""
        applied, expected = decision.applied, self._pace.executed_actions
        driven: list[float] = []
        for action in applied:
            if -1 <= action <= 1:
                driven += [action] * self._pace.action_steps
        if len(applied) != expected or len(driven) != self._interval:
            raise UsageError(
                f"the {self.side} driver decided on {applied}, and is to drive {expected} actions "
                "from -1 to 1"
            )
        self._driven, self._decided_at = driven, self._world.step

    def actions(self, steps: int) -> list[float] | list[None]:
        """Return the actions of the next steps; None: no plan yet, constant speed."""
        if self._driven is None:
            return [None] * steps
        since = self._world.step - self._decided_at
        return self._driven[since : since + steps]


def _result_of(deciding: Coroutine[Any, Any, Decision], side: Side) -> Decision:
    """Return the result of an ``async def decide`` that awaits nothing.

    Raises UsageError for one that waits, or fails.
    """
    try:
        deciding.send(None)
    except StopIteration as end:
        decision: Decision = end.value
        return decision
    except FAULTS as error:
        # An audit has no event loop to wait in.
        if "no running event loop" not in str(error):
            raise fault_of(f"the {side} driver", error) from error
    deciding.close()
    raise UsageError(f"the {side} driver waits while it decides: a program decides at once")
