"""When a driver decides, and in what steps it acts: each driver has a pace of its own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from merge_runner.config import ScenarioConfig, whole_steps
from merge_runner.errors import UsageError


@dataclass(frozen=True, slots=True)
class Pace:
    """Whole numbers of steps.

    An action lasts ``action_steps`` steps of the world. Of the ``plan_actions`` of a plan
    ``executed_actions`` are driven before the next decision.
    """

    action_steps: int
    executed_actions: int
    plan_actions: int

    @property
    def interval_steps(self) -> int:
        """How many steps of the world pass between two decisions."""
        return self.action_steps * self.executed_actions


def model_pace(scenario: ScenarioConfig) -> Pace:
    """That of a language model: its prompt rate, and the steps of its plan."""
    return Pace(scenario.action_steps, scenario.executed_actions, scenario.plan_actions)


def program_pace(scenario: ScenarioConfig, rate_hz: float | None) -> Pace:
    """That of a program with a rate of its own, or at the prompt rate; it acts in every step.

    Raises ValueError where the world's step is too long for the rate.
    """
    interval_s = 1 / (scenario.prompt_rate_hz if rate_hz is None else rate_hz)
    executed = whole_steps("the time between two decisions", interval_s, scenario.step_s)
    horizon = whole_steps("horizon_s", scenario.horizon_s, scenario.step_s)
    return Pace(1, executed, max(horizon, executed))


def pace_of(scenario: ScenarioConfig, driver: Mapping[str, Any]) -> Pace:
    """The pace of what a spec says of a driver; raises UsageError."""
    if "endpoint" in driver:
        return model_pace(scenario)
    rate_hz = driver.get("rate_hz")
    try:
        return program_pace(scenario, None if rate_hz is None else float(rate_hz))
    except (TypeError, ValueError, ZeroDivisionError) as exc:
        raise UsageError(
            f"the driver {driver.get('program')} cannot decide {rate_hz} times a second: {exc}; "
            "set a step_s that fits under [scenario] of the sweep's file, and beside it "
            f"plan_step_s = {scenario.action_s:g} to leave a language model's plan as it is"
        ) from exc
