"""The simulation of many trials is the runner's, trial by trial, and has the model's symmetry."""

import numpy as np
import pytest

from merge_runner.records import SIDES
from merge_runner.scenarios.merge.conditions import Condition
from merge_runner_cei.batch import Trial, simulate
from tests.support.cei_trials import cei, model, played, scenario, simulated

TRIALS = [("N_0_0", 1), ("L_0_-8", 4), ("R_-4_8", 9), ("L_4_8", 12)]


def trace(record, side):
    rows = [row for row in record.states if row.side == side]
    return np.array([[row.position_m, row.velocity_mps] for row in rows])


@pytest.mark.long
@pytest.mark.parametrize("resistance", ["human", "none"])
@pytest.mark.parametrize("rule", ["rectangle", "euclid2d"])
async def test_a_trial_of_many_is_the_one_that_the_runner_plays(resistance, rule):
    task = scenario(resistance=resistance, collision_rule=rule)
    traces = simulate(model(task), [simulated(*trial, task) for trial in TRIALS])
    for n, trial in enumerate(TRIALS):
        record = await played(*trial, task, cei(set="K0"))
        assert (record.status, record.states[-1].step) == (traces.status[n], traces.ended_at[n])
        for i, side in enumerate(SIDES):
            samples = slice(traces.ended_at[n] + 1)
            found = np.column_stack(
                [traces.positions_m[samples, i, n], traces.speeds_mps[samples, i, n]]
            )
            np.testing.assert_allclose(found, trace(record, side), rtol=0, atol=1e-9)


def test_a_trial_does_not_depend_on_those_beside_it():
    task = scenario()
    many = [simulated(condition, n, task) for condition, _ in TRIALS for n in range(1, 6)]
    together, alone = simulate(model(task), many), simulate(model(task), many[7:8])
    end = alone.ended_at[0]
    assert together.ended_at[7] == end
    np.testing.assert_allclose(
        together.positions_m[: end + 1, :, 7], alone.positions_m[:, :, 0], rtol=0, atol=1e-9
    )


@pytest.mark.parametrize("tunnel", [False, True])
def test_mirrored_drivers_in_mirrored_conditions_drive_mirrored_trials(tunnel):
    task = scenario()
    trials = [simulated(*trial, task) for trial in TRIALS]
    mirrored = [
        Trial(
            Condition(-one.condition.projected_headway_m, -one.condition.relative_velocity_mps),
            one.drivers[::-1],
            one.seeds[::-1],
        )
        for one in trials
    ]
    traces, turned = (simulate(model(task), each, tunnel=tunnel) for each in (trials, mirrored))
    np.testing.assert_allclose(traces.positions_m, turned.positions_m[:, ::-1], rtol=0, atol=1e-9)
    assert list(traces.status) == list(turned.status)


def test_in_the_tunnel_the_cruise_control_leaves_the_published_error_of_speed():
    task = scenario()
    traces = simulate(model(task), [simulated("L_4_8", 1, task)], tunnel=True)
    start = traces.control_at[0]
    assert traces.positions_m[start, :, 0].min() > 50 >= traces.positions_m[start - 1, :, 0].min()
    # The speeds at which the human experiment's recordings leave the tunnel.
    assert traces.speeds_mps[start, :, 0] == pytest.approx([10.31742, 9.52372], abs=2e-4)


def test_without_resistance_the_cruise_control_holds_the_speed():
    task = scenario(resistance="none")
    traces = simulate(model(task), [simulated("L_4_8", 1, task)], tunnel=True)
    held = traces.speeds_mps[: traces.control_at[0] + 1, :, 0]
    np.testing.assert_allclose(held, [[10.4, 9.6]] * len(held), rtol=0, atol=1e-12)


def test_two_cars_without_drivers_collide_as_every_condition_is_made_to():
    task = scenario()
    trials = [Trial(simulated(*one, task).condition, (None, None), (0, 0)) for one in TRIALS]
    assert set(simulate(model(task), trials).status) == {"collided"}
