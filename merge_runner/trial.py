"""One trial: both drivers observe the same state, those that are due decide, and time goes on.

A trial does no I/O. Programs decide at once; a language model's prompt is a question, which whoever
plays the trial gets answered: by a server, by a recording, or by a person.
"""

from __future__ import annotations

from collections.abc import Callable, Coroutine, Mapping
from functools import partial
from typing import Any

from merge_runner.config import PERFECT, ScenarioConfig
from merge_runner.drivers.base import Driver
from merge_runner.drivers.language_model import LlmDriver, Question
from merge_runner.errors import UsageError
from merge_runner.perception import Eyes
from merge_runner.records import (
    SIDES,
    CallFailed,
    Decision,
    DecisionRow,
    FailedCall,
    Observation,
    ReplayMiss,
    Side,
    TrialRecord,
    TrialSpec,
)
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner.scenarios.merge.world import World


class Trial:
    """A trial under way; it ends with its world, or at the first instant at which a call fails."""

    def __init__(
        self,
        spec: TrialSpec,
        scenario: ScenarioConfig,
        drivers: Mapping[Side, Driver | LlmDriver],
    ) -> None:
        # Each side starts as its own driver says, or else as the other's does.
        given = {side: d.starts for side, d in drivers.items() if hasattr(d, "starts")}
        starts = {side: given.get(side, other)[side] for other in given.values() for side in SIDES}
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
        """Go on to the next instant with questions, and return these; none: the trial has ended.

        Raises UsageError for a decision of a program that cannot be driven.
        """
        while not (self._questions or self._failures or self._world.status):
            for side, state in self._states.items():
                if state.is_due():
                    asked = state.ask()
                    if isinstance(asked, Question):
                        self._questions.append(asked)
                    else:
                        self._decided[side] = asked
            if not self._questions:
                self._go_on()
        return self._questions

    def answer(self, decisions: Mapping[Side, Decision]) -> None:
        """Take the decisions on all pending questions but the failed ones, and drive by them."""
        self._decided.update(decisions)
        self._questions = []
        self._go_on()

    def fail(self, side: Side, error: CallFailed) -> None:
        """Note that the question of a side has no answer: the trial ends, and is not driven on."""
        self._failures[side] = error

    def record(self) -> TrialRecord:
        """The trial as it was played."""
        world, failures = self._world, self._failures
        failed = [side for side in SIDES if side in failures]
        return TrialRecord(
            spec=self._spec,
            status="failed" if failures else world.status or "failed",
            merged_first=None if failures else world.merged_first(),
            end_time_s=world.time_s,
            error="; ".join(f"{side}: {failures[side]}" for side in failed) or None,
            states=world.states(),
            decisions=tuple(self._rows),
            failed_calls=tuple(
                FailedCall(
                    self._states[side].number,
                    side,
                    failures[side].request,
                    failures[side].attempts,
                    failures[side].earlier,
                    missed=isinstance(failures[side], ReplayMiss),
                )
                for side in failed
            ),
        )

    def _go_on(self) -> None:
        """Drive by what is decided until a driver may decide again."""
        world, (left, right) = self._world, self._states.values()
        time_s = world.time_s
        for state in (left, right):
            if state.side in self._decided:
                decision = self._decided.pop(state.side)
                state.take(decision)
                row = DecisionRow(state.number, time_s, state.side, decision, state.told)
                self._rows.append(row)
        if not self._failures:
            steps = min(left.steps_left, right.steps_left)
            world.drive(left.actions(steps), right.actions(steps))


def play_trial(trial: Trial, decide: Callable[[Question], Decision]) -> TrialRecord:
    """Play a trial to its end with answers that are there already; a CallFailed ends it."""
    while questions := trial.pending():
        decisions: dict[Side, Decision] = {}
        for question in questions:
            side = question.slot.side
            try:
                decisions[side] = decide(question)
            except CallFailed as failure:
                trial.fail(side, failure)
        trial.answer(decisions)
    return trial.record()


class _DriverState:
    """A driver in its trial: what it decided last, and at which step of the world.

    It has ``eyes`` where its perception is imperfect, and was ``told`` what they saw.
    """

    def __init__(
        self, driver: Driver | LlmDriver, side: Side, scenario: ScenarioConfig, world: World
    ) -> None:
        self.driver, self.side, self._world = driver, side, world
        self._pace = driver.context.pace
        self._interval = self._pace.interval_steps
        perception, self._eyes = scenario.perception(side), None
        if perception != PERFECT:
            observe = partial(world.observe, side)
            self._eyes = Eyes(perception, driver.context.seed, scenario.step_s, observe)
        self.number = 0  # of its last instant: they count from the start of the trial
        self.told: Observation | None = None
        self._driven: list[float] | None = None  # by step since the decision
        self._decided_at = 0
        self._in_control = False

    @property
    def steps_left(self) -> int:
        """The steps of the world until its next instant."""
        return self._interval - self._world.step % self._interval

    def is_due(self) -> bool:
        """Whether it decides now: it is in control, from some time on for good."""
        self._in_control = self._in_control or self._world.in_control(self.side)
        return self._in_control and self._world.step % self._interval == 0

    def ask(self) -> Decision | Question:
        """What the driver decides, or asks a model."""
        self.number = self._world.step // self._interval
        self.told = self._eyes.told(self._world.step) if self._eyes else None
        observation = self.told or self._world.observe(self.side)
        asked = self.driver.decide(observation, self.number)
        return asked if isinstance(asked, Question) else _decided(asked, self.side)

    def take(self, decision: Decision) -> None:
        """Drive by a decision from now on; raises UsageError for one that cannot be driven."""
        applied, wanted = decision.applied, self._pace.executed_actions
        driven: list[float] = []
        for action in applied:
            if -1 <= action <= 1:
                driven += [action] * self._pace.action_steps
        if len(applied) != wanted or len(driven) != self._interval:
            raise UsageError(
                f"the {self.side} driver decided on {applied}, and is to drive {wanted} actions "
                "from -1 to 1"
            )
        self._driven, self._decided_at = driven, self._world.step

    def actions(self, steps: int) -> list[float] | list[None]:
        """What is driven in the next steps; None: nothing is decided yet, and it cruises."""
        if self._driven is None:
            return [None] * steps
        since = self._world.step - self._decided_at
        return self._driven[since : since + steps]


def _decided(deciding: Coroutine[Any, Any, Decision], side: Side) -> Decision:
    """What an ``async def decide`` returns, which waits for nothing; raises UsageError."""
    try:
        deciding.send(None)
    except StopIteration as end:
        decision: Decision = end.value
        return decision
    except RuntimeError as error:
        # Without an event loop, as in a replay, there is nothing to wait with.
        if "no running event loop" not in str(error):
            raise
    deciding.close()
    raise UsageError(f"the {side} driver waits while it decides: a program decides at once")
