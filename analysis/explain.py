"""Where a cell of a table comes from: what it means, the query, and the trials behind it."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache

import duckdb

from merge_runner.errors import unknown_name
from merge_runner.paths import DEFAULT_DB
from merge_runner.text_safety import quoted
from merge_runner_analysis.data.reference_data import citation
from merge_runner_analysis.data.study import Group, Study, of_group
from merge_runner_analysis.metrics import JUDGED, METRICS
from merge_runner_analysis.tables.formats import shown_value
from merge_runner_analysis.tables.model import Column, Row, Table, Value

ACCOUNTS = "attempts"  # the table that counts repetitions of deterministic drivers, too


@dataclass(frozen=True, slots=True)
class Source:
    """The trials of one group that a cell rests on, and how to list them.

    ``numerator``: those of them that a share counts.
    """

    group: str
    text: str
    query: str
    trials: tuple[str, ...]
    numerator: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Explanation:
    """A cell with its value as printed, its meaning and its sources."""

    cell: str
    value: str
    meaning: str
    note: str
    sources: tuple[Source, ...]
    command: str

    def lines(self) -> list[str]:
        """The explanation for a reader."""
        lines = [f"{self.cell} = {self.value}", self.meaning]
        if self.note:
            lines.append(f"note: {self.note}")
        for source in self.sources:
            marked = ", marked *" if source.numerator else ""
            lines += ["", f"{source.group}: {source.text}{marked}"]
            if source.query:
                lines.append(f'{self.command} "{source.query}"')
            counted = set(source.numerator)
            lines += [f"{'*' if trial in counted else ' '} {trial}" for trial in source.trials]
        return lines


def explain(study: Study, table: Table, cell: str) -> Explanation:
    """Explain ``ROW:COLUMN`` of a table, or a whole ROW; raises UsageError."""
    row_id, _, column_name = cell.rpartition(":")
    if not row_id or any(row.id == cell for row in table.rows):
        row_id, column_name = cell, ""
    row = _find(table, row_id)
    column = _column(table, row, column_name) if column_name else None
    value: Value = row.values.get(column.name) if column else None
    return Explanation(
        cell=f"{table.name} {cell}",
        value=shown_value(column, value) if column else _whole_row(table, row),
        meaning=f"{table.heading}" + (f": {column.meaning or column.heading}" if column else ""),
        note=row.note,
        sources=sources_of(study, table, row, column),
        command=sql_command(study),
    )


RESAMPLED = Source(
    "human", "data sets resampled from the published counts and regression, not trials", "", ()
)


def sql_command(study: Study) -> str:
    """How a query is run on a study's database."""
    return "merge-runner sql" + ("" if study.db == DEFAULT_DB else f" --db {study.db}")


def sources_of(study: Study, table: Table, row: Row, column: Column | None) -> tuple[Source, ...]:
    """The trials of each group behind a cell, or behind a row where no column is named."""
    if column is not None and column.name.startswith("ceiling"):
        return (RESAMPLED,)
    predicate = row.counts or _predicate(table, column)
    whose = {"own": row.groups, "reference": row.references, "both": (*row.groups, *row.references)}
    groups = row.groups if column is None or not row.references else whose[column.of]
    known = (*study.groups, *study.asked, *study.unjudged, *study.unjudged_asked)
    if table.name == ACCOUNTS:
        known = tuple(group.stored for group in known)
    return tuple(
        _published(group, row, column)
        or (
            _source(study, group, predicate)
            if group.measured or not row.note
            else Source(group.id, f"published: {row.note}", "", ())
        )
        for group in known
        if group.id in groups
    )


def _published(group: Group, row: Row, column: Column | None) -> Source | None:
    """The source of a human value that stays the published one after a part of an import."""
    if group.setting or column is None or column.name not in row.published:
        return None
    if row.cited:
        return Source(group.id, f"published, not from traces: {citation(row.cited)}", "", ())
    if group.published_outcomes is None:
        return None
    text = f"{len(group.published_outcomes)} published outcomes: {citation('human_outcomes')}"
    return Source(group.id, text, "", ())


def query_of(group: Group, predicate: str) -> str:
    """The query that lists the trials of a group which a value rests on, with their measures."""
    for metric in METRICS.values():
        # A predicate may name the column of a metric, which no table of the database has.
        if not re.search(named := rf"\b{metric.counts}", predicate):
            continue
        judged = metric.value in JUDGED
        stored = _decided(group, metric.column) if judged else metric.counts_in_database
        predicate = re.sub(named, stored.replace("\\", r"\\"), predicate)
    variant = f" AND variant = '{group.setting}'" if group.setting else ""
    narrowed = f" AND {group.narrowed}" if group.narrowed else ""
    return (
        "SELECT trials.trial_id, condition, status, merged_first, "  # noqa: S608 # ours
        "trial_metrics.* EXCLUDE (trial_id, spec_hash) FROM trials "
        "JOIN trial_metrics USING (trial_id, spec_hash) "
        f"WHERE trials.spec_hash {_among(group)}{variant}{narrowed} AND {predicate} "
        "ORDER BY ALL"
    )


def _among(group: Group) -> str:
    """Which specs its trials have: several where mean speeds differ, or drivers change sides."""
    names = [quoted(name) for name in sorted(group.trials["spec_hash"].unique())]
    return f"IN ({', '.join(names)})" if len(names) > 1 else f"= '{group.spec_hash}'"


def _decided(group: Group, column: str) -> str:
    """Which trials are known to have collided or not, as the database can tell them."""
    left_open = group.ended.loc[group.ended[column].isna(), "trial_id"]
    names = ", ".join(map(quoted, left_open))
    return "status <> 'failed'" + (f" AND trials.trial_id NOT IN ({names})" if names else "")


@cache
def _source(study: Study, group: Group, predicate: str) -> Source:
    if group.spec_hash is None:
        text = f"published, not from traces: {citation('human_outcomes')}; see the table's notes"
        return Source(group.id, text, "", ())
    share = next((m for m in METRICS.values() if m.rate and m.counts in predicate), None)
    counted = share.column if share else "NULL"
    rows = _tables(study, group).sql(
        f"SELECT trial_id, {counted} FROM trials WHERE {predicate} ORDER BY trial_id"  # noqa: S608 # ours
    )
    found = dict(rows.fetchall())
    trials = tuple(found)
    numerator = tuple(trial for trial, counts in found.items() if counts)
    if group.seats[1] and trials:  # the database does not know mirrored trials by their images
        predicate = f"trials.trial_id IN ({', '.join(map(quoted, trials))})"
    query = query_of(group, predicate)
    text = f"{len(trials)} of {len(group.trials)} trials; not finished: {group.left_out}"
    if group.said:
        text += f"; {group.said}"
    if share:
        text += f"; the share counts {len(numerator)} of them"
    return Source(group.id, text, query, trials, numerator)


@cache
def _tables(study: Study, group: Group) -> duckdb.DuckDBPyConnection:
    """A group's trials, attempts and decisions as tables, for predicates in SQL."""
    connection = _database().cursor()
    for name, frame in (
        ("trials", group.trials),
        ("attempts", of_group(study.calls.attempts, group, group.trials)),
        ("decisions", of_group(study.calls.decisions, group, group.trials)),
    ):
        connection.register("frame", frame)
        connection.execute(f"CREATE TEMP TABLE {name} AS FROM frame")
    return connection


@cache
def _database() -> duckdb.DuckDBPyConnection:
    """One for all groups: what a cursor registers is its own."""
    return duckdb.connect()


def _find(table: Table, row_id: str) -> Row:
    for row in table.rows:
        if row.id == row_id:
            return row
    hint = f"`merge-runner tables {table.name} --format csv` shows all rows and columns"
    raise unknown_name(f"row of {table.name}", row_id, (row.id for row in table.rows), hint)


def _column(table: Table, row: Row, name: str) -> Column:
    for column in table.columns:
        if column.name == name:
            return column
    valid = (c.name for c in table.columns if row.values.get(c.name) is not None)
    raise unknown_name(f"column of {table.name}", name, valid)


def _predicate(table: Table, column: Column | None) -> str:
    chosen = column or next((c for c in table.columns if c.name == "n"), table.columns[-1])
    return chosen.counts if chosen.counts else "true"


def _whole_row(table: Table, row: Row) -> str:
    return ", ".join(
        f"{column.name} {shown_value(column, row.values[column.name])}"
        for column in table.columns
        if row.values.get(column.name) is not None
    )
