"""The simulation of many trials is the runner's, trial by trial, and has the model's symmetry."""

from functools import partial

import numpy as np
import pytest

from analysis.research.cei_calibration.simulation import Trial, simulate
from merge_runner.scenarios.merge.conditions import Condition
from tests.support.cei_trials import cei, model, played, scenario, simulated

near = partial(np.testing.assert_allclose, rtol=0, atol=1e-9)
TRIALS = [("N_0_0", 1), ("L_0_-8", 4), ("R_-4_8", 9), ("L_4_8", 12)]


@pytest.mark.parametrize("resistance", ["human", "none"])
def test_a_trial_of_many_is_the_one_that_the_runner_plays(resistance):
    """Of two rules of collision, one with each resistance."""
    rule = {"human": "rectangle", "none": "euclid2d"}[resistance]
    task = scenario(resistance=resistance, collision_rule=rule)
    traces = simulate(model(task), [simulated(*trial, task) for trial in TRIALS])
    for n, trial in enumerate(TRIALS):
        record = played(*trial, task, cei(set="K0"))
        until = traces.ended_at[n] + 1
        assert (record.status, record.states[-1].step) == (traces.status[n], until - 1)
        found = np.stack([of[:until, :, n] for of in (traces.positions_m, traces.speeds_mps)], 2)
        near(found.reshape(-1, 2), [[row.position_m, row.velocity_mps] for row in record.states])


def test_a_trial_does_not_depend_on_those_beside_it():
    task = scenario()
    many = [simulated(condition, n, task) for condition, _ in TRIALS for n in range(1, 6)]
    together, alone = simulate(model(task), many), simulate(model(task), many[7:8])
    assert together.ended_at[7] == alone.ended_at[0]
    near(together.positions_m[: alone.ended_at[0] + 1, :, 7], alone.positions_m[:, :, 0])


@pytest.mark.parametrize("tunnel", [False, True])
def test_mirrored_drivers_in_mirrored_conditions_drive_mirrored_trials(tunnel):
    task = scenario()
    trials = [simulated(*trial, task) for trial in TRIALS]
    mirrored = [
        Trial(Condition(-h.projected_headway_m, -h.relative_velocity_mps), by[::-1], seeds[::-1])
        for h, by, seeds in ((one.condition, one.drivers, one.seeds) for one in trials)
    ]
    traces, turned = (simulate(model(task), each, tunnel=tunnel) for each in (trials, mirrored))
    near(traces.positions_m, turned.positions_m[:, ::-1])
    assert list(traces.status) == list(turned.status)


TUNNELLED = [("human", [10.31742, 9.52372]), ("none", [10.4, 9.6])]  # as the humans' recordings


@pytest.mark.parametrize(("resistance", "mps"), TUNNELLED)
def test_in_the_tunnel_the_cruise_control_leaves_the_published_error_of_speed(resistance, mps):
    task = scenario(resistance=resistance)
    traces = simulate(model(task), [simulated("L_4_8", 1, task)], tunnel=True)
    at = traces.control_at[0]
    assert traces.positions_m[at, :, 0].min() > 50 >= traces.positions_m[at - 1, :, 0].min()
    assert traces.speeds_mps[at, :, 0] == pytest.approx(mps, abs=2e-4)


def test_two_cars_without_drivers_collide_as_every_condition_is_made_to():
    task = scenario()
    trials = [Trial(simulated(*one, task).condition, (None, None), (0, 0)) for one in TRIALS]
    assert set(simulate(model(task), trials).status) == {"collided"}
