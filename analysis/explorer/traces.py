"""The traces of many trials: their speeds and headway over time, and where the humans' lie."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any

from merge_runner_analysis.explorer.reading import Row, reading, records

# What is drawn of a trial, each as a list; the headway is that of its first vehicle.
MEASURES = ("first_mps", "second_mps", "headway_m")
# A trace has about so many points, and always the last one.
POINTS = 40
# Which vehicle of a trial is its first: the left one, or the right one where it is ``turned``. By
# order it is who is ahead at the end: who merged first, if anybody did.
TURNED = {
    "side": "SELECT *, false AS turned FROM wanted",
    "order": """SELECT trial_id, spec_hash, arg_max(position_m, step) FILTER (side = 'left')
            < arg_max(position_m, step) FILTER (side = 'right') AS turned
        FROM states SEMI JOIN wanted USING (trial_id, spec_hash) GROUP BY ALL""",
}
# Both vehicles at each sample under control, of the trials $1 with the specs $2.
SAMPLED = """
WITH wanted AS (
    SELECT unnest($1::VARCHAR[]) AS trial_id, unnest($2::VARCHAR[]) AS spec_hash
), sampled AS (
    SELECT trial_id, spec_hash, turned, step, any_value(time_s) AS time_s,
        any_value(velocity_mps) FILTER ((side = 'right') = turned) AS first_mps,
        any_value(velocity_mps) FILTER ((side = 'left') = turned) AS second_mps,
        any_value(position_m) FILTER ((side = 'right') = turned)
            - any_value(position_m) FILTER ((side = 'left') = turned) AS headway_m
    FROM states JOIN ({turned}) USING (trial_id, spec_hash)
    WHERE time_s >= 0 GROUP BY ALL HAVING headway_m IS NOT NULL
)
"""
TRACES = f"""
{SAMPLED}
SELECT trial_id, spec_hash, turned, list(time_s ORDER BY step) AS time_s, {
    ", ".join(f"list({name} ORDER BY step) AS {name}" for name in MEASURES)
}
FROM sampled JOIN (
    SELECT trial_id, spec_hash, min(step) AS first, max(step) AS last,
        1 + (max(step) - min(step)) // {POINTS} AS every FROM sampled GROUP BY ALL
) USING (trial_id, spec_hash)
WHERE (step - first) % every = 0 OR step = last GROUP BY ALL
"""  # noqa: S608 # constants
# Of each trial the sample that is nearest to every 0.2 s, which is the step of the other drivers.
# Where fewer than half of the trials go on, the rest are no picture of all.
BAND = f"""
{SAMPLED}, placed AS (
    SELECT *, round(5 * time_s)::INTEGER AS place FROM sampled
), nearest AS (
    FROM placed QUALIFY 1 = row_number() OVER (
        PARTITION BY trial_id, spec_hash, turned, place ORDER BY abs(5 * time_s - place), step)
)
SELECT place / 5 AS time_s, {
    ", ".join(f"quantile_cont({name}, [0.1, 0.5, 0.9]) AS {name}" for name in MEASURES)
}
FROM nearest GROUP BY place
HAVING 2 * count(*) >= (SELECT count(*) FROM nearest WHERE place = 0) ORDER BY place
"""  # noqa: S608 # constants

Key = tuple[str, str]


def read_traces(db: Path, keys: Collection[Key], by: str = "side") -> dict[Key, Row]:
    """The traces of trials by name and spec: ``time_s`` and MEASURES, from the start of control.

    ``by`` is one of TURNED. A trial has none where a vehicle has no sample.
    """
    rows = _read(db, TRACES, keys, by)
    return {(row["trial_id"], row["spec_hash"]): row for row in rows}


def read_band(db: Path, keys: Collection[Key], by: str = "side") -> list[Row]:
    """The 10th, 50th and 90th percentile of each of MEASURES over these trials, by ``time_s``."""
    return _read(db, BAND, keys, by)


def _read(db: Path, sql: str, keys: Collection[Key], by: str) -> list[Row]:
    names: Any = [name for name, _ in keys], [spec for _, spec in keys]
    with reading(db) as connection:
        return records(connection, sql.format(turned=TURNED[by]), names)
