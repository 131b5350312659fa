"""Origin of a table's row: the query, and the trials behind it."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import compress
from typing import Any, NamedTuple

import pandas as pd

from merge_runner.paths import DEFAULT_DB, command_at
from merge_runner.registry import require
from merge_runner.text_safety import quoted
from merge_runner_analysis.cache import remembered
from merge_runner_analysis.frames import KEYS
from merge_runner_analysis.grouping import Group
from merge_runner_analysis.metrics import METRICS
from merge_runner_analysis.provenance import call_counts
from merge_runner_analysis.published import HUMAN, citation
from merge_runner_analysis.stats.first_action import (
    KINDS,
    GroupDriver,
    drivers_of,
    first_actions,
)
from merge_runner_analysis.stats.levels import distinct
from merge_runner_analysis.stats.verdicts import hits
from merge_runner_analysis.study import StudyResults
from merge_runner_analysis.tables.formats import shown_value
from merge_runner_analysis.tables.model import COUNTED, ENDED, FINISHED, STORED, Column, Row, Table

QUERY = (
    "SELECT trials.trial_id, condition, status, merged_first, "
    "trial_metrics.* EXCLUDE (trial_id, spec_hash) FROM trials "
    "JOIN trial_metrics USING (trial_id, spec_hash) "
    "WHERE trials.spec_hash IN ({specs}) AND trials.trial_id IN ({trials}) ORDER BY ALL"
)

# Columns with the value of a row's measure, a share if the measure is a rate.
SHARES = ("value", "estimate", "estimate_reference", "value_reference")


class Source(NamedTuple):
    """Trials of a group behind a row; a value that ``counts`` some has them in ``numerator``.

    The query gives the trials that it counts, otherwise all.
    """

    group: str
    text: str
    query: str = ""
    trials: tuple[str, ...] = ()
    numerator: tuple[str, ...] = ()
    counts: bool = False


class Explanation(NamedTuple):
    """A row or a cell with its values as printed, its meaning and its sources."""

    cell: str
    value: str
    meaning: str
    note: str
    sources: tuple[Source, ...]
    command: str

    def lines(self, *, whole: bool = False) -> list[str]:
        """Return the explanation for a reader: the trials that a value counts, ``whole`` all."""
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
            others = [f"  {trial}" for trial in source.trials if trial not in counted]
            hidden = bool(source.numerator) and not whole
            lines += [f"and {len(others)} others: --all"] if hidden and others else others
        return lines


def explain(study: StudyResults, table: Table, cell: str, *, of_all: bool = False) -> Explanation:
    """Explain a ROW of a table, or ``ROW:COLUMN``; raises UsageError.

    ``of_all``: the trials of which a value counts some are meant, its denominator.
    """
    rows = {row.id: row for row in table.rows}
    row_id, _, name = (cell, "", "") if cell in rows else cell.rpartition(":")
    hint = f"`merge-runner tables {table.name} --format csv` shows all rows and columns"
    row = require(rows, f"row of {table.name}", row_id or cell, hint)
    columns = {c.name: c for c in table.columns if name or row.values.get(c.name) is not None}
    column = require(columns, f"column of {table.name}", name) if name else None
    texts = {name: shown_value(c, row) for name, c in columns.items()}
    return Explanation(
        cell=f"{table.name} {cell}",
        value=texts[name] if name else ", ".join(f"{name} {text}" for name, text in texts.items()),
        meaning=table.heading + (f": {column.meaning or column.heading}" if column else ""),
        note=row.note,
        sources=sources_of(study, table, row, column, of_all=of_all),
        command=sql_command(study),
    )


def sql_command(study: StudyResults) -> str:
    """Return the command that runs a query on a study's database."""
    return command_at("merge-runner sql", "--db", study.db, DEFAULT_DB)


def sources_of(
    study: StudyResults,
    table: Table,
    row: Row,
    column: Column | None = None,
    *,
    of_all: bool = False,
) -> tuple[Source, ...]:
    """Return the trials of each group behind a row, and those that a share counts."""
    if column is not None and column.name.startswith("ceiling"):
        resampled = "data sets resampled from the published counts and regression, not trials"
        return (Source(HUMAN, resampled),)
    known = (*study.groups, *study.probes, *study.unjudged, *study.unjudged_probes)
    groups = [group for group in known if group.id in row.groups]
    if column is not None and column.counts == COUNTED and row.values.get(column.name):
        once = (distinct(study, group) for group in groups)
        return tuple(_counted(group, str(row.values["measure"]), of_all=of_all) for group in once)
    rests_on = (column.rests_on if column else "") or row.rests_on
    counts = column.counts if column else ""
    if column and column.name in SHARES and rests_on in _rates():
        counts = rests_on
    counts *= not of_all
    if counts in KINDS and rests_on:
        drivers = [driver for group in groups for driver in drivers_of(group)]
        named = [of for of in drivers if row.id == "/".join(filter(None, (of.group.id, of.side)))]
        return tuple(_first_actions(study, driver, counts) for driver in named)
    sources = []
    for group in groups:
        if rests_on and group.measured:
            rows = group.stored if rests_on == STORED else group
            sources.append(_source(study, rows, rests_on, row.conditions, row.copies, counts))
        else:
            note = row.note or "see the notes of the table"
            sources.append(Source(group.id, f"published, not from traces: {note}"))
    return tuple(sources)


def _rates() -> set[str]:
    """Return the columns of trials whose mean is a share."""
    return {metric.column for metric in METRICS.values() if metric.rate}


def _counted(group: Group, measure: str, *, of_all: bool) -> Source:
    went = hits(group, measure)
    names = group.trials.loc[went.index, "trial_id"]
    trials, numerator = tuple(names), tuple(names[went])
    text = f"{len(trials)} of {len(group.trials)} trials; the value counts {len(numerator)} of them"
    if of_all:
        return Source(group.id, text, _query(group, trials), trials)
    return Source(group.id, text, _query(group, trials, numerator), trials, numerator, counts=True)


def _first_actions(study: StudyResults, driver: GroupDriver, kind: str) -> Source:
    """Return the trials of a driver with a first action of a kind, of those with any."""
    rows = first_actions(study, driver)
    of_kind = rows[KINDS[kind](rows["first_mps2"])]
    trials, counted = (tuple(dict.fromkeys(of["trial_id"])) for of in (rows, of_kind))
    text = (
        f"{len(rows)} first actions in {len(trials)} trials; the value counts {len(of_kind)} of "
        f"them, in {len(counted)} trials"
    )
    query = _query(driver.group, trials, counted)
    return Source(driver.group.id, text, query, trials, counted, counts=True)


@remembered
def _source(
    study: StudyResults,
    group: Group,
    rests_on: str,
    conditions: tuple[str, ...],
    copies: tuple[tuple[str, str], ...],
    counts: str,
) -> Source:
    left_out = {*copies}
    names = {
        place: name
        for place, name, spec, condition in _rows(group, rests_on)
        if (not conditions or condition in conditions) and (name, spec) not in left_out
    }
    trials, numerator = tuple(names.values()), tuple[str, ...]()
    if counts:
        values = group.trials.get(counts)
        if values is None:  # a failure that never occurred has no column
            values = call_counts(study, group).get(counts, pd.Series(False, group.trials.index))
        counted = values.reindex([*names]).fillna(False).astype(bool)
        numerator = tuple(
            name for name, counts_it in zip(trials, counted, strict=True) if counts_it
        )
    outcomes = group.published_outcomes
    parts = (
        f"{len(trials)} of {len(group.trials)} trials; not finished: {group.left_out}",
        group.remark,
        f"collisions and who merged first come from {len(outcomes)} published outcomes: "
        f"{citation('human_outcomes')}"
        if outcomes is not None
        else "",
        f"the value counts {len(numerator)} of them" if counts else "",
    )
    text = "; ".join(filter(None, parts))
    query = _query(group, trials, numerator if counts else None)
    return Source(group.id, text, query, trials, numerator, bool(counts))


@remembered
def _rows(group: Group, rests_on: str) -> list[tuple[Any, str, str, str]]:
    """Return (label, trial, spec, condition) of each trial that rows of a table may rest on."""
    if rests_on in (STORED, ENDED, FINISHED):
        rows = {STORED: group.trials, ENDED: group.ended, FINISHED: group.finished}[rests_on]
        return [*rows[[*KEYS, "condition"]].itertuples(name=None)]
    return [*compress(_rows(group, STORED), group.trials[rests_on].notna())]


def _query(group: Group, trials: Sequence[str], counted: Sequence[str] | None = None) -> str:
    """Return a query of trials, or of those of them that are ``counted``; empty for none."""
    specs = sorted(group.trials["spec_hash"].unique())
    names = trials if counted is None else counted
    named = QUERY.format(specs=", ".join(map(quoted, specs)), trials=", ".join(map(quoted, names)))
    share = "" if counted is None else f"/* {len(counted)} of {len(trials)} trials */ "
    return f"{share}{named}" if names else ""
