"""Removes sweeps from the database; their replies stay in the cache."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import duckdb

from merge_runner.errors import UsageError, unknown_name
from merge_runner.results.comparison import PLACES
from merge_runner.results.database import read_database, write_database
from merge_runner.results.progress_file import running

GOING_SWEEPS = """
CREATE OR REPLACE TEMP TABLE going_sweeps AS
SELECT DISTINCT sweep_id FROM sweeps JOIN (SELECT unnest(?) AS named) ON sweep_id GLOB named
"""
# The trials of these sweeps that no other sweep has.
GOING_TRIALS = """
CREATE OR REPLACE TEMP TABLE going_trials AS
SELECT trial_id, spec_hash FROM sweep_trials SEMI JOIN going_sweeps USING (sweep_id)
EXCEPT
SELECT trial_id, spec_hash FROM sweep_trials ANTI JOIN going_sweeps USING (sweep_id)
"""
# The sweeps and the number of trials that go, and of trials that stay although their sweep goes.
GOING = """
SELECT (SELECT list(sweep_id ORDER BY sweep_id) FROM going_sweeps),
    (SELECT count(*) FROM going_trials), (
        SELECT count(DISTINCT (trial_id, spec_hash)) FROM sweep_trials
        SEMI JOIN going_sweeps USING (sweep_id) ANTI JOIN going_trials USING (trial_id, spec_hash))
"""


@dataclass(frozen=True, slots=True)
class Forgotten:
    """What goes, or went: sweeps by id, numbers of trials, and of trials that other sweeps have."""

    sweeps: tuple[str, ...]
    trials: int
    staying: int

    def __str__(self) -> str:
        """As a part of a sentence."""
        also = f"; {self.staying} trials that other sweeps have, too, stay" if self.staying else ""
        return (
            f"{len(self.sweeps)} sweeps ({', '.join(self.sweeps)}) and {self.trials} trials{also}"
        )


def to_forget(db: Path, sweeps: Sequence[str]) -> Forgotten:
    """Return what ``forget`` would remove; change nothing.

    ``sweeps`` are ids in which * stands for anything. Raises UsageError where one of them names
    nothing, or a sweep into the database is running.
    """
    busy = running(db)
    if busy:
        raise UsageError(
            f"the sweep {busy[0].sweep_id} is running into {db}: stop it, or wait for its end"
        )
    with read_database(db) as connection:
        for pattern in sweeps:
            found = connection.execute(
                "SELECT 1 FROM sweeps WHERE sweep_id GLOB ? LIMIT 1", [pattern]
            )
            if not found.fetchone():
                ids = connection.execute("SELECT sweep_id FROM sweeps ORDER BY ALL").fetchall()
                hint = f"in {db}; * stands for anything"
                raise unknown_name("sweep", pattern, (sweep_id for (sweep_id,) in ids), hint)
        return _mark(connection, sweeps)


def forget(db: Path, sweeps: Sequence[str], agreed: Forgotten) -> Forgotten:
    """Remove sweeps, their trials, and the specs that no trial is left of; see ``to_forget``.

    Raises UsageError where that is not any more what was ``agreed`` to.
    """
    if to_forget(db, sweeps) != agreed:
        raise UsageError(f"{db} has changed meanwhile, and nothing was removed: ask again")
    with write_database(db) as connection:
        gone = _mark(connection, sweeps)
        for table in PLACES:
            connection.execute(
                f"DELETE FROM {table} WHERE (trial_id, spec_hash) IN (FROM going_trials)"  # noqa: S608 # our tables
            )
        for table in ("sweep_trials", "sweeps"):
            connection.execute(f"DELETE FROM {table} WHERE sweep_id IN (FROM going_sweeps)")  # noqa: S608 # our tables
        connection.execute(
            "DELETE FROM specs WHERE spec_hash NOT IN (SELECT spec_hash FROM trials)"
        )
    return gone


def _mark(connection: duckdb.DuckDBPyConnection, sweeps: Sequence[str]) -> Forgotten:
    """Make the tables of what goes, and count that."""
    connection.execute(GOING_SWEEPS, [list(sweeps)])
    connection.execute(GOING_TRIALS)
    ((names, trials, staying),) = connection.execute(GOING).fetchall()
    return Forgotten(tuple(names), trials, staying)
