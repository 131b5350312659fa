"""Stored sweeps and their calls, and their deletion."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from merge_runner.errors import UsageError, unknown_name
from merge_runner.registry import require
from merge_runner.results.database import by_name, read_database, write_database
from merge_runner.results.rows import KEY_COLUMNS

ALL_SWEEPS = "FROM sweeps ORDER BY started_at"
# Trials that only the sweeps to delete have.
TO_DELETE = """
CREATE OR REPLACE TEMP TABLE to_delete AS
SELECT trial_id, spec_hash FROM sweep_trials
GROUP BY ALL HAVING bool_and(list_contains(?, sweep_id))
"""
# Sorted by slot.
CALLS_OF = """
SELECT DISTINCT condition, rep, side, decision, sample_set, call_key
FROM decisions JOIN trials USING (trial_id, spec_hash)
SEMI JOIN (FROM sweep_trials WHERE list_contains(?, sweep_id)) USING (trial_id, spec_hash)
WHERE call_key IS NOT NULL ORDER BY ALL
"""


def sweeps_to_export(
    path: Path, sweep_ids: Sequence[str], has_all: Callable[[Sequence[str]], bool]
) -> tuple[list[dict[str, Any]], list[str]]:
    """Return the rows of these sweeps and the keys of their calls.

    Without ids it is the newest sweep with calls that the store has all, or else the newest.
    Raises UsageError.
    """
    with read_database(path) as connection:
        sweeps = {row["sweep_id"]: row for row in by_name(connection.execute(ALL_SWEEPS))}

        def calls_of(ids: Sequence[str]) -> list[str]:
            return [key for *_, key in connection.execute(CALLS_OF, [ids]).fetchall()]

        if sweep_ids:
            ids = [*dict.fromkeys(sweep_ids)]
            rows = [require(sweeps, "sweep", sweep_id, f"in {path}") for sweep_id in ids]
            return rows, calls_of(ids)
        newest_first = []
        for sweep_id, row in reversed(sweeps.items()):
            keys = calls_of([sweep_id])
            if keys and has_all(keys):
                return [row], keys
            newest_first.append(([row], keys))
        if not newest_first:
            raise UsageError(f"{path} holds no sweep: there is nothing to record")
        return newest_first[0]


def to_forget(db: Path, patterns: Sequence[str]) -> tuple[list[str], str]:
    """Return the ids of the sweeps that match the patterns, and a description of the deletion.

    Raises UsageError for a pattern without a match.
    """
    with read_database(db) as connection:
        rows = connection.execute("SELECT sweep_id FROM sweeps ORDER BY ALL").fetchall()
        known, ids = [sweep_id for (sweep_id,) in rows], []
        for pattern in patterns:
            matching = [sweep_id for sweep_id in known if fnmatchcase(sweep_id, pattern)]
            if not matching:
                raise unknown_name("sweep", pattern, known, f"in {db}; * stands for anything")
            ids += [sweep_id for sweep_id in matching if sweep_id not in ids]
        connection.execute(TO_DELETE, [ids])
        ((trials,),) = connection.execute("SELECT count(*) FROM to_delete").fetchall()
    return ids, f"{len(ids)} sweeps ({', '.join(ids)}) and the {trials} trials of no other one"


def forget(db: Path, ids: Sequence[str]) -> None:
    """Delete sweeps, the trials that no other sweep has, and specs without a trial."""
    with write_database(db) as connection:
        connection.execute(TO_DELETE, [ids])
        for table in KEY_COLUMNS:
            connection.execute(
                f"DELETE FROM {table} WHERE (trial_id, spec_hash) IN (FROM to_delete)"  # noqa: S608 # our tables
            )
        for table in ("sweep_trials", "sweeps"):
            connection.execute(f"DELETE FROM {table} WHERE list_contains(?, sweep_id)", [ids])  # noqa: S608 # our tables
        connection.execute(
            "DELETE FROM specs WHERE spec_hash NOT IN (SELECT spec_hash FROM trials)"
        )
