"""The human trials of a database as a driver can replay them."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import duckdb

from merge_runner.drivers.human_replay import SAMPLE_S, HumanTrial, HumanTrials
from merge_runner.records import SIDES, Side
from merge_runner.results.database import read_database

_Samples = dict[Side, tuple[tuple[float, ...], tuple[float, ...]]]
TRACES = """
SELECT pair, rep, condition, spec_hash, side, list(position_m ORDER BY step),
    list(velocity_mps ORDER BY step), max(time_s)
FROM trials JOIN states USING (trial_id, spec_hash)
WHERE source = 'human' AND status = 'finished' AND step >= 0
GROUP BY ALL ORDER BY pair, rep, condition, spec_hash, side
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
    """The finished human trials, each once although it may have been imported in several ways.

    One of another clock than the recorder's is left out.
    """
    ways: dict[tuple[str, int, str], dict[str, _Samples]] = {}
    for row in connection.execute(TRACES).fetchall():
        pair, number, condition, way, side, positions_m, speeds_mps, end_s = row
        if abs(end_s - SAMPLE_S * (len(speeds_mps) - 1)) < SAMPLE_S / 2:
            samples = ways.setdefault((pair, number, condition), {}).setdefault(way, {})
            samples[side] = tuple(positions_m), tuple(speeds_mps)
    trials = []
    for key, imported in ways.items():
        whole = (samples for samples in imported.values() if len(samples) == len(SIDES))
        for samples in islice(whole, 1):
            positions = {side: positions_m for side, (positions_m, _) in samples.items()}
            speeds = {side: speeds_mps for side, (_, speeds_mps) in samples.items()}
            trials.append(HumanTrial(*key, positions, speeds))
    return HumanTrials(tuple(trials))
