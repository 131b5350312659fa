"""Decision timing of a driver: control interval, duration of an action, planning horizon."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from merge_runner.config import ScenarioConfig, whole_steps
from merge_runner.errors import UsageError


class Pace(NamedTuple):
    """Decision timing in whole steps of the world.

    An action lasts ``action_steps`` steps. ``executed_actions`` of the ``plan_actions`` of a plan
    are driven before the next decision.
    """

    action_steps: int
    executed_actions: int
    plan_actions: int

    @property
    def interval_steps(self) -> int:
        """Steps between two decisions."""
        return self.action_steps * self.executed_actions


def model_pace(scenario: ScenarioConfig) -> Pace:
    """Return the pace of a language model, by its prompt rate and the steps of its plan."""
    return Pace(scenario.action_steps, scenario.executed_actions, scenario.plan_actions)


def program_pace(scenario: ScenarioConfig, rate_hz: float | None) -> Pace:
    """Return the pace of a program, by its rate or else the prompt rate; an action is one step.

    Raise ValueError if the world's step does not fit the rate.
    """
    interval_s = 1 / (scenario.prompt_rate_hz if rate_hz is None else rate_hz)
    executed = whole_steps("the time between two decisions", interval_s, scenario.step_s)
    horizon = whole_steps("horizon_s", scenario.horizon_s, scenario.step_s)
    return Pace(1, executed, max(horizon, executed))


def pace_of(scenario: ScenarioConfig, driver: Mapping[str, Any]) -> Pace:
    """Return the pace of a driver in a spec; raise UsageError."""
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
