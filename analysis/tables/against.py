"""Our values beside those printed in the paper (arXiv 2604.09609), with the differences."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TypeGuard

from merge_runner.drivers.registry import MOCKS
from merge_runner.errors import UsageError
from merge_runner_analysis.data.reference_data import citation, printed_value, published
from merge_runner_analysis.data.study import Group, Study
from merge_runner_analysis.metrics import shown_in
from merge_runner_analysis.names import HUMAN
from merge_runner_analysis.stats.indicators import INDICATORS
from merge_runner_analysis.tables.model import Column, Row, Table, Value

PAPER = "paper"
# The drivers that have rows in the paper.
DRIVERS = ("human", "o3", "gemini-2.5-pro")
# The files of the tables that the paper prints. Table V has values of Tables VI and VII.
QUALITATIVE, QUANTITATIVE = "paper_ablation_qualitative", "paper_ablation_quantitative"
FILES = {
    "who-first": ("paper_who_first",),
    "gap": ("paper_gap",),
    "indicators": (QUALITATIVE, QUANTITATIVE),
    "ablation-qualitative": (QUALITATIVE,),
    "ablation-quantitative": (QUANTITATIVE,),
}
# Driver, setting and item, the rest of a row's id.
Key = tuple[str, str, str]


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
    own = asked in DRIVERS and not others and group.name == asked + sample_set
    beside = asked if own and not group.unjudged else ""
    # A mock model under its own name misleads nobody.
    posing = group.scripted and not MOCKS.issuperset(group.models)
    # A comparison of published values with themselves would test nothing.
    printed = not group.measured or group.published_outcomes is not None
    return replace(row, beside=None if posing else beside, printed=printed)


def against(table: Table, reference: str, driver: str | None = None) -> Table:
    """A table with published values and differences.

    Each row is compared with the paper's row of the same name. With ``driver``, the rows of all
    drivers are compared with that driver's, except for stand-ins that answered in a model's name.
    Raises UsageError for any other reference, and for a driver that is not in the paper.
    """
    if reference != PAPER:
        raise UsageError(f"--against {reference}: valid is {PAPER}")
    if driver is not None and driver not in DRIVERS:
        raise UsageError(f"--as {driver}: the paper has {', '.join(DRIVERS)}")
    if not in_paper(table):
        return replace(table, notes=(*table.notes, "the paper has no such table"))
    paper = _paper(table.name)
    named = {column for values in paper.values() for column in values}
    columns = [
        added
        for column in table.columns
        for added in (column, *(_columns(column) if column.name in named else ()))
    ]
    found = [paper.get(_key(row, driver), {}) for row in table.rows]
    notes = [
        *table.notes,
        *(f"paper: {citation(name)}" for name in FILES[table.name]),
        *([] if driver is None else [f"every driver stands beside the paper's {driver}"]),
        *([] if any(found) else ["the paper has none of these drivers and variants"]),
    ]
    rows = [_beside(row, values) for row, values in zip(table.rows, found, strict=True)]
    return replace(table, columns=columns, rows=rows, notes=notes)


def in_paper(table: Table) -> bool:
    """Whether the paper prints this table."""
    return table.name in FILES


def _paper(table: str) -> dict[Key, dict[str, Value]]:
    """The values that the paper prints, by row, and by our column."""
    if table in {"who-first", "gap"}:
        rows = published(*FILES[table]).to_dict(orient="records")
        columns = ("n", "b", "se", {"who-first": "z", "gap": "t"}[table], "p")
        return {
            (row["driver"], row["setting"], row["term"]): {
                c: printed_value(row[c]) for c in columns
            }
            for row in rows
        }
    verdicts, measures = _verdicts(), _measures()
    if table == "ablation-quantitative":
        return {(*key, ""): values for key, values in measures.items()}
    if table == "ablation-qualitative":
        return {
            (*key, ""): {f"{item.lower()}_paper": value for item, value in values.items()}
            for key, values in verdicts.items()
        }
    return {
        (*key, item): {column: value}
        for column, found in (("paper", verdicts), ("value", measures))
        for key, values in found.items()
        for item, value in values.items()
    }


def _verdicts() -> dict[tuple[str, str], dict[str, Value]]:
    """By driver and setting the verdicts by the paper's rule; robust ones have no counterpart."""
    return {
        (row["driver"], row["setting"]): {
            **{name: bool(row[name.lower()]) for name in INDICATORS},
            "score": f"{row['score']} of {len(INDICATORS)}",
        }
        for row in published(QUALITATIVE).to_dict(orient="records")
    }


def _measures() -> dict[tuple[str, str], dict[str, Value]]:
    """By driver and setting the metrics: the paper judges human collisions by another rule."""
    found: dict[tuple[str, str], dict[str, Value]] = {}
    for row in published(QUANTITATIVE).to_dict(orient="records"):
        values = found[row["driver"], row["setting"]] = {}
        for metric in shown_in("tables"):
            human = row["driver"] == HUMAN
            if column := metric.paper_of_humans if human else metric.paper_of_drivers:
                values[metric.name] = printed_value(row[column])
    return found


def _key(row: Row, named: str | None) -> Key:
    """The driver, setting and item under which to look a row up.

    The rows of mixed models have no counterpart there.
    """
    group = row.groups[0]
    driver = row.beside or ""
    if named is not None and row.beside not in {None, HUMAN}:
        driver = named
    # The humans had no prompt, and hence no setting in the file.
    setting = "" if driver == HUMAN else group.rpartition("/")[2]
    return driver, setting, row.id.removeprefix(group).lstrip("/")


def _columns(column: Column) -> tuple[Column, Column]:
    meaning = f"{column.heading} as printed in the paper"
    kind, digits = column.kind, column.digits
    return (
        Column(f"{column.name}_in_paper", "paper", kind, digits, meaning, optional=True),
        Column(f"{column.name}_difference", "diff.", "number", digits, optional=True),
    )


def _beside(row: Row, printed: Mapping[str, Value]) -> Row:
    """The row with the paper's values, and the differences of numbers unless ours are published."""
    values = dict(row.values)
    for name, theirs in printed.items():
        values[f"{name}_in_paper"] = theirs
        ours = values.get(name)
        if _is_number(ours) and _is_number(theirs) and not row.printed:
            values[f"{name}_difference"] = ours - theirs
    return replace(row, values=values)


def _is_number(value: Value) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool)
