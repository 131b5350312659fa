"""Kinds of drivers in a trial's spec: language models, programs, and those that cannot react."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

from merge_runner.config import ScenarioConfig
from merge_runner.drivers.registry import MOCKS
from merge_runner.records import SIDES, Side


def language_models(names: Mapping[Side, str], spec: Mapping[str, Any]) -> dict[Side, str]:
    """Return the language models among these names, by the spec: programs may be unknown here."""
    return {side: name for side, name in names.items() if "program" not in (spec.get(side) or {})}


def programs_alone(spec: Mapping[str, Any]) -> bool:
    """Return whether programs drive on both sides, so that no language model samples."""
    return all("program" in (spec.get(side) or {}) for side in SIDES)


def has_chance(spec: Mapping[str, Any], sides: Collection[Side] = SIDES) -> bool:
    """Return whether drivers of a spec, or what they perceive, are drawn by chance."""
    scenario = ScenarioConfig.model_validate(spec.get("scenario", {}))
    drivers = {side: spec.get(side) or {} for side in sides}
    return any(
        "program" not in driver or driver.get("chance") or scenario.perception(side).is_random
        for side, driver in drivers.items()
    )


def unresponsive(spec: Mapping[str, Any]) -> str:
    """Return a warning that replayed humans do not react; empty if a spec replays none."""
    sides = [side for side in SIDES if "data" in (spec.get(side) or {})]
    if len(sides) == len(SIDES):
        return "both humans are replayed and do not react"
    return f"the human on the {sides[0]} is replayed and does not react" if sides else ""


def stand_in(models: Mapping[Side, str], sides: Collection[Side] = SIDES) -> str:
    """Return the label of language models' trials that a mock model answered on some sides."""
    named = {side: name for side, name in models.items() if name not in MOCKS}
    posing = "+".join(dict.fromkeys(name for side, name in named.items() if side in sides))
    real = [side for side in named if side not in sides]
    where = f" on the {'left' if real == ['right'] else 'right'}" if real else ""
    return f"mock model{where}, {f'not {posing}' if posing else 'no language model'}"
