"""Trials of the model as if humans had driven them, in a database."""

from __future__ import annotations

from pathlib import Path

from merge_runner.records import SIDES
from merge_runner.results.store import Store
from merge_runner_analysis.data.reference_data import PAIRS
from merge_runner_analysis.human.record import SPEC, SPEC_HASH, Trace, trial_record
from merge_runner_cei.batch import simulate
from merge_runner_cei.calibration.design import design, experiment, model_of
from merge_runner_cei.parameters import OFFSETS, TICK_S, ThresholdSet

ENDS = {"finished": "Finished", "collided": "Collided", "timeout": "Time ran out"}


def write_humans(db: Path, thresholds: ThresholdSet, each: int) -> Path:
    """Every pair of drivers drives each condition so many times, from the tunnels on."""
    scenario = experiment()
    trials = design(thresholds, scenario, 0, each)
    traces = simulate(model_of(thresholds, scenario), trials, tunnel=True)
    experiments = list(PAIRS)
    records = []
    for n in range(len(trials)):
        samples = slice(traces.ended_at[n] + 1)
        trace = Trace(
            step_s=TICK_S,
            end_state=ENDS[str(traces.status[n])],
            positions_m={
                side: traces.positions_m[samples, i, n].tolist() for i, side in enumerate(SIDES)
            },
            velocities_mps={
                side: traces.speeds_mps[samples, i, n].tolist() for i, side in enumerate(SIDES)
            },
        )
        # The pairs of the design take turns.
        records.append(trial_record(trace, experiments[n % len(OFFSETS)], n))
    Store(db).add_recorded(records, {SPEC_HASH: SPEC})
    return db
