"""One trial: whoever is due observes the same frozen state and decides, and both are driven.

What a driver is told of that state may be late, with errors, missing now and then, or not that far.
"""

from __future__ import annotations

import asyncio
from collections.abc import Mapping, Sequence
from functools import partial

from merge_runner.config import PERFECT, ScenarioConfig
from merge_runner.drivers.base import Driver
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


async def play_trial(
    spec: TrialSpec,
    scenario: ScenarioConfig,
    drivers: Mapping[Side, Driver],
    *,
    in_turn: bool = False,
) -> TrialRecord:
    """Play a trial to its end, or until a call fails.

    Drivers are asked at once, or ``in_turn`` where their answers are there already. Raises
    UsageError for a decision that cannot be driven, and what a driver raises but CallFailed.
    """
    # Each side starts as its own driver says, or else as the other's does.
    given = {side: d.starts for side, d in drivers.items() if hasattr(d, "starts")}
    starts = {side: given.get(side, other)[side] for other in given.values() for side in SIDES}
    world = World(scenario, spec.kinematics, TRACK, starts)
    seats = [_Seated(drivers[side], side, scenario, world) for side in SIDES]
    decisions: list[DecisionRow] = []
    failures: dict[Side, CallFailed] = {}
    failed_calls: list[FailedCall] = []
    while world.status is None and not failures:
        due = [seat for seat in seats if seat.is_due()]
        if in_turn or len(due) < 2:  # both
            answers = [await seat.ask() for seat in due]
        else:
            answers = await _ask_at_once(due)
        for seat, answer in zip(due, answers, strict=True):
            number, side = world.step // seat.interval, seat.side
            if isinstance(answer, CallFailed):
                failures[side] = answer
                missed = isinstance(answer, ReplayMiss)
                call = answer.request, answer.attempts, answer.earlier
                failed_calls.append(FailedCall(number, side, *call, missed=missed))
            else:
                seat.take(answer)
                decisions.append(DecisionRow(number, world.time_s, side, answer, seat.told))
        if not failures:
            world.advance({seat.side: seat.action() for seat in seats})
    return TrialRecord(
        spec=spec,
        status=world.status or "failed",
        merged_first=None if failures else world.merged_first(),
        end_time_s=world.time_s,
        error="; ".join(f"{side}: {exc}" for side, exc in failures.items()) or None,
        states=world.states(),
        decisions=tuple(decisions),
        failed_calls=tuple(failed_calls),
    )


async def _ask_at_once(seats: Sequence[_Seated]) -> list[Decision | CallFailed]:
    """Ask drivers side by side; where one raises, no other goes on when this returns."""
    asking = [asyncio.create_task(seat.ask()) for seat in seats]
    try:
        return await asyncio.gather(*asking)
    finally:
        if left := [task for task in asking if not task.done()]:
            for task in left:
                task.cancel()
            await asyncio.gather(*left, return_exceptions=True)


class _Seated:
    """A driver in its trial: what it decided last, and at which step of the world.

    It has ``eyes`` where its perception is imperfect, and was ``told`` what they saw.
    """

    def __init__(self, driver: Driver, side: Side, scenario: ScenarioConfig, world: World) -> None:
        self.driver, self.side, self._world = driver, side, world
        self._pace = driver.seat.pace
        self.interval = self._pace.interval_steps
        perception, self.eyes = scenario.perception(side), None
        if perception != PERFECT:
            observe = partial(world.observe, side)
            self.eyes = Eyes(perception, driver.seat.seed, scenario.step_s, observe)
        self.told: Observation | None = None
        self._applied: tuple[float, ...] | None = None
        self._decided_at = 0

    def is_due(self) -> bool:
        """Whether it decides now: its instants count from the start of the trial."""
        return self._world.step % self.interval == 0 and self._world.in_control(self.side)

    async def ask(self) -> Decision | CallFailed:
        """Ask the driver; where its call fails, the other's answer is still awaited."""
        self.told = self.eyes.told(self._world.step) if self.eyes else None
        observation = self.told or self._world.observe(self.side)
        try:
            return await self.driver.decide(observation, self._world.step // self.interval)
        except CallFailed as failure:
            return failure

    def take(self, decision: Decision) -> None:
        """Drive by a decision from now on; raises UsageError for one that cannot be driven."""
        applied, wanted = decision.applied, self._pace.executed_actions
        if len(applied) != wanted or not all(-1 <= action <= 1 for action in applied):
            raise UsageError(
                f"the {self.side} driver decided on {applied}, and is to drive {wanted} actions "
                "from -1 to 1"
            )
        self._applied, self._decided_at = applied, self._world.step

    def action(self) -> float | None:
        """What is driven in a step; None: nothing is decided yet, and the vehicle cruises."""
        if self._applied is None:
            return None
        return self._applied[(self._world.step - self._decided_at) // self._pace.action_steps]
