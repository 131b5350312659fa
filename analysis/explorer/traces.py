"""The traces of many trials: their speeds and headway over time, and where the humans' lie."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

from merge_runner_analysis.explorer.reading import Row, reading, records

# What is drawn of a trial, each as a list; the headway is that of its first vehicle.
MEASURES = ("first_mps", "second_mps", "headway_m")
# A trace has about so many points, and always the last one.
POINTS = 40
# Both vehicles at each sample under control, of the trials $1 with the specs $2. The first one is
# that which merged first, or was ahead at the end.
SAMPLED = """
WITH abreast AS (
    SELECT trial_id, spec_hash, step, one.time_s, one.velocity_mps AS left_mps,
        other.velocity_mps AS right_mps, one.position_m - other.position_m AS ahead_m
    FROM (FROM states WHERE side = 'left' AND time_s >= 0) AS one
    JOIN (FROM states WHERE side = 'right') AS other USING (trial_id, spec_hash, step)
    SEMI JOIN (SELECT unnest($1::VARCHAR[]) AS trial_id, unnest($2::VARCHAR[]) AS spec_hash)
        USING (trial_id, spec_hash)
), sampled AS (
    SELECT trial_id, spec_hash, step, time_s,
        if(turned, right_mps, left_mps) AS first_mps, if(turned, left_mps, right_mps) AS second_mps,
        if(turned, -ahead_m, ahead_m) AS headway_m
    FROM abreast JOIN (
        SELECT trial_id, spec_hash, arg_max(ahead_m, step) < 0 AS turned FROM abreast GROUP BY ALL
    ) USING (trial_id, spec_hash)
)
"""
COLUMNS = ("time_s", *MEASURES)
TRACES = f"""
{SAMPLED}
SELECT trial_id, spec_hash, {
    ", ".join(
        f"list_append({name}[1:-2:1 + len({name}) // {POINTS}], {name}[-1]) AS {name}"
        for name in COLUMNS
    )
}
FROM (
    SELECT trial_id, spec_hash, {
    ", ".join(f"list({name} ORDER BY step) AS {name}" for name in COLUMNS)
} FROM sampled GROUP BY ALL
)
"""  # noqa: S608 # constants
# The samples of every 0.2 s together, which is the step of the other drivers. Where fewer than half
# of the trials go on, the rest are no picture of all.
BAND = f"""
{SAMPLED}
SELECT round(5 * time_s) / 5 AS time_s, {
    ", ".join(f"quantile_cont({name}, [0.1, 0.5, 0.9]) AS {name}" for name in MEASURES)
}
FROM sampled GROUP BY ALL
HAVING 2 * count(DISTINCT (trial_id, spec_hash)) >=
    (SELECT count(DISTINCT (trial_id, spec_hash)) FROM sampled)
ORDER BY time_s
"""  # noqa: S608 # constants

Key = tuple[str, str]


def read_traces(db: Path, keys: Collection[Key]) -> dict[Key, Row]:
    """The traces of trials by name and spec: ``time_s`` and MEASURES, from the start of control.

    A trial has none where a vehicle has no sample.
    """
    return {(row["trial_id"], row["spec_hash"]): row for row in _read(db, TRACES, keys)}


def read_band(db: Path, keys: Collection[Key]) -> list[Row]:
    """The 10th, 50th and 90th percentile of each of MEASURES over these trials, by ``time_s``."""
    return _read(db, BAND, keys)


def _read(db: Path, sql: str, keys: Collection[Key]) -> list[Row]:
    with reading(db) as connection:
        return records(connection, sql, [[name for name, _ in keys], [spec for _, spec in keys]])
