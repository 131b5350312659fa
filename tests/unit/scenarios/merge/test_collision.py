"""The three collision rules, against figures that were computed apart from this code."""

import pytest

from merge_runner.config import ScenarioConfig
from merge_runner.scenarios.merge.collision import collided, rectangles_overlap
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner.scenarios.merge.world import World
from tests.support.cases import cases, table

BOX_M = (4.5, 1.8)
RULES = ("euclid2d", "rectangle", "shared_lane")


def overlaps(position_m, spacing_m=0.005):
    """The positions of the right vehicle, 80 to 115 m, that overlap with the left one's."""
    grid = (80 + spacing_m * k for k in range(round(35 / spacing_m)))
    return [other for other in grid if rectangles_overlap(TRACK, position_m, other, *BOX_M)]


def test_rectangles_overlap_in_the_known_intervals_without_a_hole_and_nowhere_before():
    for position, interval in table("track", "overlaps").items():
        hits = overlaps(float(position))
        assert (hits[0], hits[-1]) == pytest.approx(interval, abs=0.02)
        assert len(hits) == round((hits[-1] - hits[0]) / 0.005) + 1
    assert not any(map(overlaps, (80.0, 88.0, 90.0, 90.5, 90.604)))
    assert overlaps(90.616)


def test_long_outlines_that_only_an_axis_across_tells_apart_do_not_overlap():
    assert not rectangles_overlap(TRACK, 100.0, 108.6, 9.0, 0.5)
    assert rectangles_overlap(TRACK, 100.0, 108.4, 9.0, 0.5)


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("control_start", ["both_exits", "own_exit"])
def test_every_condition_collides_at_constant_speed_and_not_at_once(rule, control_start):
    scenario = ScenarioConfig(collision_rule=rule, control_start=control_start)
    for condition in CONDITIONS.values():
        world = World(scenario, condition, TRACK)
        assert world.status is None
        while world.status is None:
            world.drive([0.0], [0.0])
        assert world.status == "collided"


@pytest.mark.parametrize("case", cases("track", "touching"))
def test_vehicles_that_touch_do_not_collide_and_those_that_are_nearer_do(case):
    rule, *at, collides = case
    assert collided(ScenarioConfig(collision_rule=rule), TRACK, *at) is collides
    longer = ScenarioConfig(collision_rule=rule, vehicle_length_m=6.0)
    assert collided(longer, TRACK, *at) is (collides or at != [99.99, 99.99])
