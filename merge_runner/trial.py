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
from merge_runner.scenarios.merge.world import World


async def play_trial(
    spec: TrialSpec,
    scenario: ScenarioConfig,
    drivers: Mapping[Side, Driver],
    *,
    in_turn: bool = False,
) -> TrialRecord:
    """Play a trial to its end, or until a call fails.

    Drivers are asked at once, or ``in_turn`` where their answers are there already. Raises
    UsageError for a decision that cannot be driven.
    """
    world = World(scenario, CONDITIONS.require(spec.condition), TRACK)
    # Each side starts as its own driver says, or else as the other's does.
    given = {side: d.starts for side, d in drivers.items() if hasattr(d, "starts")}
    if given:
        some = next(iter(given.values()))
        world.start_at({side: given.get(side, some)[side] for side in SIDES})
    seats = {side: _Seated(drivers[side]) for side in SIDES}
    for side in SIDES:
        perception, seed = scenario.perception(side), drivers[side].seat.seed
        if not perception.is_perfect:
            start = world.observe(side)
            seats[side].eyes = Eyes(perception, seed, scenario.step_s, start)
    decisions: list[DecisionRow] = []
    failures: dict[Side, CallFailed] = {}
    while world.status is None:
        due = [side for side in SIDES if seats[side].is_due(world) and world.in_control(side)]
        if in_turn or len(due) < 2:  # both
            answers = [await _answer(seats[side], world) for side in due]
        else:
            answers = await asyncio.gather(*(_answer(seats[side], world) for side in due))
        for side, answer in zip(due, answers, strict=True):
            if isinstance(answer, CallFailed):
                failures[side] = answer
                continue
            seat = seats[side]
            seat.take(answer, world.step)
            number = seat.number(world.step)
            decisions.append(DecisionRow(number, world.time_s, side, answer, seat.told))
        if failures:
            break
        world.advance({side: seats[side].action(world.step) for side in SIDES})
        for side, seat in seats.items():
            if seat.eyes:
                seat.eyes.look(world.observe(side))
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

    def is_due(self, world: World) -> bool:
        """Whether it decides now: its instants count from the start of the trial."""
        return world.step % self.driver.seat.pace.interval_steps == 0

    def number(self, step: int) -> int:
        """The number of its decision at a step, or of the last one before."""
        return step // self.driver.seat.pace.interval_steps

    def take(self, decision: Decision, step: int) -> None:
        """Drive by a decision from now on; raises UsageError for one that cannot be driven."""
        seat = self.driver.seat
        if len(decision.applied) != seat.pace.executed_actions or not all(
            -1 <= action <= 1 for action in decision.applied
        ):
            raise UsageError(
                f"the {seat.side} driver decided on {decision.applied}, and is to drive "
                f"{seat.pace.executed_actions} actions from -1 to 1"
            )
        self.decision, self.decided_at = decision, step

    def action(self, step: int) -> float | None:
        """What is driven in a step; None: nothing is decided yet, and the vehicle cruises."""
        if self.decision is None:
            return None
        driven = (step - self.decided_at) // self.driver.seat.pace.action_steps
        return self.decision.applied[driven]


async def _answer(seated: _Seated, world: World) -> Decision | CallFailed:
    """Ask a driver; where its call fails, the other's answer is still awaited."""
    seated.told = seated.eyes.told() if seated.eyes else None
    observation = seated.told or world.observe(seated.driver.seat.side)
    try:
        return await seated.driver.decide(observation, seated.number(world.step))
    except CallFailed as failure:
        return failure
