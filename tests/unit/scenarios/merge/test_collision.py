"""The three collision rules, against figures that were computed apart from this code."""

import pytest

from merge_runner.config import ScenarioConfig
from merge_runner.scenarios.merge.collision import collided, rectangles_overlap
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner.scenarios.merge.world import World

BOX_M = (4.5, 1.8)
RULES = ("euclid2d", "rectangle", "shared_lane")

# s of one vehicle: the interval of the other's s in which the rectangles overlap, all in m
INTERVALS = {
    91: (90.61, 95.51),
    93: (90.61, 97.57),
    95: (90.61, 99.64),
    97: (92.45, 101.60),
    99: (94.38, 103.60),
    100: (95.35, 104.59),
    102: (97.39, 106.49),
    105: (100.50, 109.49),
}


def overlaps(position_m, spacing_m=0.005):
    """The positions of the right vehicle, 80 to 115 m, that overlap with the left one's."""
    grid = (80 + spacing_m * k for k in range(round(35 / spacing_m)))
    return [other for other in grid if rectangles_overlap(TRACK, position_m, other, *BOX_M)]


@pytest.mark.parametrize(("position", "interval"), INTERVALS.items())
def test_rectangles_overlap_in_the_known_interval_and_without_a_hole(position, interval):
    hits = overlaps(position)
    assert (hits[0], hits[-1]) == pytest.approx(interval, abs=0.02)
    assert len(hits) == round((hits[-1] - hits[0]) / 0.005) + 1


def test_rectangles_cannot_overlap_before_the_first_possible_contact():
    assert not any(map(overlaps, (80.0, 88.0, 90.0, 90.5, 90.604)))
    assert overlaps(90.616)


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("control_start", ["both_exits", "own_exit"])
def test_every_condition_collides_at_constant_speed_and_not_at_once(rule, control_start):
    scenario = ScenarioConfig(collision_rule=rule, control_start=control_start)
    for condition in CONDITIONS.values():
        world = World(scenario, condition, TRACK)
        assert world.status is None
        while world.status is None:
            world.advance({"left": 0.0, "right": 0.0})
        assert world.status == "collided"


def test_at_equal_speed_a_headway_of_4_6_m_passes_and_one_of_4_4_m_collides():
    def any_collision(headway_m):
        places = (50 + 0.01 * k for k in range(10_000))
        return any(collided(ScenarioConfig(), TRACK, at, at + headway_m) for at in places)

    assert [any_collision(headway_m) for headway_m in (4.6, 4.4)] == [False, True]


# Level vehicles 18 m before the merge point are exactly 4.5 m apart, also in binary.
@pytest.mark.parametrize(
    ("rule", "left_m", "right_m", "collides"),
    [
        ("euclid2d", 82.0, 82.0, False),
        ("euclid2d", 82.01, 82.01, True),
        ("rectangle", 101.0, 105.5, False),
        ("rectangle", 101.0, 105.49, True),
        ("shared_lane", 99.99, 99.99, False),  # neither is at the merge point
        ("shared_lane", 100.0, 99.99, True),
        ("shared_lane", 95.51, 100.0, True),
        ("shared_lane", 95.5, 100.0, False),
    ],
)
def test_vehicles_that_touch_do_not_collide_and_those_that_are_nearer_do(
    rule, left_m, right_m, collides
):
    assert collided(ScenarioConfig(collision_rule=rule), TRACK, left_m, right_m) is collides


@pytest.mark.parametrize("rule", RULES)
def test_the_vehicle_length_is_the_scenarios(rule):
    assert not collided(ScenarioConfig(collision_rule=rule), TRACK, 110.0, 115.0)
    assert collided(ScenarioConfig(collision_rule=rule, vehicle_length_m=6.0), TRACK, 110.0, 115.0)
