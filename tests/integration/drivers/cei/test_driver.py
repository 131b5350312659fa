"""The driver cei in a trial: what it sees, what a study can set, and one trial as it went."""

import numpy as np
import pytest

from merge_runner.config import Perception
from merge_runner.drivers.cei.agents import Vehicles, set_speeds, start, tunnel_ticks
from merge_runner.drivers.cei.collision_interval import collision_interval, exact_bounds
from merge_runner.drivers.cei.driver import USUAL_SETS, thresholds_of
from merge_runner.drivers.cei.motion import course
from merge_runner.drivers.cei.parameters import OFFSETS, SETS, Base, offsets_of
from merge_runner.records import SIDES
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner.scenarios.merge.vehicle import advance, net_acceleration
from tests.support.cei_trials import cei, model, played, scenario
from tests.support.driven_trials import spec


@pytest.mark.parametrize(
    ("view_from_m", "end_s", "golden"),
    [
        (
            None,
            9.9,
            [59.860786, 9.339054, 63.474206, 9.655218, 84.358981, 7.281897, 92.471917, 9.682950],
        ),
        # Until it sees the other, a driver takes its speed to be the own one.
        (
            25.0,
            8.8,
            [60.459847, 10.500973, 63.474206, 9.655218, 89.211242, 7.043886, 94.403574, 11.726326],
        ),
    ],
)
def test_one_seeded_trial_stays_as_it_is(view_from_m, end_s, golden):
    eyes = {f"perception_{side}": Perception(view_from_m=view_from_m) for side in SIDES}
    record = played("R_0_8", 3, scenario(**eyes), cei(set="K0"))
    rows = [row for row in record.states if row.step in (20, 80)]
    found = [number for row in rows for number in (row.position_m, row.velocity_mps)]
    assert found == pytest.approx(golden, abs=1e-6)
    assert (record.status, record.merged_first, record.end_time_s) == ("finished", "right", end_s)


def test_the_lines_of_the_collision_interval_are_near_the_exact_bounds():
    interval = collision_interval(TRACK, 4.5, 1.8)
    assert interval.contact_m == pytest.approx(90.6065, abs=1e-4)
    for position in (91.0, 95.0, 100.0, 110.0, 130.0, 145.0):
        found = [float(bound) for bound in interval.at(np.array(position))]
        assert found == pytest.approx(exact_bounds(TRACK, 4.5, 1.8, position), abs=0.7)
    # The published regressions over the published table: 0.9824 p + 6.447 and 1.0014 p - 4.686.
    assert interval.upper == pytest.approx((0.9824, 6.447), abs=0.15)
    assert interval.lower == pytest.approx((1.0014, -4.686), abs=0.01)


@pytest.mark.parametrize("resistance", ["human", "none"])
def test_a_driver_expects_its_car_to_move_as_the_world_moves_it(resistance):
    task = model(scenario(resistance=resistance)).task
    ahead = course(task, np.array([50.0]), np.array([6.0]), np.array([-0.7]))
    position, speed = 50.0, 6.0
    for node in range(25):
        assert ahead.positions_m[node, 0] == pytest.approx(position, abs=1e-12)
        assert ahead.speeds_mps[node, 0] == pytest.approx(speed, abs=1e-12)
        net_mps2 = net_acceleration(-0.7 * 2.5, speed, resistance)
        position, speed = advance(position, speed, net_mps2, 0.25)
    assert speed == 0  # it has stopped on the way


def test_what_a_driver_sees_at_the_exit_is_what_it_would_after_the_tunnel():
    many = 4000
    own = Vehicles(np.full(many, 50.0), np.full(many, 9.6))
    other = Vehicles(np.full(many, 54.0), np.full(many, 10.4))
    task, random = model(scenario()), np.random.default_rng(0)
    ticks = tunnel_ticks(own, other)

    def starting(ticks):
        noise = random.standard_normal((many, 2))
        return start(task, [Base(0.3, 0.5)] * many, own, other, own.speeds_mps, ticks, noise)

    at_once, watched = starting(ticks), starting(0 * ticks)
    for _ in range(round(ticks[0])):
        watched.perceive(task, other, np.zeros(many), random.standard_normal(many))
    for seen in (at_once.perceived_mps, watched.perceived_mps):
        assert (seen.mean(), seen.std()) == pytest.approx((10.34, 0.60), abs=0.03)


def test_a_driver_starts_below_the_speed_it_desires_by_the_error_of_the_cruise_control():
    for resistance, desired_mps in (("human", 10.0), ("none", 9.92063)):
        task = model(scenario(resistance=resistance)).task
        assert set_speeds(task, np.array([9.92063])) == pytest.approx(desired_mps, abs=2e-4)


def test_a_threshold_can_be_set_over_those_of_a_set():
    wanted = SETS["F1"]._asdict() | {"upper_mean": 0.5}
    assert cei(set="F1", upper_mean=0.5).values.items() >= wanted.items()


def test_the_nine_pairs_take_turns_by_the_repetition():
    turns = [offsets_of(0, repetition) for repetition in range(1, 19)]
    assert turns == [*OFFSETS, *OFFSETS]
    assert offsets_of(9, 1) == OFFSETS[8]


@pytest.mark.parametrize("resistance", ["human", "none"])
def test_the_usual_set_suits_the_resistance_unless_one_is_chosen(resistance):
    task = scenario(resistance=resistance)
    for program, name in ((cei(), USUAL_SETS[resistance]), (cei(set="F1"), "F1")):
        driver = program.make(task, spec("N_0_0"), "left")
        assert thresholds_of(driver.context) == SETS[name]
    assert USUAL_SETS["human"] != USUAL_SETS["none"]


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("set_", ["K0", "F1", "drag-free"])
def test_a_driver_that_never_sees_the_other_drives_at_the_speed_that_it_desires(set_):
    blind = {f"perception_{side}": Perception(view_from_m=1e-9, delay_s=20.0) for side in SIDES}
    trial = played("L_4_-8", 1, scenario(**blind), cei(set=set_))
    assert not any(row.observed.other_seen for row in trial.decisions)
    own = [row.velocity_mps for row in trial.states if row.side == "left"]
    assert own == pytest.approx([own[0]] * len(own), abs=0.3)
