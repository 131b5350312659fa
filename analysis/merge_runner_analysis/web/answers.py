"""What pages show of the analysis of one state of a database, made once and kept beside it."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import duckdb

from merge_runner.errors import UsageError
from merge_runner.results.database import read_database
from merge_runner.text_safety import first_line
from merge_runner_analysis.cache import digest_of, kept, present_state, stamp_of
from merge_runner_analysis.selection import Selection
from merge_runner_analysis.tables import make_tables
from merge_runner_analysis.tables.model import from_text, to_text

if TYPE_CHECKING:
    from merge_runner_analysis.study import Study

OF = " of"  # behind a column that counts: all of which it counts some
FOUND = 3  # findings of a run that its page shows
Request = tuple[str, ...]
"""``table NAME [SWEEP CONDITION]``, ``comparison GROUP GROUP SWEEP CONDITION``,
``cell TABLE ROW COLUMN SWEEP CONDITION``, ``figure NAME FORM``, ``digest``, ``audit``."""
RUNS = """
SELECT sweep_id, coalesce(exit_code = 0, false) FROM sweeps
ORDER BY started_at DESC, sweep_id DESC
"""


def answer(db: Path, request: Request) -> dict[str, Any]:
    """Return the answer of the database as it is now; raises MergeRunnerError."""
    try:
        return numbers(db, stamp_of(db)).answer(request)
    except duckdb.Error as exc:  # as where the file is replaced while it is read
        raise UsageError(f"{db} cannot be read: {first_line(exc)}") from exc


class Numbers:
    """Answers from one state of a database, whose trials are read once something needs them."""

    def __init__(self, db: Path) -> None:
        self.db = db

    def answer(self, request: Request) -> dict[str, Any]:
        """Return what is asked for, with ``counted``: how many trials the database holds.

        ``absent`` says that no table has a cell. Raises MergeRunnerError.
        """
        match request:
            case ["table", name, *part]:
                found: dict[str, Any] = {"table": self._table(name, *part)}
            case ["comparison", one, other, *part]:
                found = {"table": self._comparison(one, other, *part)}
            case ["cell", table, row, column, *part]:
                found = self._cell(table, row, column, *part)
            case ["figure", name, "svg" | "png" as form]:
                found = {"file": self._figure(name, form), "digest": self._digest}
            case ["digest"]:
                found = {"digest": self._digest}
            case ["audit"]:
                found = {"notes": json.loads(self._kept("audit", self._audit))}
            case _:
                raise UsageError(f"nothing answers {request!r}")
        with read_database(self.db) as connection:
            counted = connection.execute(
                "SELECT count(*) FROM trials WHERE source <> 'first_decision'"
            )
            return {"counted": counted.fetchall()[0][0], **found}

    @cached_property
    def study(self) -> Study:
        """The study, once it is read."""
        from merge_runner_analysis.study import Study

        return Study(self.db)

    @cached_property
    def _state(self) -> str:
        return present_state(self.db)

    @property
    def _digest(self) -> str:
        return digest_of(self.db, self._state)

    def _kept(self, name: str, make: Callable[[], str], options: str = "") -> str:
        return kept(self.db, self._state, options or Selection().key(self.db), name, make)

    def _table(self, name: str, sweep: str = "", condition: str = "") -> str:
        """Return a table of all trials, or of those of a sweep and a condition."""
        part = Selection(sweep=sweep, condition=condition)
        return self._kept(
            name,
            lambda: to_text(make_tables(self._part(part), [name])[0]),
            part.key(self.db),
        )

    def _comparison(self, one: str, other: str, sweep: str = "", condition: str = "") -> str:
        """Return how two drivers differ, each with its prompt, as ``_table`` does."""
        part = Selection(sweep=sweep, condition=condition)

        def make() -> str:
            from merge_runner_analysis.tables.effects import comparison

            return to_text(comparison(self._part(part), one, other))

        return self._kept(f"comparison {one} {other}", make, part.key(self.db))

    def _part(self, selection: Selection) -> Study:
        from merge_runner_analysis.study import Study

        return self.study if selection == Selection() else Study(self.db, selection)

    def _figure(self, name: str, form: Literal["svg", "png"]) -> bytes:
        """Return a figure as a file; one that a report has drawn is that of the report."""

        def draw() -> str:
            from merge_runner_analysis.figures.gallery import rendered

            return base64.b64encode(rendered(self.study, name, form)).decode()

        return base64.b64decode(self._kept(f"{name}.{form}", draw))

    def _audit(self) -> str:
        """Return what the audit of each run found and notes, by its id; nothing is replayed."""
        from merge_runner.audit.checks import audited_database, check_sweep

        told = {}
        with audited_database(self.db) as connection:
            for run, ended in connection.execute(RUNS).fetchall():
                audit = check_sweep(connection, run, (), finished=ended)
                told[run] = [f"found: {one}" for one in audit.findings[:FOUND]] + audit.notes
        return json.dumps(told)

    def _cell(
        self, name: str, row: str, column: str, sweep: str = "", condition: str = ""
    ) -> dict[str, Any]:
        """Return what a cell is and its trials; with OF behind it those that it counts of."""
        from merge_runner_analysis.explain import explain

        table = from_text(self._table(name, sweep, condition))
        study = self._part(Selection(sweep=sweep, condition=condition))
        column, of, _ = column.partition(OF)
        try:
            found = explain(study, table, f"{row}:{column}")
        except UsageError as exc:
            return {"absent": str(exc)}
        counts = not of and any(one.counts for one in table.columns if one.name == column)
        specs = {
            group.id: dict(zip(trials["trial_id"], trials["spec_hash"], strict=True))
            for group in (*study.measured, *study.asked, *study.unjudged, *study.unjudged_asked)
            for trials in [group.stored.trials]
        }
        trials = [
            (trial, specs[source.group][trial])
            for source in found.sources
            for trial in (source.numerator if counts else source.trials)
        ]
        return {"explained": found, "trials": trials}


@lru_cache(1)
def numbers(db: Path, _: tuple[int, ...]) -> Numbers:
    """Return the numbers of a database with a stamp: what was read is read once."""
    return Numbers(db)
