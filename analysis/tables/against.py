"""Our cells beside those that the paper prints, with the difference."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pandas as pd

from analysis.published import citation, published
from analysis.tables.model import Column, Row, Table, Value
from merge_runner.errors import UsageError

PAPER = "paper"
# Table to its published file, and our columns to the file's.
FILES: dict[str, tuple[str, dict[str, str]]] = {
    "who-first": ("paper_who_first", {c: c for c in ("n", "b", "se", "z", "p")}),
    "gap": ("paper_gap", {c: c for c in ("n", "b", "se", "t", "p")}),
    "ablation-qualitative": (
        "paper_ablation_qualitative",
        {**{f"i{i}_paper": f"i{i}" for i in range(1, 6)}, "score_paper": "score"},
    ),
    "ablation-quantitative": (
        "paper_ablation_quantitative",
        {
            "collided_boxes_percent": "collided_percent",
            **{c: c for c in ("collided_percent", "gap_m", "rmse_mps", "joint_percent")},
        },
    ),
}
# Rows of Table V are columns of the files of Tables VI and VII.
INDICATOR_ROWS = {
    **{f"I{i}": ("paper_ablation_qualitative", f"i{i}", PAPER) for i in range(1, 6)},
    "score": ("paper_ablation_qualitative", "score", PAPER),
    **{
        name: ("paper_ablation_quantitative", name, "value")
        for name in ("collided_percent", "gap_m", "rmse_mps", "joint_percent")
    },
    "collided_boxes_percent": ("paper_ablation_quantitative", "collided_percent", "value"),
}
# The rule by which the paper does not count collisions: the other's of humans, and of models.
NOT_PRINTED = {True: "collided_percent", False: "collided_boxes_percent"}


def against(table: Table, reference: str) -> Table:
    """A table with published values and differences; raises UsageError for another reference."""
    if reference != PAPER:
        raise UsageError(f"--against {reference}: valid is {PAPER}")
    if table.name == "indicators":
        columns, rows = _indicators(table)
        files = ["paper_ablation_qualitative", "paper_ablation_quantitative"]
    elif table.name in FILES:
        columns, rows = _beside(table)
        files = [FILES[table.name][0]]
    else:
        return replace(table, notes=(*table.notes, "the paper has no such table"))
    cited = [f"paper: {citation(name)}" for name in files]
    found = any(row.values.get(c.name) is not None for row in rows for c in columns if _added(c))
    absent = [] if found else ["the paper has none of these drivers and variants"]
    return replace(table, columns=columns, rows=rows, notes=(*table.notes, *cited, *absent))


def in_paper(table: Table) -> bool:
    """Whether the paper prints this table."""
    return table.name in {*FILES, "indicators"}


def _beside(table: Table) -> tuple[list[Column], list[Row]]:
    name, pairs = FILES[table.name]
    columns: list[Column] = []
    for column in table.columns:
        columns.append(column)
        if column.name in pairs:
            columns += _columns(column)
    rows = []
    for row in table.rows:
        driver, setting, term = _key(row)
        printed = _row(published(name), driver, setting, term)
        values = dict(row.values)
        for ours, theirs in pairs.items():
            if ours != NOT_PRINTED[driver == "human"]:
                values |= _compared(row, ours, printed, theirs)
        rows.append(replace(row, values=values))
    return columns, rows


def _indicators(table: Table) -> tuple[list[Column], list[Row]]:
    columns: list[Column] = []
    for column in table.columns:
        columns.append(column)
        if column.name in {PAPER, "value"}:
            columns += _columns(column)
    rows = []
    for row in table.rows:
        driver, setting, item = _key(row)
        file, theirs, ours = INDICATOR_ROWS[item]
        printed = _row(published(file), driver, setting, "")
        values = dict(row.values)
        if item != NOT_PRINTED[driver == "human"]:
            values |= _compared(row, ours, printed, theirs)
        rows.append(replace(row, values=values))
    return columns, rows


def _key(row: Row) -> tuple[str, str, str]:
    """Driver, setting and item of a row's id; the humans' mixed models have no counterpart."""
    parts = row.id.split("/")
    if parts[0] == "human":
        return "human", "", "/".join(parts[1:])
    group = row.groups[0]
    driver, _, setting = group.rpartition("/")
    driver = driver.partition(" [")[0].partition("/set")[0]
    return driver, setting, row.id.removeprefix(group).lstrip("/")


def _row(file: pd.DataFrame, driver: str, setting: str, term: str) -> dict[str, Any] | None:
    chosen = file[(file["driver"] == driver) & (file["setting"] == setting)]
    if "term" in file:
        chosen = chosen[chosen["term"] == term]
    return None if chosen.empty else chosen.iloc[0].to_dict()


def _columns(column: Column) -> list[Column]:
    meaning = f"{column.heading} as printed in the paper"
    return [
        Column(f"{column.name}_in_paper", "paper", column.kind, column.digits, meaning, "", True),
        Column(f"{column.name}_difference", "diff.", "number", column.digits, "", "", True),
    ]


def _added(column: Column) -> bool:
    return column.name.endswith("_in_paper")


def _compared(row: Row, name: str, printed: dict[str, Any] | None, theirs: str) -> dict[str, Value]:
    """The paper's value, and the difference unless ours is that very value."""
    if printed is None:
        return {}
    ours, value = row.values.get(name), printed[theirs]
    if isinstance(value, str):  # a column of p-values holds texts like <0.001
        if value.startswith("<"):
            return {f"{name}_in_paper": value}
        value = float(value)
    if isinstance(ours, bool):
        return {f"{name}_in_paper": bool(value)}
    values: dict[str, Value] = {f"{name}_in_paper": value}
    if isinstance(ours, (int, float)) and name not in row.printed:
        values[f"{name}_difference"] = ours - value
    return values
