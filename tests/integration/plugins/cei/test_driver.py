"""The driver cei in a trial: what it sees, what a study can set, and one trial as it went."""

from dataclasses import replace

import numpy as np
import pytest

from merge_runner.config import Perception
from merge_runner.errors import UsageError
from merge_runner.records import FAR_BEHIND_M, SIDES, Observation
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner.scenarios.merge.vehicle import advance, net_acceleration
from merge_runner_cei.agents import Vehicles, set_speeds, start, tunnel_ticks
from merge_runner_cei.collision_interval import collision_interval, exact_bounds
from merge_runner_cei.driver import USUAL_SETS, thresholds_of
from merge_runner_cei.motion import course
from merge_runner_cei.parameters import OFFSETS, SETS, Base, Habits, offsets_of
from tests.support.cei_trials import cei, model, played, scenario, spec

BOXES = (4.5, 1.8)


async def test_one_seeded_trial_stays_as_it_is():
    record = await played("R_0_8", 3, scenario(), cei(set="K0"))
    rows = {(row.step, row.side): row for row in record.states}
    found = {
        key: (rows[key].position_m, rows[key].velocity_mps)
        for key in ((20, "left"), (20, "right"), (80, "left"), (80, "right"))
    }
    assert (record.status, record.merged_first, record.end_time_s) == ("finished", "right", 9.9)
    for key, values in GOLDEN.items():
        assert found[key] == pytest.approx(values, abs=1e-6)


GOLDEN = {
    (20, "left"): (59.860786, 9.339054),
    (20, "right"): (63.474206, 9.655218),
    (80, "left"): (84.358981, 7.281897),
    (80, "right"): (92.471917, 9.682950),
}


def test_the_lines_of_the_collision_interval_are_near_the_exact_bounds():
    interval = collision_interval(TRACK, *BOXES)
    assert interval.contact_m == pytest.approx(90.6065, abs=1e-4)
    for position in (91.0, 95.0, 100.0, 110.0, 130.0, 145.0):
        found = [float(bound) for bound in interval.at(np.array(position))]
        assert found == pytest.approx(exact_bounds(TRACK, *BOXES, position), abs=0.7)
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
        position, speed = advance(
            position, speed, net_acceleration(-0.7 * 2.5, speed, resistance), 0.25
        )
    assert speed == 0  # it has stopped on the way


def test_what_a_driver_sees_at_the_exit_is_what_it_would_after_the_tunnel():
    many = 4000
    own = Vehicles(np.full(many, 50.0), np.full(many, 9.6))
    other = Vehicles(np.full(many, 54.0), np.full(many, 10.4))
    task, random = model(scenario()), np.random.default_rng(0)
    bases = [Base(0.3, 0.5)] * many
    ticks = tunnel_ticks(own, other)
    at_once = start(
        task, bases, own, other, own.speeds_mps, ticks, random.standard_normal((many, 2))
    )
    watched = start(
        task, bases, own, other, own.speeds_mps, 0 * ticks, random.standard_normal((many, 2))
    )
    for _ in range(round(ticks[0])):
        watched.perceive(task, other, np.zeros(many), random.standard_normal(many))
    for seen in (at_once.perceived_mps, watched.perceived_mps):
        assert seen.mean() == pytest.approx(10.34, abs=0.04)
        assert seen.std() == pytest.approx(0.60, abs=0.03)


def test_a_driver_starts_below_the_speed_it_desires_by_the_error_of_the_cruise_control():
    found = {
        resistance: set_speeds(model(scenario(resistance=resistance)).task, np.array([9.92063]))
        for resistance in ("human", "none")
    }
    assert found["human"] == pytest.approx(10.0, abs=2e-4)
    assert found["none"] == pytest.approx(9.92063, abs=1e-12)


async def test_drivers_without_a_conflict_keep_their_speed():
    calm = Habits(noise=False)
    task = model(scenario(resistance="none"), habits=calm)
    own = Vehicles(np.array([110.0]), np.array([10.0]))
    other = Vehicles(np.array([60.0]), np.array([10.0]))
    agents = start(
        task,
        [Base(0.1, 0.5)],
        own,
        other,
        own.speeds_mps,
        np.array([100.0]),
        np.zeros((1, 2)),
    )
    for _ in range(100):
        agents.perceive(task, other, np.zeros(1), np.zeros(1))
        agents.decide(task, own, other, np.zeros(1), np.ones(1, bool))
        assert agents.inputs == pytest.approx(0.0, abs=1e-12)


async def test_at_the_clock_of_a_language_model_an_input_is_held_for_a_second():
    record = await played("N_0_0", 1, scenario(), cei(set="K0", clock=1.0))
    times = [row.time_s for row in record.decisions if row.side == "left"]
    assert times == [float(n) for n in range(len(times))]


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"pair": 10}, "no pair 10"),
        ({"pair": 1.5}, "no pair 1.5"),
        ({"set": "K9"}, "K0"),
        ({"set": "K0", "upper_men": 0.5}, "upper_mean"),
        ({"set": "K0", "lower_mean": -5}, "lower_mean of cei is a risk: from 0 to 1"),
        ({"set": "F1", "upper_mean": 1.5}, "upper_mean of cei is a risk: from 0 to 1"),
        ({"set": "F1", "upper_spread": -0.1}, "upper_spread of cei is a risk: from 0 to 1"),
    ],
)
def test_what_cannot_be_set_is_refused_with_what_can(changes, said):
    with pytest.raises(UsageError, match=said):
        cei(**changes)


def test_a_threshold_can_be_set_over_those_of_a_set():
    values = cei(set="F1", upper_mean=0.5).values
    assert values["upper_mean"] == 0.5
    assert values["lower_mean"] == SETS["F1"].lower_mean


def test_the_nine_pairs_take_turns_by_the_repetition():
    turns = [offsets_of(0, repetition) for repetition in range(1, 19)]
    assert turns == [*OFFSETS, *OFFSETS]
    assert offsets_of(9, 1) == OFFSETS[8]


@pytest.mark.parametrize("resistance", ["human", "none"])
def test_the_usual_set_suits_the_resistance_unless_one_is_chosen(resistance):
    task = scenario(resistance=resistance)
    usual, chosen = (
        program.seat(task, spec("N_0_0"), "left") for program in (cei(), cei(set="F1"))
    )
    assert thresholds_of(usual) == SETS[USUAL_SETS[resistance]]
    assert thresholds_of(chosen) == SETS["F1"]
    assert USUAL_SETS["human"] != USUAL_SETS["none"]


@pytest.mark.long
@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("clock_s", [None, 1.0])
@pytest.mark.parametrize("perception", [{"view_from_m": 25.0}, {"range_m": 7.0}])
@pytest.mark.parametrize("resistance", ["none", "human"])
async def test_drivers_that_see_each_other_late_mostly_still_avoid_a_collision(
    perception, clock_s, resistance
):
    eyes = {f"perception_{side}": Perception(**perception) for side in SIDES}
    collided = 0
    for condition in ("L_4_-8", "N_0_0", "R_-4_8"):
        for repetition in range(1, 4):
            driver = cei(clock=clock_s)
            task = scenario(resistance=resistance, **eyes)
            trial = await played(condition, repetition, task, driver)
            collided += trial.status == "collided"
    assert collided <= 4


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("set_", ["K0", "F1", "drag-free"])
async def test_a_driver_that_never_sees_the_other_drives_at_the_speed_that_it_desires(set_):
    blind = {f"perception_{side}": Perception(view_from_m=1e-9, delay_s=20.0) for side in SIDES}
    trial = await played("L_4_-8", 1, scenario(**blind), cei(set=set_))
    assert not any(row.told.other_seen for row in trial.decisions)
    own = [row.velocity_mps for row in trial.states if row.side == "left"]
    assert own == pytest.approx([own[0]] * len(own), abs=0.3)


async def test_until_it_sees_the_other_a_driver_takes_its_speed_to_be_the_own():
    view = {"perception_left": Perception(view_from_m=25.0)}
    seat = cei().seat(scenario(**view), spec("L_4_-8", 1), "left")
    driver = cei().driver(seat)
    unseen = Observation(
        road="merge",
        own_speed_mps=9.0,
        other_speed_mps=9.0,
        own_position_m=50.0,
        relative_distance_m=-FAR_BEHIND_M,
        distance_to_merge_m=50.0,
        own_accelerations_mps2=(),
        other_speeds_mps=(),
        other_acceleration_mps2=0.0,
        other_seen=False,
    )
    for number in range(40):
        await driver.decide(unseen, number)
    perceived = driver._seated._agents.perceived_mps
    assert perceived == pytest.approx([9.0])
    await driver.decide(replace(unseen, other_seen=True, other_speed_mps=11.0), 40)
    assert 9.0 != driver._seated._agents.perceived_mps[0] < 10.0
