"""The sanity floor: keeps its speed, and so collides with its like in every condition."""

from __future__ import annotations

from dataclasses import dataclass

from merge_runner.config import ScenarioConfig
from merge_runner.drivers.base import held
from merge_runner.records import Decision, Observation


@dataclass(frozen=True, slots=True)
class ConstantDriver:
    """Keeps its speed where there is no resistance."""

    scenario: ScenarioConfig

    async def decide(self, observation: Observation, number: int) -> Decision:
        """Accelerate by nothing."""
        return held(0.0, self.scenario.plan_actions, self.scenario.executed_actions)
