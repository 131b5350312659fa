"""Our values beside those printed in the paper (arXiv 2604.09609), with the differences."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pandas as pd

from merge_runner.drivers.registry import MOCKS
from merge_runner.errors import UsageError
from merge_runner_analysis.data.reference_data import citation, published
from merge_runner_analysis.data.study import Group, Study
from merge_runner_analysis.metrics import shown_in
from merge_runner_analysis.names import HUMAN
from merge_runner_analysis.stats.indicators import INDICATORS
from merge_runner_analysis.tables.model import Column, Row, Table, Value

PAPER = "paper"
# The drivers that have rows in the paper.
DRIVERS = ("human", "o3", "gemini-2.5-pro")
METRICS_FILE = "paper_ablation_quantitative"
INDICATORS_FILE = "paper_ablation_qualitative"
# Maps each table to the file of its published values.
FILES = {
    "who-first": "paper_who_first",
    "gap": "paper_gap",
    "ablation-qualitative": INDICATORS_FILE,
    "ablation-quantitative": METRICS_FILE,
}
# Maps our columns to those of the file; for metrics the registry does this (_metric_columns).
COLUMNS = {
    "who-first": {c: c for c in ("n", "b", "se", "z", "p")},
    "gap": {c: c for c in ("n", "b", "se", "t", "p")},
    "ablation-qualitative": {
        **{f"i{i}_paper": f"i{i}" for i in range(1, 6)},
        "score_paper": "score",
    },
}
# Rows of Table V are columns of the files of Tables VI and VII.
INDICATOR_ROWS = {**{f"I{i}": f"i{i}" for i in range(1, 6)}, "score": "score"}


def placed(table: Table, study: Study) -> Table:
    """The table, each of whose rows now names the paper's driver to compare it with.

    That is the driver of exactly the same name, provided that no stand-in answered for it.
    """
    if not in_paper(table):
        return table
    known = {group.id: group for group in (*study.groups, *study.unjudged)}
    return replace(table, rows=[_placed(row, known[row.groups[0]]) for row in table.rows])


def _placed(row: Row, group: Group) -> Row:
    # In each of the paper's rows one model drives both vehicles. Another sample set is still the
    # same driver: it only draws other samples.
    (asked, *others) = group.models
    sample_set = "" if group.name == asked else f"/set{group.trials['sample_set'].iloc[0]}"
    apart = group.scripted or group.unjudged
    own = not others and group.name == asked + sample_set and not apart
    # A mock model under its own name misleads nobody.
    posing = group.scripted and not MOCKS.issuperset(group.models)
    return replace(
        row,
        beside=asked if own and asked in DRIVERS else "",
        stand_in_for=group.models if posing else (),
        # A comparison of published values with themselves would test nothing.
        printed=not group.measured or group.published_outcomes is not None,
    )


def against(table: Table, reference: str, driver: str | None = None) -> Table:
    """A table with published values and differences.

    Each row is compared with the paper's row of the same name. With ``driver``, the rows of all
    drivers are compared with that driver's, except for stand-ins that answered in its name. Raises
    UsageError for any other reference, and for a driver that is not in the paper.
    """
    if reference != PAPER:
        raise UsageError(f"--against {reference}: valid is {PAPER}")
    if driver is not None and driver not in DRIVERS:
        raise UsageError(f"--as {driver}: the paper has {', '.join(DRIVERS)}")
    if table.name == "indicators":
        columns, rows = _indicators(table, driver)
        files = [INDICATORS_FILE, METRICS_FILE]
    elif table.name in FILES:
        columns, rows = _beside(table, driver)
        files = [FILES[table.name]]
    else:
        return replace(table, notes=(*table.notes, "the paper has no such table"))
    cited = [f"paper: {citation(name)}" for name in files]
    found = any(row.values.get(c.name) is not None for row in rows for c in columns if _added(c))
    absent = [] if found else ["the paper has none of these drivers and variants"]
    notes = (*table.notes, *cited, *_placements(table, driver), *absent)
    return replace(table, columns=columns, rows=rows, notes=notes)


def _placements(table: Table, driver: str | None) -> list[str]:
    """Notes on rows that are compared with another driver's, and on those kept from comparison."""
    names = [name for name in DRIVERS if driver in {None, name}]
    kept_off = [
        (row.values["driver"], name)
        for row in table.rows
        for name in names
        if name in row.stand_in_for
    ]
    return [
        *([] if driver is None else [f"every driver stands beside the paper's {driver}"]),
        *(
            f"{label} does not stand beside the paper's {name}"
            for label, name in dict(kept_off).items()
        ),
    ]


def in_paper(table: Table) -> bool:
    """Whether the paper prints this table."""
    return table.name in {*FILES, "indicators"}


def _beside(table: Table, named: str | None) -> tuple[list[Column], list[Row]]:
    of_humans, of_drivers = _theirs(table.name, HUMAN), _theirs(table.name, "")
    columns: list[Column] = []
    for column in table.columns:
        columns.append(column)
        if column.name in of_humans | of_drivers:
            columns += _columns(column)
    rows = []
    for row in table.rows:
        driver, setting, term = _key(row, named)
        printed = _row(published(FILES[table.name]), driver, setting, term)
        values = dict(row.values)
        pairs = of_humans if driver == HUMAN else of_drivers
        for ours, theirs in pairs.items():
            values |= _compared(row, ours, printed, theirs)
        rows.append(replace(row, values=values))
    return columns, rows


def _indicators(table: Table, named: str | None) -> tuple[list[Column], list[Row]]:
    columns: list[Column] = []
    for column in table.columns:
        columns.append(column)
        if column.name in {PAPER, "value"}:
            columns += _columns(column)
    rows = []
    for row in table.rows:
        driver, setting, item = _key(row, named)
        values = dict(row.values)
        if item in INDICATOR_ROWS:
            printed = _row(published(INDICATORS_FILE), driver, setting, "")
            # The paper prints verdicts by its own rule, so the robust ones have no counterpart.
            values |= _compared(row, PAPER, printed, INDICATOR_ROWS[item])
        elif theirs := _metric_columns(driver).get(item):
            printed = _row(published(METRICS_FILE), driver, setting, "")
            values |= _compared(row, "value", printed, theirs)
        rows.append(replace(row, values=values))
    return columns, rows


def _theirs(table: str, driver: str) -> dict[str, str]:
    """Maps our columns to the columns that the paper fills in for a driver."""
    return COLUMNS.get(table) or _metric_columns(driver)


def _metric_columns(driver: str) -> dict[str, str]:
    """Maps metrics to columns of the file: the paper judges human collisions by another rule."""
    columns = {
        one.name: one.paper_of_humans if driver == HUMAN else one.paper_of_drivers
        for one in shown_in("tables")
    }
    return {name: column for name, column in columns.items() if column}


def _key(row: Row, named: str | None) -> tuple[str, str, str]:
    """The driver, setting and item under which to look a row up in the paper's files.

    The rows of mixed models have no counterpart there.
    """
    group = row.groups[0]
    item = row.id.removeprefix(group).lstrip("/")
    driver = row.beside
    if named is not None and driver != HUMAN:
        driver = "" if named in row.stand_in_for else named
    # The humans had no prompt, and hence no setting in the file.
    return driver, "" if driver == HUMAN else group.rpartition("/")[2], item


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
    """The paper's value, and the difference unless ours rests on published values."""
    if printed is None:
        return {}
    ours, value = row.values.get(name), printed[theirs]
    if isinstance(value, str):  # p-values; some are printed as a bound, which has no difference
        if value.startswith("<"):
            return {f"{name}_in_paper": value}
        value = float(value)
    # Scores and verdicts are shown beside ours without a difference.
    if theirs == "score":
        return {f"{name}_in_paper": f"{value} of {len(INDICATORS)}"}
    if theirs.upper() in INDICATORS:
        return {f"{name}_in_paper": bool(value)}
    values: dict[str, Value] = {f"{name}_in_paper": value}
    if isinstance(ours, (int, float)) and not row.printed:
        values[f"{name}_difference"] = ours - value
    return values
