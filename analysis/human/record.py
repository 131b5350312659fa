"""Converts a recorded trial for the database: its condition, its outcome, its states."""

from __future__ import annotations

from itertools import pairwise
from math import inf

from merge_runner.records import (
    SIDES,
    Side,
    StateRow,
    Status,
    TrialRecord,
    TrialSpec,
    canonical_json,
    spec_hash,
)
from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner_analysis.data.imported_humans import VELOCITY_PAGES
from merge_runner_analysis.data.reference_data import HUMAN_DOI, PAIRS
from merge_runner_analysis.human.archive import Unreadable
from merge_runner_analysis.human.trace import Trace

STATUSES: dict[str, Status] = {
    "Finished": "finished",
    "Collided": "collided",
    "Time ran out": "timeout",
    "Beyond track bounds": "failed",
}
# A recording may begin one step late: up to 0.52 m and 0.05 m/s from the start of its condition.
START_TOLERANCE_M = 0.6
START_TOLERANCE_MPS = 0.1
# The experiment ended at a position, which differs from the distance travelled by some millimetres.
END_TOLERANCE_M = 1.0
_READ = {
    "spec_version": 1,
    "source": "human",
    "doi": HUMAN_DOI,
    "condition": "the one whose start is at most "
    f"{START_TOLERANCE_M} m and {START_TOLERANCE_MPS} m/s from the first sample",
    "time_s": f"from the first sample with both vehicles beyond {TRACK.tunnel_exit_m:g} m",
    "position_m": "travelled_distance",
    "velocity_mps": "velocities",
    "acceleration_mps2": "difference of velocities over the step before",
    "merged_first": f"at {TRACK.merge_point_m:g} m, interpolated within the step",
}
SPEC = canonical_json(_READ)
SPEC_HASH = spec_hash(SPEC)
# Of the velocity pages, which show no positions.
PAGE_SPEC = canonical_json(
    _READ
    | {
        "origin": VELOCITY_PAGES,
        "position_m": "from the start of the condition by trapezoids of the velocities",
    }
)
PAGE_SPEC_HASH = spec_hash(PAGE_SPEC)


def trial_record(
    trace: Trace, experiment: int, iteration: int, read_as: str = SPEC_HASH
) -> TrialRecord:
    """The record of trial ``iteration`` of an experiment; raises Unreadable."""
    status = _status(trace)
    condition = _condition(trace)
    states = _states(trace, _control_start(trace))
    pair = PAIRS.get(experiment, f"experiment_{experiment}")
    decided = status not in ("collided", "failed")
    return TrialRecord(
        spec=TrialSpec(
            trial_id=f"human/{pair}/{condition}/iter{iteration:03d}",
            spec_hash=read_as,
            source="human",
            pair=pair,
            model_left="human",
            model_right="human",
            variant=None,
            condition=condition,
            repetition=iteration,
            sample_set=0,
            order=0,
        ),
        status=status,
        merged_first=_merged_first(trace) if decided else None,
        end_time_s=states[-1].time_s,
        error=trace.end_state if status == "failed" else None,
        states=states,
        decisions=(),
    )


def _status(trace: Trace) -> Status:
    status = STATUSES.get(trace.end_state)
    if status is None:
        raise Unreadable(f"end_state is {trace.end_state!r}; known: {', '.join(STATUSES)}")
    farthest = max(trace.positions_m[side][-1] for side in SIDES)
    if status == "finished" and farthest < TRACK.end_m - END_TOLERANCE_M:
        raise Unreadable(f"it is Finished, but ends with no vehicle beyond {farthest:.1f} m")
    return status


def _condition(trace: Trace) -> str:
    """The condition from whose start the first sample is within the tolerances."""
    firsts = [(trace.positions_m[side][0], trace.velocities_mps[side][0]) for side in SIDES]
    for name, condition in HUMAN_CONDITIONS.items():
        starts = zip(condition.starts_m(TRACK), condition.speeds_mps, strict=True)
        if all(
            abs(at_m - start_m) <= START_TOLERANCE_M and abs(mps - speed_mps) <= START_TOLERANCE_MPS
            for (at_m, mps), (start_m, speed_mps) in zip(firsts, starts, strict=True)
        ):
            return name
    shown = (
        f"{side} at {at_m:.2f} m with {mps:.2f} m/s"
        for side, (at_m, mps) in zip(SIDES, firsts, strict=True)
    )
    raise Unreadable(f"it starts like none of the conditions: {', '.join(shown)}")


def _control_start(trace: Trace) -> int:
    """The first sample with both vehicles out of their tunnels: time 0."""
    for sample, positions in enumerate(zip(*trace.positions_m.values(), strict=True)):
        if min(positions) > TRACK.tunnel_exit_m:
            return sample
    raise Unreadable(f"its vehicles are never both beyond the tunnels ({TRACK.tunnel_exit_m:g} m)")


def _merged_first(trace: Trace) -> Side | None:
    arrivals = {side: _arrival(trace.positions_m[side]) for side in SIDES}
    first = min(arrivals, key=arrivals.__getitem__)
    return first if arrivals[first] < inf else None


def _arrival(positions_m: list[float]) -> float:
    """When a vehicle reaches the merge point, in steps from the first sample; inf: never."""
    for step, (before, now) in enumerate(pairwise(positions_m)):
        if before < TRACK.merge_point_m <= now:
            return step + (TRACK.merge_point_m - before) / (now - before)
    return inf


def _states(trace: Trace, start: int) -> tuple[StateRow, ...]:
    states = []
    for sample in range(len(trace.positions_m["left"])):
        # Rounded, because a product like 3 * 0.05 is not exactly 0.15 in binary.
        step, time_s = sample - start, round((sample - start) * trace.step_s, 9)
        for side in SIDES:
            velocities = trace.velocities_mps[side]
            changed_mps = velocities[sample] - velocities[max(sample - 1, 0)]
            position_m, acceleration_mps2 = (
                trace.positions_m[side][sample],
                changed_mps / trace.step_s,
            )
            states.append(
                StateRow(step, time_s, side, position_m, velocities[sample], acceleration_mps2)
            )
    return tuple(states)
