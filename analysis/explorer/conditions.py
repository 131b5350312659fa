"""The conditions of a database: in words, and in the order that everybody knows."""

from __future__ import annotations

from collections.abc import Iterable

from analysis.explorer.catalogue import Catalogue
from analysis.explorer.views import condition_text
from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS


def condition_texts(catalogue: Catalogue, names: Iterable[str]) -> dict[str, str]:
    """Conditions in words; empty for one that no human drove and that has no trial yet."""
    known = {
        name: (one.projected_headway_m, one.relative_velocity_mps)
        for name, one in HUMAN_CONDITIONS.items()
    } | {
        row["condition"]: (row["projected_headway_m"], row["relative_velocity_mps"])
        for row in catalogue.ask(
            "SELECT DISTINCT condition, projected_headway_m, relative_velocity_mps FROM listed"
        )
    }
    return {name: condition_text(*known[name]) if name in known else "" for name in names}


def ordered(names: Iterable[str], usual: Iterable[str] = HUMAN_CONDITIONS) -> list[str]:
    """Names in their usual order, those that are unknown last."""
    places = {name: place for place, name in enumerate(usual)}
    return sorted(names, key=lambda name: (places.get(name, len(places)), name))
