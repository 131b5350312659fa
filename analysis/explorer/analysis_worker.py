"""What the pages show of the analysis, computed in a process of its own.

pandas and the fits hold a Python process for seconds, and no page may wait for another's numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from merge_runner.errors import UsageError
from merge_runner.results.database import read_database
from merge_runner_analysis.data.derived_cache import (
    finished,
    keep_finished,
    options_text,
    present_state,
)
from merge_runner_analysis.tables import make_tables
from merge_runner_analysis.tables.formats import shown_value
from merge_runner_analysis.tables.model import Table, from_text, to_text
from merge_runner_analysis.verdict_words import TABLE as VERDICTS

if TYPE_CHECKING:
    from merge_runner_analysis.data.study import Study
    from merge_runner_analysis.explain import Source


class Numbers:
    """Answers from one database; its trials are read when something needs them, and only once."""

    def __init__(self, db: Path) -> None:
        self.db = db
        self._made: dict[str, Table] = {}

    def answer(self, request: Sequence[str]) -> dict[str, Any]:
        """What is asked for, with ``counted``: how many trials it was made of.

        Where no table has the cell, the answer says so as ``absent``.

        ``study``, which reads it, ``tables NAME...``, ``cell TABLE ROW COLUMN``, ``figure NAME
        FORM``,
        or ``verdicts SWEEP CONDITION``, of all where these are empty. Raises MergeRunnerError.
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
            case ["verdicts", sweep, condition]:
                return self._verdicts(sweep, condition)
            case ["figure", name, "svg" | "png" as form]:
                from merge_runner_analysis.figures.gallery import rendered

                file = rendered(self.study, name, form)
                return self._counted() | {"file": file, "digest": self._digest}
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

    def _verdicts(self, sweep: str, condition: str) -> dict[str, Any]:
        """The table ``verdicts`` of a part of the trials."""
        if not sweep and not condition:
            return self._tables([VERDICTS])
        options = options_text(self.db, sweep=sweep, condition=condition)
        kept = finished(self.db, present_state(self.db), options, [VERDICTS])
        if not kept:
            from merge_runner_analysis.data.study import Study

            study = Study(self.db, sweep=sweep, condition=condition)
            kept = {VERDICTS: to_text(make_tables(study, [VERDICTS])[0])}
            keep_finished(self.db, study.state, options, kept)
        return self._counted() | {"tables": [kept[VERDICTS]]}

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

    @cached_property
    def _digest(self) -> str:
        from merge_runner.results.store import results_digest

        return results_digest(self.db)[0]

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
