"""What a simulation is summed up by is what the analysis says of the same trials."""

from itertools import product

import numpy as np
import pytest

from analysis.research.cei_calibration.outcomes import measured, summary
from analysis.research.cei_calibration.simulation import simulate
from merge_runner.config import Perception
from merge_runner.records import SIDES, canonical_json
from merge_runner.results.store import Store
from merge_runner_analysis.frames import load
from tests.support.cei_trials import cei, model, played, scenario, simulated

# Among them are trials that collide.
TRIALS = [*product(("N_0_0", "L_0_-8", "R_-4_8", "L_4_8"), (1, 2, 3)), ("N_0_0", 18), ("N_0_0", 25)]
MEASURES = ("gap_mean100_m", "conflict_resolution_s")


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    """The same trials: from the database of the runner, and simulated."""
    task = scenario()
    db = tmp_path_factory.mktemp("cei") / "merge.duckdb"

    records = [played(*trial, task, cei(set="K0")) for trial in TRIALS]
    spec = canonical_json({"scenario": task.model_dump()})
    Store(db).add_recorded(records, {records[0].spec.spec_hash: spec})
    trials = [simulated(*trial, task) for trial in TRIALS]
    study = model(task)
    frame = measured(study.task, trials, simulate(study, trials))
    ids = [record.spec.trial_id for record in records]
    stored = load("SELECT * FROM trials JOIN trial_metrics USING (trial_id, spec_hash)", db)
    states = load("SELECT * FROM states ORDER BY step", db)
    return frame.assign(trial_id=ids).set_index("trial_id"), stored.set_index("trial_id"), states


def test_outcomes_and_measures_are_those_of_the_database(both):
    simulated_, stored, _ = both
    stored = stored.loc[simulated_.index]
    assert {"finished", "collided"} <= set(simulated_["status"])
    for name in ("status", "merged_first"):
        assert list(simulated_[name].fillna("")) == list(stored[name].fillna(""))
    for measure in (*MEASURES, "projected_headway_m", "relative_velocity_mps"):
        np.testing.assert_allclose(
            simulated_[measure].astype(float), stored[measure].astype(float), rtol=0, atol=1e-6
        )


def test_deviations_and_first_actions_are_those_of_the_stored_states(both):
    simulated_, _, states = both
    for (trial_id, side), rows in states.groupby(["trial_id", "side"]):
        speeds = rows["velocity_mps"]
        row = simulated_.loc[trial_id]
        deviation = (speeds - speeds.iloc[0]).abs().max()
        assert row[f"deviation_{side}_mps"] == pytest.approx(deviation, abs=1e-9)
        first = rows["acceleration_mps2"].iloc[1]
        assert row[f"first_{side}_mps2"] == pytest.approx(first, abs=1e-6)


def test_a_summary_leaves_out_what_no_fit_can_tell(both):
    simulated_, _, _ = both
    few = summary(simulated_.iloc[:8])
    assert ("who_first", "intercept") not in few
    assert few["collisions", "count"] == (simulated_["status"].iloc[:8] == "collided").sum()


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("clock_s", [None, 1.0])
@pytest.mark.parametrize("perception", [{"view_from_m": 25.0}, {"range_m": 7.0}])
@pytest.mark.parametrize("resistance", ["none", "human"])
def test_drivers_that_see_each_other_late_mostly_still_avoid_a_collision(
    perception, clock_s, resistance
):
    eyes = {f"perception_{side}": Perception(**perception) for side in SIDES}
    task, driver = scenario(resistance=resistance, **eyes), cei(clock=clock_s)
    slots = product(("L_4_-8", "N_0_0", "R_-4_8"), (1, 2, 3))
    trials = [played(*slot, task, driver) for slot in slots]
    assert sum(trial.status == "collided" for trial in trials) <= 4
