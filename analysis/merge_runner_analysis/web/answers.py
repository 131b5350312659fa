"""Analysis results for the pages, from one state of a database: computed once, then cached."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable
from functools import cached_property, lru_cache
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from merge_runner.errors import UsageError
from merge_runner.results.database import read_database
from merge_runner_analysis.cache import cached, digest_of, finished, present_state, stamp_of
from merge_runner_analysis.selection import Selection
from merge_runner_analysis.tables import make_tables
from merge_runner_analysis.tables.formats import shown_value
from merge_runner_analysis.tables.model import Column, Table, from_text, to_text
from merge_runner_analysis.web.reading import readable
from merge_runner_analysis.wording import MEASURES

if TYPE_CHECKING:
    from merge_runner_analysis.study import StudyResults

OF = " of"  # behind a column that counts: all of which it counts some
FOUND = 3  # findings of a run that its page shows
COUNT = "trials"  # by this name the number of trials is cached
TABLE_REQUESTS = {"table": 1, "comparison": 2}  # requests of tables, and how many names they have
Request = tuple[str, ...]
"""``table NAME [SWEEP CONDITION]``, ``comparison GROUP GROUP SWEEP CONDITION``,
``cell TABLE ROW COLUMN SWEEP CONDITION``, ``figure NAME FORM``, ``digest``, ``audit``."""
TRIALS = "SELECT count(*) FROM trials WHERE source <> 'first_decision'"
RUNS = """
SELECT sweep_id, coalesce(exit_code = 0, false) FROM sweeps
ORDER BY started_at DESC, sweep_id DESC
"""


def answer(db: Path, request: Request) -> dict[str, Any]:
    """Return the answer of the database as it is now; raises MergeRunnerError."""
    with readable(db):
        return numbers(db, stamp_of(db)).answer(request)


def cached_answer(db: Path, request: Request) -> dict[str, Any] | None:
    """Return a table that is kept beside the database, at once; None where it is not."""
    if request[0] not in TABLE_REQUESTS:
        return None
    (name, selection), state = _cache_key(*request), present_state(db)
    tables = finished(db, state, selection.key(db), [name])
    counts = finished(db, state, "", [COUNT])
    if not tables or not counts:
        return None
    return {"counted": int(counts[COUNT]), "table": tables[name]}


def _cache_key(kind: str, *named: str) -> tuple[str, Selection]:
    """Return the name of a requested table in the file of finished ones, and its trials."""
    names, part = named[: TABLE_REQUESTS[kind]], named[TABLE_REQUESTS[kind] :]
    sweep, condition = part or ("", "")
    name = names[0] if kind == "table" else " ".join((kind, *names))
    return name, Selection(sweep=sweep, condition=condition)


class Numbers:
    """Answers from one state of a database, whose trials are read once something needs them."""

    def __init__(self, db: Path) -> None:
        self.db = db

    def answer(self, request: Request) -> dict[str, Any]:
        """Return what is asked for, with ``counted``: how many trials the database holds.

        ``absent`` says that no table has a cell. Raises MergeRunnerError.
        """
        match request:
            case ["table" | "comparison", *_]:
                result: dict[str, Any] = {"table": self._table(*request)}
            case ["cell", table, row, column, *part]:
                result = self._cell(table, row, column, *part)
            case ["figure", name, "svg" | "png" as form]:
                digest = digest_of(self.db, self._state)
                result = {"file": self._figure(name, form), "digest": digest}
            case ["digest"]:
                result = {"digest": digest_of(self.db, self._state)}
            case ["audit"]:
                result = {"notes": json.loads(self._cached("audit", self._audit))}
            case _:
                raise UsageError(f"nothing answers {request!r}")
        return {"counted": int(cached(self.db, self._state, "", COUNT, self._count)), **result}

    def _count(self) -> str:
        with read_database(self.db) as connection:
            return str(connection.execute(TRIALS).fetchall()[0][0])

    @cached_property
    def study(self) -> StudyResults:
        """The study, once it is read."""
        from merge_runner_analysis.study import StudyResults

        return StudyResults(self.db)

    @cached_property
    def _state(self) -> str:
        return present_state(self.db)

    def _cached(self, name: str, make: Callable[[], str], options: str = "") -> str:
        return cached(self.db, self._state, options or Selection().key(self.db), name, make)

    def _table(self, kind: str, *named: str) -> str:
        name, selection = _cache_key(kind, *named)

        def make() -> str:
            from merge_runner_analysis.tables.comparison import comparison

            study = self._part(selection)
            if kind == "comparison":
                return to_text(comparison(study, *named[:2]))
            return to_text(make_tables(study, [name])[0])

        return self._cached(name, make, selection.key(self.db))

    def _part(self, selection: Selection) -> StudyResults:
        from merge_runner_analysis.study import StudyResults

        return self.study if selection == Selection() else StudyResults(self.db, selection)

    def _figure(self, name: str, form: Literal["svg", "png"]) -> bytes:
        """Return a figure as a file, the report's if a report has drawn it."""

        def draw() -> str:
            from merge_runner_analysis.figures.gallery import rendered

            return base64.b64encode(rendered(self.study, name, form)).decode()

        return base64.b64decode(self._cached(f"{name}.{form}", draw))

    def _audit(self) -> str:
        """Return findings and notes of the audit by run id, as JSON; nothing is replayed."""
        from merge_runner.audit.checks import audited_database, check_sweep

        notes = {}
        with audited_database(self.db) as connection:
            for run, ended in connection.execute(RUNS).fetchall():
                audit = check_sweep(connection, run, (), finished=ended)
                findings = [
                    f"The audit found “{finding.kind}” in {finding.where or run}: {finding.text}"
                    for finding in audit.findings[:FOUND]
                ]
                notes[run] = [*findings, *(f"The audit: {note}" for note in audit.notes)]
        return json.dumps(notes)

    def _cell(self, name: str, row: str, column: str, *part: str) -> dict[str, Any]:
        """Return a cell's explanation and trials; a column that ends in OF has its denominator."""
        from merge_runner_analysis.explain import explain

        table = from_text(self._table("table", name, *part))
        study = self._part(_cache_key("table", name, *part)[1])
        column, of, _ = column.partition(OF)
        try:
            explained = explain(study, table, f"{row}:{column}", of_all=bool(of))
        except UsageError as exc:
            return {"absent": str(exc)}
        specs = {
            group.id: dict(zip(trials["trial_id"], trials["spec_hash"], strict=True))
            for group in (*study.measured, *study.probes, *study.unjudged, *study.unjudged_probes)
            for trials in [group.stored.trials]
        }
        trials = [
            (trial, specs[source.group][trial])
            for source in explained.sources
            for trial in (source.numerator if source.counts else source.trials)
        ]
        title = _title(table, row, next(of for of in table.columns if of.name == column))
        return {"explained": explained, "trials": trials, "title": title}


def _title(table: Table, row_id: str, column: Column) -> str:
    """Return a cell in words: ``o3, baseline, crashes: trials that collided``."""
    row = next(row for row in table.rows if row.id == row_id)
    heads = takewhile(lambda of: of.kind == "text", table.columns)
    names = [shown_value(of, row) for of in heads if of.name != "kind"]
    labels = (MEASURES[name].label if name in MEASURES else name for name in names)
    return f"{', '.join(filter(None, labels))}: {column.meaning or column.heading}"


@lru_cache(1)
def numbers(db: Path, _: tuple[int, ...]) -> Numbers:
    """Return the numbers of a database with this stamp, from memory after the first call."""
    return Numbers(db)
