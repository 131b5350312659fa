"""Settings of a driving task as texts, for pages and the report; needs no pandas."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from merge_runner.config import ScenarioConfig

RULE = "collision_rule"


def task_settings(scenario: Mapping[str, Any]) -> Iterator[str]:
    """Return the collision rule of a driving task, and settings other than the defaults."""
    defaults = ScenarioConfig().model_dump()
    unusual = {name: value for name, value in scenario.items() if defaults.get(name) != value}
    return leaves({RULE: scenario.get(RULE, defaults[RULE]), **unusual})


def leaves(values: Mapping[str, Any]) -> Iterator[str]:
    """Yield ``name = value`` of values, and of those within them."""
    for name, value in values.items():
        yield from leaves(value) if isinstance(value, dict) else [f"{name} = {value}"]
