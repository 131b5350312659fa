"""Published counts of trials and collisions, read without pandas, at once."""

from __future__ import annotations

import csv
from functools import cache
from pathlib import Path
from typing import NamedTuple

from merge_runner.results.export import SchemaColumn, SchemaTable

DATA = Path(__file__).parent
OUTCOMES = "human_outcomes.csv"
WORDS = ("smallest", "first quartile of the", "median", "third quartile of the", "largest")


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


def outcomes_table() -> tuple[SchemaTable, Path]:
    """The published outcomes as a table of an export, and their file."""
    (source,) = (row["citation"] for row in _rows("sources") if row["file"] == OUTCOMES)
    quartiles = zip(("min", "q1", "median", "q3", "max"), WORDS, strict=True)
    columns = [
        SchemaColumn("condition", "VARCHAR", "of the experiment"),
        SchemaColumn("left_first", "BIGINT", "trials in which the left vehicle merged first"),
        SchemaColumn("right_first", "BIGINT", "trials in which the right vehicle merged first"),
        SchemaColumn("collided", "BIGINT", "trials in which boxes overlapped"),
        *(
            SchemaColumn(f"crt_{name}_s", "DOUBLE", f"{word} conflict resolution time")
            for name, word in quartiles
        ),
    ]
    table = SchemaTable("human_outcomes", is_view=False, comment=source, columns=columns)
    return table, DATA / OUTCOMES


def _rows(name: str) -> list[dict[str, str]]:
    with (DATA / f"{name}.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))
