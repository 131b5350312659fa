"""The conditions of a database: in words, and in the order that everybody knows."""

from __future__ import annotations

from collections.abc import Iterable

from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner_analysis.explorer.catalogue import Catalogue
from merge_runner_analysis.explorer.views import condition_text


def condition_texts(catalogue: Catalogue) -> dict[str, str]:
    """In words: the conditions that humans drove, and those of all trials."""
    numbers = "condition, projected_headway_m, relative_velocity_mps"
    played = catalogue.ask(f"SELECT DISTINCT {numbers} FROM listed")  # noqa: S608 # constants
    return {
        name: condition_text(one.projected_headway_m, one.relative_velocity_mps)
        for name, one in HUMAN_CONDITIONS.items()
    } | {name: condition_text(*of) for name, *of in map(dict.values, played)}


def ordered(names: Iterable[str], usual: Iterable[str] = HUMAN_CONDITIONS) -> list[str]:
    """Names in their usual order, those that are unknown last."""
    places = {name: place for place, name in enumerate(usual)}
    return sorted(names, key=lambda name: (places.get(name, len(places)), name))
