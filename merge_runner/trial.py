"""One trial: whoever is due observes the same frozen state and decides, and both are driven."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from dataclasses import dataclass

from merge_runner.config import ScenarioConfig
from merge_runner.drivers.base import Driver
from merge_runner.errors import CallFailed, ReplayMiss, UsageError
from merge_runner.perception import Eyes
from merge_runner.records import (
    SIDES,
    Decision,
    DecisionRow,
    FailedCall,
    Observation,
    Side,
    TrialRecord,
    TrialSpec,
)
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner.scenarios.merge.world import Starts, World


async def play_trial(
    spec: TrialSpec,
    scenario: ScenarioConfig,
    drivers: Mapping[Side, Driver],
    *,
    in_turn: bool = False,
) -> TrialRecord:
    """Play a trial to its end, or until a call fails.

    Drivers are asked at once, or ``in_turn`` where their answers are there already.
    """
    world = World(scenario, CONDITIONS.require(spec.condition), TRACK)
    if starts := _starts(drivers):
        world.start_at(starts)
    seats = {side: _seated(drivers[side], world) for side in SIDES}
    decisions: list[DecisionRow] = []
    failures: dict[Side, CallFailed] = {}
    while world.status is None:
        answers = await _decide(world, seats, in_turn)
        failures = {s: a for s, a in answers.items() if isinstance(a, CallFailed)}
        for side, answer in answers.items():
            if isinstance(answer, Decision):
                number = seats[side].take(answer, world.step)
                told = seats[side].told
                decisions.append(DecisionRow(number, world.time_s, side, answer, told))
        if failures:
            break
        world.advance({side: seats[side].action(world.step) for side in SIDES})
        for side, seated in seats.items():
            if seated.eyes:
                seated.eyes.look(world.observe(side))
    return TrialRecord(
        spec=spec,
        status=world.status or "failed",
        merged_first=None if failures else world.merged_first(),
        end_time_s=world.time_s,
        error="; ".join(f"{side}: {exc}" for side, exc in failures.items()) or None,
        states=world.states(),
        decisions=tuple(decisions),
        failed_calls=tuple(
            FailedCall(
                seats[side].number(world.step),
                side,
                exc.request,
                exc.attempts,
                exc.earlier,
                missed=isinstance(exc, ReplayMiss),
            )
            for side, exc in failures.items()
        ),
    )


def _starts(drivers: Mapping[Side, Driver]) -> Starts | None:
    """Return where the vehicles start; None where no driver has ``starts`` of both sides.

    Each side starts as its own driver says, or else as the other's does.
    """
    known: dict[Side, Starts] = {
        side: driver.starts for side, driver in drivers.items() if hasattr(driver, "starts")
    }
    if not known:
        return None
    (some, *_) = known.values()
    return {side: known.get(side, some)[side] for side in SIDES}


@dataclass(slots=True)
class _Seated:
    """A driver in its trial: what it decided last, and at which step of the world.

    It has ``eyes`` where its perception is imperfect, and was ``told`` what they saw.
    """

    driver: Driver
    eyes: Eyes | None = None
    told: Observation | None = None
    decision: Decision | None = None
    decided_at: int = 0

    def is_due(self, step: int) -> bool:
        """Whether it decides at a step: its instants count from the start of the trial."""
        return step % self.driver.seat.pace.interval_steps == 0

    def number(self, step: int) -> int:
        """The number of its decision at a step, or of the last one before."""
        return step // self.driver.seat.pace.interval_steps

    def observe(self, world: World) -> Observation:
        """What the driver is told of the world as it is now."""
        if self.eyes is None:
            return world.observe(self.driver.seat.side)
        self.told = self.eyes.told()
        return self.told

    def take(self, decision: Decision, step: int) -> int:
        """Drive by a decision from now on; returns its number. Raises UsageError for an odd one."""
        seat = self.driver.seat
        if len(decision.applied) != seat.pace.executed_actions or not all(
            -1 <= action <= 1 for action in decision.applied
        ):
            raise UsageError(
                f"the {seat.side} driver decided on {decision.applied}, and is to drive "
                f"{seat.pace.executed_actions} actions from -1 to 1"
            )
        self.decision, self.decided_at = decision, step
        return self.number(step)

    def action(self, step: int) -> float | None:
        """What is driven in a step; None: nothing is decided yet, and the vehicle cruises."""
        if self.decision is None:
            return None
        driven = (step - self.decided_at) // self.driver.seat.pace.action_steps
        return self.decision.applied[driven]


def _seated(driver: Driver, world: World) -> _Seated:
    seat = driver.seat
    perception = seat.scenario.perception(seat.side)
    if perception.is_perfect:
        return _Seated(driver)
    start = world.observe(seat.side)
    return _Seated(driver, Eyes(perception, seat.seed, seat.scenario.step_s, start))


async def _decide(
    world: World, seats: Mapping[Side, _Seated], in_turn: bool
) -> dict[Side, Decision | CallFailed]:
    """Ask all who are due; where one call fails, the other's answer is still awaited."""
    asked = {
        side: (seated, seated.observe(world), world.step)
        for side, seated in seats.items()
        if seated.is_due(world.step) and world.in_control(side)
    }
    if in_turn or not asked:
        return {side: await _answer(*told) for side, told in asked.items()}
    answers = await asyncio.gather(*(_answer(*told) for told in asked.values()))
    return dict(zip(asked, answers, strict=True))


async def _answer(seated: _Seated, observation: Observation, step: int) -> Decision | CallFailed:
    try:
        return await seated.driver.decide(observation, seated.number(step))
    except CallFailed as failure:
        return failure
