"""Whether collisions and gaps are those of the stored states, computed apart from the views."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from math import hypot, nan

import duckdb

from merge_runner.audit.expected import Spec
from merge_runner.audit.findings import Finding
from merge_runner.config import ScenarioConfig
from merge_runner.results.comparison import same_value
from merge_runner.scenarios.merge.collision import collided
from merge_runner.scenarios.merge.geometry import TRACK

TOLERANCE_M = 1e-6
GAPS = "CREATE OR REPLACE TEMP TABLE gaps AS SELECT trial_id, spec_hash, gap_m FROM trial_metrics"
# A trial's samples before and after the first arrival at the merge point, and all those at which
# the centres may be within reach of each other, along the road and across it.
TRACES = """
WITH samples AS (
    SELECT trial_id, spec_hash, step,
        max(position_m) FILTER (side = 'left') AS left_m,
        max(position_m) FILTER (side = 'right') AS right_m
    FROM states SEMI JOIN audited USING (trial_id, spec_hash) GROUP BY ALL
), traces AS (
    SELECT trial_id, spec_hash, max(step) AS last_step,
        arg_max([left_m, right_m], step) FILTER (greatest(left_m, right_m) < merge_point_m)
            AS before_m,
        arg_min([left_m, right_m], step) FILTER (greatest(left_m, right_m) >= merge_point_m)
            AS after_m,
        coalesce(list((step, left_m, right_m) ORDER BY step) FILTER (
            abs(left_m - right_m) < reach_m / branch_cosine
            AND left_m + right_m > 2 * merge_point_m - reach_m / branch_sine), []) AS close
    FROM samples JOIN rules USING (spec_hash)
    WHERE left_m IS NOT NULL AND right_m IS NOT NULL GROUP BY ALL
)
SELECT trial_id, spec_hash, status, last_step, close, before_m, after_m, gap_m
FROM traces JOIN audited USING (trial_id, spec_hash) LEFT JOIN gaps USING (trial_id, spec_hash)
ORDER BY ALL
"""


def reach_m(scenario: ScenarioConfig) -> float:
    """The distance of the centres beyond which no rule sees a collision, with room for rounding."""
    return hypot(scenario.vehicle_length_m, scenario.vehicle_width_m) + TOLERANCE_M


def check_traces(
    connection: duckdb.DuckDBPyConnection, specs: Mapping[str, Spec]
) -> Iterator[Finding]:
    """Judge the audited trials anew, each by the rule and the vehicles of its own spec."""
    for row in connection.execute(TRACES).fetchall():
        trial_id, spec_hash, status, last_step, close, before_m, after_m, gap_m = row
        scenario = specs[spec_hash].scenario
        assert scenario is not None  # a row of rules stands for it
        text = _collision(scenario, status, last_step, close)
        if text is not None:
            yield Finding("outcome", text, trial=trial_id)
        finished = status == "finished" and before_m is not None and after_m is not None
        found_m = _gap_m(before_m, after_m, scenario) if finished else None
        if not same_value(gap_m, found_m, TOLERANCE_M):
            text = f"it is {_metres(gap_m)} in trial_metrics, and by its states {_metres(found_m)}"
            yield Finding("gap", text, trial=trial_id)


def _collision(
    scenario: ScenarioConfig,
    status: str,
    last_step: int,
    close: Iterable[tuple[int, float, float]],
) -> str | None:
    """What contradicts the status; a trial ends with its first collision."""
    first = next((step for step, *both in close if collided(scenario, TRACK, *both)), None)
    if first is None and status == "collided":
        return f"it is collided, and its states never are by the rule {scenario.collision_rule}"
    if first is not None and (status != "collided" or first < last_step):
        return f"it is {status} after {last_step} steps, and its states collide after {first}"
    return None


def _gap_m(before_m: Sequence[float], after_m: Sequence[float], scenario: ScenarioConfig) -> float:
    """The net gap at the first arrival at the merge point (arXiv 2604.09609, Table IV).

    Positions are linear within the step.
    """
    steps = list(zip(before_m, after_m, strict=True))
    shares = ((TRACK.merge_point_m - a) / (b - a) for a, b in steps if b >= TRACK.merge_point_m)
    share = min(shares, default=nan)  # DuckDB takes what is no number for the largest
    left_m, right_m = (a + share * (b - a) for a, b in steps)
    return abs(left_m - right_m) - scenario.vehicle_length_m


def _metres(value: float | None) -> str:
    return "missing" if value is None else f"{value:.3f} m"
