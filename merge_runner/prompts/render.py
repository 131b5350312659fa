"""An observation as the text of a prompt."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from merge_runner.config import Scenario
from merge_runner.prompts.blocks import BLOCKS, VARIANTS
from merge_runner.records import Observation


def render_prompt(
    observation: Observation,
    remaining_plan: Sequence[float] | None,
    *,
    variant: str,
    scenario: Scenario,
) -> str:
    """The prompt of a variant.

    ``remaining_plan`` is the unexecuted rest of the last valid plan (normalised accelerations),
    None before the first.
    """
    removed = VARIANTS[variant]
    fields = _fields(observation, remaining_plan, scenario)
    paragraphs = (
        template.format_map(fields)
        for block in BLOCKS
        if block.name not in removed and (template := block.template(observation.road)) is not None
    )
    return "\n\n".join(paragraphs) + "\n"


def _fields(
    observation: Observation, remaining_plan: Sequence[float] | None, scenario: Scenario
) -> dict[str, str]:
    distance = observation.distance_to_merge_m
    return {
        "vehicle_length": f"{scenario.vehicle_length_m:g}",
        "own_speed": decimal(observation.own_speed_mps),
        "other_speed": decimal(observation.other_speed_mps),
        "relative_distance": decimal(observation.relative_distance_m),
        "distance_to_merge": "" if distance is None else decimal(distance),
        "own_accelerations": listing(observation.own_accelerations_mps2),
        "other_speeds": listing(observation.other_speeds_mps),
        "remaining_plan": (
            "none, this is your first decision"
            if remaining_plan is None
            else f"{listing(remaining_plan)}, one value every {scenario.step_s:g} s, next first"
        ),
        "memory_s": f"{scenario.memory_s:g}",
        "horizon_s": f"{scenario.horizon_s:g}",
        "step_s": f"{scenario.step_s:g}",
        "prompt_interval_s": f"{1 / scenario.prompt_rate_hz:g}",
        "plan_actions": str(scenario.plan_actions),
        "max_acceleration": f"{scenario.max_acceleration_mps2:g}",
    }


def decimal(value: float) -> str:
    """Two decimals, and never a negative zero."""
    text = f"{value:.2f}"
    return "0.00" if text == "-0.00" else text


def listing(values: Iterable[float]) -> str:
    """Values as a Python list of two decimals."""
    return f"[{', '.join(decimal(value) for value in values)}]"
