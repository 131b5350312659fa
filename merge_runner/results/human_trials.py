"""The human trials of a database as a driver can replay them."""

from __future__ import annotations

from pathlib import Path

import duckdb

from merge_runner.drivers.human_replay import SAMPLE_S, HumanTrial, HumanTrials
from merge_runner.records import SIDES, Side
from merge_runner.results.database import read_database

TRACES = """
SELECT pair, rep, condition, side, list(position_m ORDER BY step), list(velocity_mps ORDER BY step),
    max(time_s)
FROM trials JOIN states USING (trial_id, spec_hash)
WHERE source = 'human' AND status = 'finished' AND step >= 0
GROUP BY ALL ORDER BY pair, rep, condition, side
"""


def human_trials(db: Path) -> HumanTrials:
    """The finished human trials of a database, none where there is no database yet.

    Raises UsageError.
    """
    if not db.is_file():
        return HumanTrials()
    with read_database(db) as connection:
        return read_human_trials(connection)


def read_human_trials(connection: duckdb.DuckDBPyConnection) -> HumanTrials:
    """The finished human trials; one of another clock than the recorder's is left out."""
    found: dict[tuple[str, int, str], dict[Side, tuple[list[float], list[float]]]] = {}
    for pair, number, condition, side, *samples, end_s in connection.execute(TRACES).fetchall():
        positions_m, speeds_mps = samples
        if abs(end_s - SAMPLE_S * (len(speeds_mps) - 1)) < SAMPLE_S / 2:
            found.setdefault((pair, number, condition), {})[side] = positions_m, speeds_mps
    return HumanTrials(
        tuple(
            HumanTrial(
                *key,
                {side: tuple(positions_m) for side, (positions_m, _) in sides.items()},
                {side: tuple(speeds_mps) for side, (_, speeds_mps) in sides.items()},
            )
            for key, sides in found.items()
            if len(sides) == len(SIDES)
        )
    )
