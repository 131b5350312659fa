"""Where a row of a table comes from: the query, and the trials behind it."""

from __future__ import annotations

import re
from typing import NamedTuple

import duckdb

from merge_runner.paths import DEFAULT_DB
from merge_runner.registry import require
from merge_runner.text_safety import quoted
from merge_runner_analysis.cache import remembered
from merge_runner_analysis.frames import KEYS
from merge_runner_analysis.grouping import Group
from merge_runner_analysis.names import HUMAN
from merge_runner_analysis.published import citation
from merge_runner_analysis.study import Study
from merge_runner_analysis.tables.formats import shown_value
from merge_runner_analysis.tables.model import Column, Row, Table

SEE_NOTES = "see the notes of the table"
ACCOUNTS = "attempts"  # the table that counts repetitions of deterministic drivers, too
# What no column of the database holds: the analysis finds it out of each trial.
FOUND_OUT = re.compile(r"\b(counted_|collided\b|collided_boxes\b)")


class Source(NamedTuple):
    """The trials of one group that a row rests on, and how to list them.

    ``numerator``: those of them that a share or a count counts.
    """

    group: str
    text: str
    query: str = ""
    trials: tuple[str, ...] = ()
    numerator: tuple[str, ...] = ()


class Explanation(NamedTuple):
    """A row or a cell with its values as printed, its meaning and its sources."""

    cell: str
    value: str
    meaning: str
    note: str
    sources: tuple[Source, ...]
    command: str

    def lines(self) -> list[str]:
        """The explanation for a reader; the trials that a value counts come first."""
        lines = [f"{self.cell} = {self.value}", self.meaning]
        if self.note:
            lines.append(f"note: {self.note}")
        for source in self.sources:
            marked = ", marked *" if source.numerator else ""
            lines += ["", f"{source.group}: {source.text}{marked}"]
            if source.query:
                lines.append(f'{self.command} "{source.query}"')
            counted = set(source.numerator)
            lines += [f"* {trial}" for trial in source.trials if trial in counted]
            lines += [f"  {trial}" for trial in source.trials if trial not in counted]
        return lines


def explain(study: Study, table: Table, cell: str) -> Explanation:
    """Explain a ROW of a table, or ``ROW:COLUMN``; raises UsageError."""
    rows = {row.id: row for row in table.rows}
    row_id, _, name = (cell, "", "") if cell in rows else cell.rpartition(":")
    hint = f"`merge-runner tables {table.name} --format csv` shows all rows and columns"
    row = require(rows, f"row of {table.name}", row_id or cell, hint)
    columns = {c.name: c for c in table.columns if name or row.values.get(c.name) is not None}
    column = require(columns, f"column of {table.name}", name) if name else None
    texts = {name: shown_value(c, row.values.get(name)) for name, c in columns.items()}
    return Explanation(
        cell=f"{table.name} {cell}",
        value=texts[name] if name else ", ".join(f"{name} {text}" for name, text in texts.items()),
        meaning=table.heading + (f": {column.meaning or column.heading}" if column else ""),
        note=row.note,
        sources=sources_of(study, table, row, column),
        command=sql_command(study),
    )


def sql_command(study: Study) -> str:
    """How a query is run on a study's database."""
    return "merge-runner sql" + ("" if study.db == DEFAULT_DB else f" --db {study.db}")


def sources_of(
    study: Study, table: Table, row: Row, column: Column | None = None
) -> tuple[Source, ...]:
    """The trials of each group behind a row, and those of them that a share of it counts."""
    if column is not None and column.name.startswith("ceiling"):
        resampled = "data sets resampled from the published counts and regression, not trials"
        return (Source(HUMAN, resampled),)
    known = (*study.groups, *study.asked, *study.unjudged, *study.unjudged_asked)
    groups = [group for group in known if group.id in row.groups]
    if table.name == ACCOUNTS:
        groups = [group.stored for group in groups]
    condition = column.counts if column else ""
    predicate = " AND ".join(filter(None, (row.counts, column.trials if column else "")))
    return tuple(
        _source(study, group, predicate, condition)
        if row.counts and group.measured
        else Source(group.id, f"published, not from traces: {row.note or SEE_NOTES}")
        for group in groups
    )


@remembered
def _source(study: Study, group: Group, predicate: str, condition: str) -> Source:
    rows = _trials(study, group).sql(
        f"SELECT trial_id, {condition or 'NULL'} FROM trials WHERE {predicate} ORDER BY trial_id"  # noqa: S608 # ours
    )
    found = dict(rows.fetchall())
    trials = tuple(found)
    numerator = tuple(trial for trial, counts in found.items() if counts)
    outcomes = group.published_outcomes
    said = (
        f"{len(trials)} of {len(group.trials)} trials; not finished: {group.left_out}",
        group.said,
        f"collisions and who merged first are those of {len(outcomes)} published outcomes: "
        f"{citation('human_outcomes')}"
        if outcomes is not None
        else "",
        f"the value counts {len(numerator)} of them" if condition else "",
    )
    text = "; ".join(filter(None, said))
    return Source(group.id, text, _query(study, group, predicate, trials), trials, numerator)


def _query(study: Study, group: Group, predicate: str, trials: tuple[str, ...]) -> str:
    """The query that lists these trials of a group, which a predicate is true of."""
    if not trials:
        return ""
    specs = ", ".join(map(quoted, sorted(group.trials["spec_hash"].unique())))
    conditions = [f"trials.spec_hash IN ({specs})"]
    if group.setting:
        conditions.append(f"variant = {quoted(group.setting)}")
    # The database does not know mirrored trials by their images either.
    if study.holds_more(group) or group.seats[1] or FOUND_OUT.search(predicate):
        predicate = f"trials.trial_id IN ({', '.join(map(quoted, trials))})"
    conditions.append(predicate)
    return (
        "SELECT trials.trial_id, condition, status, merged_first, "  # noqa: S608 # ours
        "trial_metrics.* EXCLUDE (trial_id, spec_hash) FROM trials "
        f"JOIN trial_metrics USING (trial_id, spec_hash) WHERE {' AND '.join(conditions)} "
        "ORDER BY ALL"
    )


@remembered
def _trials(study: Study, group: Group) -> duckdb.DuckDBPyConnection:
    """A connection in which ``trials`` are those of a group, with what became of their calls."""
    connection = duckdb.connect()
    connection.register("trials", group.trials.merge(study.frames.calls, "left", KEYS))
    return connection
