"""Our values beside those printed in the paper (arXiv 2604.09609), with the differences."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from merge_runner.drivers.registry import MOCKS
from merge_runner_analysis.grouping import Group
from merge_runner_analysis.metrics import shown_in
from merge_runner_analysis.published import HUMAN, citation, printed_value, published
from merge_runner_analysis.study import StudyResults
from merge_runner_analysis.tables.model import Optional, Row, Table, Value
from merge_runner_analysis.wording import INDICATORS

PAPER = "paper"
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


def against(table: Table, study: StudyResults) -> Table:
    """Return a table with published values and differences, for drivers named as in the paper."""
    if table.name not in FILES:
        return replace(table, notes=(*table.notes, "the paper has no such table"))
    paper: dict[Key, dict[str, Value]] = {}
    known = {column.name for column in table.columns}
    for key, name, value in _printed(table.name):
        if name in known:
            paper.setdefault(key, {})[name] = value
    named = {name for values in paper.values() for name in values}
    columns = []
    for column in table.columns:
        columns.append(column)
        if column.name in named:
            meaning = f"{column.heading} as printed in the paper"
            columns += [
                Optional(
                    f"{column.name}_in_paper", "paper", column.kind, meaning, digits=column.digits
                ),
                Optional(f"{column.name}_difference", "diff.", "number", digits=column.digits),
            ]
    groups = {group.id: group for group in (*study.groups, *study.unjudged)}
    rows = [_with_paper(row, groups[row.groups[0]], paper) for row in table.rows]
    notes = [*table.notes, *(f"paper: {citation(name)}" for name in FILES[table.name])]
    return replace(table, columns=columns, rows=rows, notes=notes)


def _printed(table: str) -> Iterator[tuple[Key, str, Value]]:
    if table in {"who-first", "gap"}:
        for row in published(*FILES[table]).to_dict(orient="records"):
            for name in ("n", "b", "se", {"who-first": "z", "gap": "t"}[table], "p"):
                yield (row["driver"], row["setting"], row["term"]), name, printed_value(row[name])
        return
    # A row for each item, or a column.
    items = table == "indicators"
    for row in published(QUALITATIVE).to_dict(orient="records"):
        verdicts: dict[str, Value] = {name: bool(row[name.lower()]) for name in INDICATORS}
        verdicts["score"] = f"{row['score']} of {len(INDICATORS)}"
        for item, value in verdicts.items():
            key = (row["driver"], row["setting"], item if items else "")
            yield key, "paper" if items else f"{item.lower()}_paper", value
    for row in published(QUANTITATIVE).to_dict(orient="records"):
        for metric in shown_in("tables"):
            # The paper judges human collisions by another rule.
            human = row["driver"] == HUMAN
            if column := metric.paper_of_humans if human else metric.paper_of_drivers:
                key = (row["driver"], row["setting"], metric.name if items else "")
                yield key, "value" if items else metric.name, printed_value(row[column])


def _with_paper(row: Row, group: Group, paper: dict[Key, dict[str, Value]]) -> Row:
    """Return the row with the paper's values, and differences unless ours are published."""
    # In each of the paper's rows one model drives both vehicles. Another sample set is still the
    # same driver: it only draws other samples. A mock model poses as none.
    asked, posing = group.models[0], group.scripted and not MOCKS.issuperset(group.models)
    sample_set = "" if group.name == asked else f"/set{group.trials['sample_set'].iloc[0]}"
    if group.unjudged or posing or group.name != asked + sample_set:
        return row
    item = row.id.removeprefix(group.id).lstrip("/")
    values = dict(row.values)
    for name, theirs in paper.get((asked, group.setting, item), {}).items():
        values[f"{name}_in_paper"] = theirs
        ours = None if isinstance(theirs, bool) else values.get(name)
        # A comparison of published values with themselves would test nothing.
        if isinstance(theirs, float | int) and isinstance(ours, float | int) and group.traced:
            values[f"{name}_difference"] = ours - theirs
    return replace(row, values=values)
