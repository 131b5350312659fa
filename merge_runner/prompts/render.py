"""An observation as the text of a prompt."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from functools import lru_cache
from statistics import fmean

from merge_runner.config import ScenarioConfig
from merge_runner.prompts.blocks import Fields, blocks_of, named
from merge_runner.prompts.state_lines import LINES, NOT_SEEN
from merge_runner.records import Observation, Road
from merge_runner.registry import Catalogue, in_use

KMH_OF_MPS = 3.6
MPH_OF_MPS = 3600 / 1609.344  # the international mile of 1959
_UNIT_OF_NOTHING = re.compile(rf"({NOT_SEEN}) (?:m/s\^2|m/s|km/h|mph|m|s)(?![\w/^])")


def render_prompt(
    observation: Observation,
    remaining_plan: Sequence[float] | None,
    *,
    variant: str,
    scenario: ScenarioConfig,
) -> str:
    """The prompt of a variant.

    ``remaining_plan`` is the unexecuted rest of the last valid plan (normalised accelerations),
    None before the first.
    """
    template, lines = _template(variant, observation.road, in_use())
    values = {name: LINES[name](observation) for name in lines}
    prompt = template.format_map({**_fields(observation, remaining_plan, scenario), **values})
    return prompt if observation.other_seen else _UNIT_OF_NOTHING.sub(r"\1", prompt)


@lru_cache
def _template(variant: str, road: Road, _: Catalogue) -> tuple[str, list[str]]:
    """The blocks of a variant that a road has, one below the other; and the lines that they name.

    These take longer than all other fields, and few prompts have them.
    """
    templates = (block.template(road) for block in blocks_of(variant).values())
    whole = "\n\n".join(template for template in templates if template is not None) + "\n"
    return whole, [name for name in named(whole) if name in LINES]


def _fields(
    observation: Observation, remaining_plan: Sequence[float] | None, scenario: ScenarioConfig
) -> Fields:
    distance = observation.distance_to_merge_m
    every = scenario.action_steps
    own, other = observation.own_speed_mps, observation.other_speed_mps

    def of_other(value: float) -> str:
        return decimal(value) if observation.other_seen else NOT_SEEN

    return {
        "vehicle_length": f"{scenario.vehicle_length_m:g}",
        "own_speed": decimal(own),
        "other_speed": of_other(other),
        "own_speed_kmh": decimal(own * KMH_OF_MPS),
        "other_speed_kmh": of_other(other * KMH_OF_MPS),
        "own_speed_mph": decimal(own * MPH_OF_MPS),
        "other_speed_mph": of_other(other * MPH_OF_MPS),
        "relative_speed": of_other(own - other),
        "relative_distance": of_other(observation.relative_distance_m),
        "distance_to_merge": "" if distance is None else decimal(distance),
        "own_accelerations": listing(_means(observation.own_accelerations_mps2, every)),
        "other_speeds": (
            listing(_firsts(observation.other_speeds_mps, every))
            if observation.other_seen
            else NOT_SEEN
        ),
        "remaining_plan": (
            "none, this is your first decision"
            if remaining_plan is None
            else f"{listing(remaining_plan)}, one value every {scenario.action_s:g} s, next first"
        ),
        "memory_s": f"{scenario.memory_s:g}",
        "horizon_s": f"{scenario.horizon_s:g}",
        "step_s": f"{scenario.action_s:g}",
        "prompt_interval_s": f"{1 / scenario.prompt_rate_hz:g}",
        "plan_actions": str(scenario.plan_actions),
        "max_acceleration": f"{scenario.max_acceleration_mps2:g}",
    }


def _firsts(values: Sequence[float], every: int) -> Sequence[float]:
    """Each ``every``-th of the world's samples; the last of them is ``every`` before now."""
    return values if every == 1 else values[len(values) % every :: every]


def _means(values: Sequence[float], every: int) -> Sequence[float]:
    """The means of ``every`` of the world's samples each, the last of which end now."""
    if every == 1:
        return values
    return [fmean(values[i : i + every]) for i in range(len(values) % every, len(values), every)]


def decimal(value: float) -> str:
    """Two decimals, and never a negative zero."""
    return f"{value:.2f}".replace("-0.00", "0.00")


def listing(values: Iterable[float]) -> str:
    """Values as a Python list of two decimals."""
    return f"[{', '.join([f'{value:.2f}' for value in values])}]".replace("-0.00", "0.00")
