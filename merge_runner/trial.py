"""One trial: both drivers observe the same frozen state, decide together, and are driven."""

from __future__ import annotations

import asyncio

from merge_runner.config import ScenarioConfig
from merge_runner.drivers.base import Driver
from merge_runner.errors import CallFailed
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
from merge_runner.scenarios.base import World
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner.scenarios.registry import SCENARIOS


async def play_trial(
    spec: TrialSpec, scenario: ScenarioConfig, drivers: dict[Side, Driver]
) -> TrialRecord:
    """Play a trial to its end, or until a call fails."""
    world = SCENARIOS[scenario.name].world(scenario, CONDITIONS[spec.condition])
    decisions: list[DecisionRow] = []
    failures: dict[Side, CallFailed] = {}
    number = 0
    while world.status is None and not failures:
        asked = [side for side in SIDES if world.in_control(side)]
        answers = await _decide(world, {side: drivers[side] for side in asked}, number)
        failures = {s: a for s, a in answers.items() if isinstance(a, CallFailed)}
        decided = {s: a for s, a in answers.items() if isinstance(a, Decision)}
        decisions += [
            DecisionRow(number, world.time_s, side, decision) for side, decision in decided.items()
        ]
        if not failures:
            _drive(world, decided, scenario.executed_actions)
        number += 1
    return TrialRecord(
        spec=spec,
        status=world.status or "failed",
        merged_first=None if failures else world.merged_first(),
        end_time_s=world.time_s,
        error="; ".join(f"{side}: {exc}" for side, exc in failures.items()) or None,
        states=world.states(),
        decisions=tuple(decisions),
        failed_calls=tuple(
            FailedCall(number - 1, side, exc.request, exc.attempts, exc.earlier)
            for side, exc in failures.items()
        ),
    )


async def _decide(
    world: World, drivers: dict[Side, Driver], number: int
) -> dict[Side, Decision | CallFailed]:
    """Ask all drivers at once; where one call fails, the other's answer is still awaited."""

    async def answer(driver: Driver, observation: Observation) -> Decision | CallFailed:
        try:
            return await driver.decide(observation, number)
        except CallFailed as failure:
            return failure

    answers = await asyncio.gather(
        *(answer(driver, world.observe(side)) for side, driver in drivers.items())
    )
    return dict(zip(drivers, answers, strict=True))


def _drive(world: World, decided: dict[Side, Decision], actions: int) -> None:
    for index in range(actions):
        world.advance(
            {side: decided[side].applied[index] if side in decided else None for side in SIDES}
        )
        if world.status is not None:
            return
