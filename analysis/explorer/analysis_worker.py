"""What the pages show of the analysis, computed in a process of its own.

pandas and the fits hold a Python process for seconds, and no page may wait for another's numbers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from merge_runner.errors import UsageError
from merge_runner.results.database import read_database
from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner_analysis.data.derived_cache import (
    finished,
    keep_finished,
    options_text,
    present_state,
)
from merge_runner_analysis.metrics import GAP, LEFT_FIRST, Metric
from merge_runner_analysis.names import HUMAN
from merge_runner_analysis.tables import make_tables
from merge_runner_analysis.tables.formats import shown_value
from merge_runner_analysis.tables.model import Table, from_text, to_text

if TYPE_CHECKING:
    from merge_runner_analysis.data.study import Group, Study
    from merge_runner_analysis.explain import Source

# The tables that have the rows of groups: of each driver and prompt, or each level of a factor.
VARIANTS, FACTORS = "ablation-quantitative", "factors"


class Numbers:
    """Answers from one database; its trials are read when something needs them, and only once."""

    def __init__(self, db: Path) -> None:
        self.db = db
        self._made: dict[str, Table] = {}

    def answer(self, request: Sequence[str]) -> dict[str, Any]:
        """What is asked for, with ``counted``: how many trials it was made of.

        Where no table has the cell, the answer says so as ``absent``.

        ``study``, which reads it, ``tables NAME...``, ``cell TABLE ROW COLUMN``,
        ``figure NAME``, or ``home FACTOR`` with an empty factor for drivers and prompts; what
        follows the last is ignored. Raises MergeRunnerError.
        """
        match list(request):
            case ["study"]:
                # What the first table is made with.
                import statsmodels.regression.linear_model  # noqa: F401

                return {"groups": len(self.study.groups)}
            case ["tables", *names]:
                return self._tables(names)
            case ["cell", table, row, column]:
                return self._cell(table, row, column)
            case ["home", factor, *_]:
                return self._counted() | home_panels(self.study, factor)
            case ["figure", name]:
                return self._counted() | {"svg": self._figure(name)}
        raise UsageError(f"nothing answers {request!r}")

    @cached_property
    def study(self) -> Study:
        """The study, once it is read."""
        from merge_runner_analysis.data.study import Study

        return Study(self.db)

    def _counted(self) -> dict[str, Any]:
        if "study" in self.__dict__:
            groups = [*self.study.measured, *self.study.unjudged]
            return {"counted": sum(len(group.trials) for group in groups)}
        with read_database(self.db) as connection:
            (row,) = connection.execute(
                "SELECT count(*) FROM trials WHERE source <> 'seat'"
            ).fetchall()
        return {"counted": row[0]}

    def _tables(self, names: Sequence[str]) -> dict[str, Any]:
        found = self._finished(names)
        return self._counted() | {"tables": [to_text(found[name]) for name in names]}

    def _finished(self, names: Sequence[str]) -> dict[str, Table]:
        """Tables by name; those that are kept in the database are not made again."""
        options = options_text(self.db)
        wanted = [name for name in names if name not in self._made]
        kept = finished(self.db, present_state(self.db), options, wanted) if wanted else {}
        self._made |= {name: from_text(text) for name, text in kept.items()}
        if missing := [name for name in wanted if name not in kept]:
            study = self.study
            made = dict(zip(missing, make_tables(study, missing), strict=True))
            # If the state in which the study was read is past, they are not kept.
            texts = {name: to_text(made[name]) for name in missing}
            keep_finished(self.db, study.state, options, texts)
            self._made |= made
        return {name: self._made[name] for name in names}

    def _cell(self, name: str, row_id: str, column_name: str) -> dict[str, Any]:
        from merge_runner_analysis.explain import sources_of, sql_command

        table = self._finished([name])[name]
        rows = {row.id: row for row in table.rows}
        columns = {column.name: column for column in table.columns}
        if row_id not in rows:
            return {"absent": f"the table {name} has no row {row_id!r}"}
        if column_name not in columns:
            return {"absent": f"the table {name} has no column {column_name!r}"}
        row, column = rows[row_id], columns[column_name]
        return self._counted() | {
            "value": shown_value(column, row.values.get(column.name)),
            "heading": table.heading,
            "meaning": column.meaning or column.heading,
            "note": row.note,
            "command": sql_command(self.study),
            "sources": [
                {
                    "group": source.group,
                    "text": source.text,
                    "query": source.query,
                    "trials": self._keys(source, numerator=bool(column.counts)),
                }
                for source in sources_of(self.study, table, row, column)
            ],
        }

    def _figure(self, name: str) -> str:
        from merge_runner_analysis.figures.gallery import rendered

        return rendered(self.study, name, "svg").decode()

    def _keys(self, source: Source, *, numerator: bool) -> list[tuple[str, str]]:
        """The (trial, spec) of a source's trials, or of its ``numerator``."""
        names = source.numerator if numerator else source.trials
        return [(name, self._specs[source.group][name]) for name in names]

    @cached_property
    def _specs(self) -> dict[str, dict[str, str]]:
        """Of each group that has traces the spec of each trial."""
        return {
            group.id: dict(zip(trials["trial_id"], trials["spec_hash"], strict=True))
            for group in (*self.study.measured, *self.study.unjudged)
            for trials in [group.stored.trials]
        }


def home_panels(study: Study, factor: str) -> dict[str, Any]:
    """Who goes first and the gap: of the humans, and every driver and prompt, or every level."""
    from merge_runner_analysis.stats.factors import levels_by_factor

    groups = [group for group in study.groups if group.id == HUMAN]
    shown = [_group_facts(group) for group in groups]
    if factor:
        found = [level for levels in levels_by_factor(study) for level in levels]
        levels = [level for level in found if level.factor == factor]
        groups += [level.pooled for level in levels]
        facts = [
            {"id": level.id, "label": f"{level.name}{level.mark}", "table": FACTORS}
            for level in levels
        ]
        shown += [
            _group_facts(level.pooled) | own for level, own in zip(levels, facts, strict=True)
        ]
    else:
        groups += study.models
        prompts = len({group.setting for group in study.models}) > 1
        shown += [
            _group_facts(group) | ({"label": f"{group.label}, {group.setting}"} if prompts else {})
            for group in study.models
        ]
    return _beside_humans(study, groups, shown, [LEFT_FIRST, GAP])


def _group_facts(group: Group) -> dict[str, Any]:
    """What a page has to know of a group but its numbers; ``table`` holds its rows."""
    return {
        "id": group.id,
        "label": group.label,
        "table": VARIANTS,
        "measured": group.measured,
        "mirrored": bool(group.seats[1]),
    }


def _beside_humans(
    study: Study,
    groups: Sequence[Group],
    facts: Sequence[Mapping[str, Any]],
    metrics: Sequence[Metric],
) -> dict[str, Any]:
    """Groups, measured in each condition by these metrics, with facts of each.

    Values are in the units of the metrics. Before an import the humans have outcomes alone;
    ``published`` holds what is published of the rest, by the metric's name: ``values`` by
    condition, as far as there are such, and a ``text`` that says what they are.
    """
    from merge_runner_analysis.data.reference_data import HUMAN_TRIALS, citation
    from merge_runner_analysis.stats.measures import known, outcomes_note

    there = study.human in study.groups
    unknown = [metric for metric in metrics if not known(study.human, metric)]
    return {
        "measured": study.human.measured,
        "outcomes_from": citation("human_outcomes"),
        "published_trials": HUMAN_TRIALS,
        "published": {metric.name: _published(metric) for metric in unknown} if there else {},
        "conditions": study.conditions,
        "caveat": outcomes_note(study.human) if there else "",
        "groups": [
            {
                **of,
                "conditions": {
                    name: _in_condition(group, name, metrics) for name in study.conditions
                },
            }
            for group, of in zip(groups, facts, strict=True)
        ],
    }


def _in_condition(group: Group, condition: str, metrics: Sequence[Metric]) -> dict[str, Any]:
    """Return the estimates of metrics in one condition, with 95 % intervals, by their names."""
    from merge_runner_analysis.stats.measures import estimate, known

    part = group.part(lambda trials: trials["condition"] == condition)
    return {
        metric.name: asdict(estimate(part, metric)) for metric in metrics if known(group, metric)
    }


def _published(metric: Metric) -> dict[str, Any]:
    """The human values of a metric in each condition, as far as they are published."""
    from merge_runner_analysis.data.reference_data import citation
    from merge_runner_analysis.stats.measures import human_reference, no_human_value

    found = human_reference(metric)
    if found is None:
        return {"text": no_human_value(metric)}
    values, what = dict.fromkeys(HUMAN_CONDITIONS, found.value), "value over all conditions"
    source = found.source
    if metric is GAP:
        values, what, source = _published_gaps(), "regression", citation("paper_gap")
    text = f"{metric.heading}: the black dashes are the published {what} ({source})"
    return {"values": values, "text": text}


def _published_gaps() -> dict[str, float]:
    """The human gap in m that the published regression gives in each condition."""
    import numpy as np

    from merge_runner_analysis.data.reference_data import published
    from merge_runner_analysis.stats.regressions import gap_design

    terms = published("paper_gap").query("driver == 'human'")["b"].to_numpy(float)
    headway = np.array([one.projected_headway_m for one in HUMAN_CONDITIONS.values()])
    velocity = np.array([one.relative_velocity_mps for one in HUMAN_CONDITIONS.values()])
    gaps = gap_design(headway, velocity) @ terms
    return dict(zip(HUMAN_CONDITIONS, map(float, gaps), strict=True))
