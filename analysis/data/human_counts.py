"""Published counts of trials and collisions, read without pandas, at once."""

from __future__ import annotations

import csv
from functools import cache
from pathlib import Path
from typing import NamedTuple

DATA = Path(__file__).parent


class HumanCounts(NamedTuple):
    """Human trials of a condition by their outcome."""

    left_first: int
    right_first: int
    collided: int

    @property
    def trials(self) -> int:
        """All of them: each has one of these outcomes."""
        return sum(self)


@cache
def human_counts() -> dict[str, HumanCounts]:
    """The published outcomes by condition."""
    return {
        row["condition"]: HumanCounts(*(int(row[name]) for name in HumanCounts._fields))
        for row in _rows("human_outcomes")
    }


@cache
def published_accounts() -> dict[str, dict[str, int]]:
    """Collisions of the humans and of the published model by class."""
    found: dict[str, dict[str, int]] = {}
    for row in _rows("collision_accounts"):
        found.setdefault(row["drivers"], {})[row["account"]] = int(row["collisions"])
    return found


def _rows(name: str) -> list[dict[str, str]]:
    with (DATA / f"{name}.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))
