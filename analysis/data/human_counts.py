"""How the human trials ended in each condition, as published; read without pandas, at once."""

from __future__ import annotations

import csv
from functools import cache
from pathlib import Path
from typing import NamedTuple

OUTCOMES = Path(__file__).with_name("human_outcomes.csv")


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
    with OUTCOMES.open(encoding="utf-8", newline="") as file:
        return {
            row["condition"]: HumanCounts(*(int(row[name]) for name in HumanCounts._fields))
            for row in csv.DictReader(file)
        }
