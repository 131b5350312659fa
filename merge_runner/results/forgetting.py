"""Removes sweeps from the database; their replies stay in the cache."""

from __future__ import annotations

from collections.abc import Sequence
from fnmatch import fnmatchcase
from pathlib import Path

from merge_runner.errors import UsageError, unknown_name
from merge_runner.results.comparison import PLACES
from merge_runner.results.database import read_database, write_database
from merge_runner.results.progress_file import running

# The trials of some sweeps; those that other sweeps have, too, stay.
GOING = """
CREATE OR REPLACE TEMP TABLE going AS
SELECT trial_id, spec_hash, bool_and(list_contains($ids, sweep_id)) AS goes FROM sweep_trials
GROUP BY ALL HAVING bool_or(list_contains($ids, sweep_id))
"""


def to_forget(db: Path, patterns: Sequence[str]) -> tuple[list[str], str]:
    """Return the ids of the sweeps to forget, in which * stands for anything, and all that goes.

    Raises UsageError where a pattern names nothing, or a sweep into the database is running.
    """
    for busy in running(db):
        raise UsageError(
            f"the sweep {busy.sweep_id} is running into {db}: stop it, or wait for its end"
        )
    with read_database(db) as connection:
        rows = connection.execute("SELECT sweep_id FROM sweeps ORDER BY ALL").fetchall()
        known, ids = [sweep_id for (sweep_id,) in rows], []
        for pattern in patterns:
            matching = [sweep_id for sweep_id in known if fnmatchcase(sweep_id, pattern)]
            if not matching:
                raise unknown_name("sweep", pattern, known, f"in {db}; * stands for anything")
            ids += [sweep_id for sweep_id in matching if sweep_id not in ids]
        connection.execute(GOING, {"ids": ids})
        counts = "SELECT count(*) FILTER (goes), count(*) FILTER (NOT goes) FROM going"
        ((trials, staying),) = connection.execute(counts).fetchall()
    also = f"; {staying} trials that other sweeps have, too, stay" if staying else ""
    return ids, f"{len(ids)} sweeps ({', '.join(ids)}) and {trials} trials{also}"


def forget(db: Path, ids: Sequence[str]) -> None:
    """Remove sweeps, their trials, and the specs that no trial is left of; see ``to_forget``."""
    with write_database(db) as connection:
        connection.execute(GOING, {"ids": ids})
        for table in PLACES:
            connection.execute(
                f"DELETE FROM {table} WHERE (trial_id, spec_hash) IN "  # noqa: S608 # our tables
                "(SELECT trial_id, spec_hash FROM going WHERE goes)"
            )
        for table in ("sweep_trials", "sweeps"):
            connection.execute(f"DELETE FROM {table} WHERE list_contains(?, sweep_id)", [ids])  # noqa: S608 # our tables
        connection.execute(
            "DELETE FROM specs WHERE spec_hash NOT IN (SELECT spec_hash FROM trials)"
        )
