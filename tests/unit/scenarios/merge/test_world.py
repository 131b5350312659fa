"""One trial's world: symmetry, bounds, ends, and what the drivers see."""

from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from merge_runner.config import ScenarioConfig
from merge_runner.records import SIDES
from merge_runner.scenarios.merge.conditions import CONDITIONS, Condition
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner.scenarios.merge.world import World

A_MAX_MPS2 = 2.5
OTHER = {"left": "right", "right": "left"}

actions = st.floats(-1, 1)
# Each pair is held for a second, so that many trials get to an end.
action_pairs = st.lists(st.tuples(actions, actions), max_size=30)
names = st.sampled_from(sorted(CONDITIONS))
scenarios = st.builds(
    ScenarioConfig,
    collision_rule=st.sampled_from(["euclid2d", "rectangle", "shared_lane"]),
    control_start=st.sampled_from(["both_exits", "own_exit"]),
    resistance=st.sampled_from(["none", "human"]),
    straight_after=st.sampled_from(["own", "both"]),
    history_start=st.sampled_from(["cruise", "empty"]),
)


def start(name="N_0_0", **scenario):
    return World(ScenarioConfig(**scenario), CONDITIONS[name], TRACK)


def drive(world, left, right, steps=10_000):
    """Hold both actions for so many steps, or until the end."""
    for _ in range(steps):
        if world.status is not None:
            return
        world.drive([left], [right])


def trace(world, side):
    rows = [row for row in world.states() if row.side == side]
    return [(r.step, r.time_s, r.position_m, r.velocity_mps, r.acceleration_mps2) for r in rows]


@settings(max_examples=60)
@given(names, scenarios, action_pairs)
def test_mirroring_left_and_right_mirrors_the_whole_trial(name, scenario, pairs):
    """Exactly: a bias towards one side would pass for a finding about who goes first."""
    one = CONDITIONS[name]
    other = Condition(-one.projected_headway_m, -one.relative_velocity_mps)
    world, mirror = World(scenario, one, TRACK), World(scenario, other, TRACK)
    for left, right in pairs:
        drive(world, left, right, 5)
        drive(mirror, right, left, 5)
        for side in SIDES:
            assert world.observe(side) == mirror.observe(OTHER[side])
            assert world.in_control(side) == mirror.in_control(OTHER[side])
    for side in SIDES:
        assert trace(world, side) == trace(mirror, OTHER[side])
    assert mirror.status == world.status
    first = world.merged_first()
    assert mirror.merged_first() == (first and OTHER[first])


@settings(max_examples=30)
@given(names, action_pairs)
def test_acceleration_stays_within_its_bound_and_explains_every_change_of_speed(name, pairs):
    world = start(name)
    for left, right in pairs:
        drive(world, left, right, 5)
    rows = [(row.step, row.side) for row in world.states()]
    assert rows == [(step, side) for step in range(len(rows) // 2) for side in SIDES]
    for side in SIDES:
        rows = trace(world, side)
        assert rows[0][4] == 0.0
        for (_, then_s, _, before, _), (step, now_s, _, after, acceleration) in pairwise(rows):
            assert (now_s, now_s - then_s) == (step / 5, pytest.approx(0.2))
            assert abs(acceleration) <= A_MAX_MPS2 + 1e-9
            assert after - before == pytest.approx(acceleration * 0.2, abs=1e-9)


def test_each_side_executes_its_own_action_less_the_resistance_unless_it_cruises():
    world, resisted = start(), start(resistance="human")
    world.drive([1.0], [-0.5])
    assert [trace(world, side)[1][2:] for side in SIDES] == [
        (pytest.approx(52.05), 10.5, 2.5),
        (pytest.approx(51.975), 9.75, -1.25),
    ]
    resisted.drive([0.0], [None])
    assert [trace(resisted, side)[1][3:] for side in SIDES] == [(9.8, -1.0), (10.0, 0.0)]


@settings(max_examples=60)
@given(names, scenarios, st.lists(st.tuples(actions, actions), min_size=1, max_size=400))
def test_steps_that_are_driven_at_once_are_as_if_one_by_one_up_to_the_end(name, scenario, pairs):
    at_once, one_by_one = (World(scenario, CONDITIONS[name], TRACK) for _ in range(2))
    at_once.drive(*zip(*pairs, strict=True))
    for left, right in pairs:
        if one_by_one.status is None:
            one_by_one.drive([left], [right])
    assert at_once.states() == one_by_one.states()
    for side in SIDES:
        assert at_once.observe(side) == one_by_one.observe(side)
    ends = [(world.status, world.step, world.merged_first()) for world in (at_once, one_by_one)]
    assert ends[0] == ends[1]


@pytest.mark.parametrize(
    ("actions", "scenario", "steps", "end"),
    [
        # 100 m at 10 m/s: exactly at the end of the track.
        ((0.0, -1.0), {}, 50, ("finished", 10.0, "left")),
        # At 20 Hz there is a sample at 149.5 m.
        ((-1.0, 0.0), {"step_s": 0.05}, 200, ("finished", 10.0, "right")),
        ((-1.0, -1.0), {}, 150, ("timeout", 30.0, None)),
    ],
)
def test_a_trial_ends_where_a_vehicle_reaches_the_end_or_after_30_s(actions, scenario, steps, end):
    world = start(**scenario)
    drive(world, *actions, steps - 1)
    assert world.status is None
    drive(world, *actions, 1)
    assert (world.status, world.time_s, world.merged_first()) == end
    assert world.step == steps
    assert (max(row.position_m for row in world.states()) == 150.0) == (end[0] == "finished")


def test_after_a_collision_nobody_merged_first_although_one_passed_the_merge_point():
    world = start()
    drive(world, 0.2, -0.2, steps=24)
    assert (world.status, world.merged_first()) == (None, "left")
    drive(world, -1.0, 1.0)
    assert world.states()[-2].position_m > 100
    assert (world.status, world.merged_first()) == ("collided", None)


def test_who_merged_first_is_told_apart_within_one_step():
    """Short vehicles 1 m apart both pass the merge point within the same 2 m step."""
    world = World(ScenarioConfig(vehicle_length_m=0.5), Condition(1.0, 0.0), TRACK)
    drive(world, 0.0, 0.0)
    steps = [min(row[0] for row in trace(world, side) if row[2] >= 100) for side in SIDES]
    assert steps[0] == steps[1]
    assert (world.status, world.merged_first()) == ("finished", "left")


def test_who_is_at_the_merge_point_only_after_the_end_has_not_merged():
    """The left vehicle, from 50 m at 10 m/s, is there in the step after 4.8 s."""
    for timeout_s, end in ((4.8, ("timeout", 24, None)), (5.0, ("timeout", 25, "left"))):
        scenario = ScenarioConfig(vehicle_length_m=0.5, timeout_s=timeout_s)
        world = World(scenario, Condition(1.0, 0.0), TRACK)
        world.drive([0.0] * 30, [0.0] * 30)
        assert (world.status, world.step, world.merged_first()) == end


@pytest.mark.parametrize("history_start", ["cruise", "empty"])
@pytest.mark.parametrize("steps", [0, 1, 3, 12])
def test_histories_hold_the_last_ten_steps_before_now_after_cruising_or_nothing(
    history_start, steps
):
    """The oldest value comes first, and the other's present speed is not history."""
    world = start("L_4_-8", history_start=history_start)
    for k in range(1, steps + 1):
        world.drive([0.01 * k], [-0.01 * k])
    for side, sign in (("left", 1), ("right", -1)):
        executed = [sign * A_MAX_MPS2 * 0.01 * k for k in range(1, steps + 1)]
        *speeds, now_mps = [row[3] for row in trace(world, OTHER[side])]
        if history_start == "cruise":
            executed, speeds = [0.0] * 10 + executed, speeds[:1] * 10 + speeds
            speeds = speeds if steps else [now_mps] * 10
        seen = world.observe(side)
        assert seen.own_accelerations_mps2 == pytest.approx(executed[-10:])
        assert (seen.other_speeds_mps, seen.other_speed_mps) == (tuple(speeds[-10:]), now_mps)
        assert seen.own_position_m == trace(world, side)[-1][2]
        last = -sign * A_MAX_MPS2 * 0.01 * steps
        assert seen.other_acceleration_mps2 == pytest.approx(last)


def test_an_observation_is_told_from_the_own_seat_once_both_are_out_of_their_tunnels():
    world = start("L_4_-8")
    assert [row.position_m for row in world.states()] == pytest.approx([57.5385, 50.0], abs=1e-4)
    assert all(map(world.in_control, SIDES))
    # The left vehicle is ahead at 57.54 m, so to it the other is behind.
    for side, own, other, ahead, to_merge in (
        ("left", 9.6, 10.4, -7.5385, 42.4615),
        ("right", 10.4, 9.6, 7.5385, 50.0),
    ):
        seen = world.observe(side)
        assert (seen.own_speed_mps, seen.other_speed_mps) == (own, other)
        told = (seen.relative_distance_m, seen.distance_to_merge_m)
        assert told == pytest.approx((ahead, to_merge), abs=1e-4)


def test_a_vehicle_that_stops_within_a_step_has_executed_less_than_it_commanded():
    """At -2.25 m/s^2 a vehicle is down to 0.1 m/s after 22 steps; 0.5 m/s^2 end its 23rd."""
    world = start()
    drive(world, -0.9, 0.0, steps=24)
    _, _, positions, speeds, accelerations = zip(*trace(world, "left"), strict=True)
    assert speeds[22:] == pytest.approx((0.1, 0.0, 0.0))
    assert accelerations[22:] == pytest.approx((-2.25, -0.5, 0.0))
    assert positions[23] - positions[22] == pytest.approx(0.1**2 / (2 * 2.25))
    assert positions[24] == positions[23]
    assert world.observe("left").own_accelerations_mps2[-3:] == pytest.approx((-2.25, -0.5, 0.0))


def test_own_exit_starts_at_the_earlier_exit_and_the_other_cruises_on_to_its_own():
    world = start("L_4_-8", control_start="own_exit")
    # 4.0224 s into the run the left vehicle is out, and the right one 50 - 0.7852 * 10.4 m far.
    assert world.time_s == 0.0
    assert [row.position_m for row in world.states()] == pytest.approx([50, 41.8333], abs=1e-3)
    in_control = []
    for _ in range(5):
        in_control.append((world.in_control("left"), world.in_control("right")))
        world.drive([0.0], [None])
    # The right vehicle leaves its tunnel after 0.785 s, so the fifth sample sees it outside.
    assert in_control == [(True, False)] * 4 + [(True, True)]
    assert {row[3] for row in trace(world, "right")} == {10.4}


def test_the_road_turns_straight_behind_the_own_merge_point_or_for_both_at_once():
    world = start()
    while (seen := world.observe("left")).road == "merge":
        assert seen.distance_to_merge_m > 0
        world.drive([0.0], [-1.0])
    # Exactly at the merge point, after 50 m at 10 m/s.
    assert (world.time_s, seen.distance_to_merge_m) == (5.0, None)
    other = world.observe("right")
    assert (other.road, other.distance_to_merge_m > 0) == ("merge", True)
    world = start("L_4_-8", straight_after="both")
    drive(world, 0.5, -0.25, steps=20)
    # The leader is told how far it is past the merge point.
    assert world.states()[-2].position_m > 100
    assert world.observe("left").distance_to_merge_m < 0
    while world.states()[-1].position_m < 100:
        assert [world.observe(side).road for side in SIDES] == ["merge", "merge"]
        world.drive([0.5], [-0.25])
    assert world.status is None
    assert [world.observe(side).road for side in SIDES] == ["straight", "straight"]
