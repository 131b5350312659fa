"""How a collision came about, and the last moment at which it could have been avoided."""

from collections import Counter
from pathlib import Path

import pandas as pd
import pytest

from merge_runner.config import ScenarioConfig
from merge_runner.records import SIDES, other_side
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner.scenarios.merge.world import World
from merge_runner_analysis.published import human_outcomes, published
from merge_runner_analysis.web.trial.account import (
    BRAKING,
    COLLISIONS,
    SPEEDING_UP,
    collision_class,
    last_escape,
)
from tests.support.crashes import EXAMPLES, NO_PLAN, crash

BOTH_SPED_UP = "nobody braked, both sped up"
INSISTING = ("N_0_0", (0.5,) * 5, (0.4,) * 5)
SCENARIOS = {
    "usual": ScenarioConfig(),
    "boxes": ScenarioConfig(collision_rule="rectangle"),
    "drag": ScenarioConfig(resistance="human"),
    "fine": ScenarioConfig(step_s=0.05, plan_step_s=0.2, collision_rule="rectangle"),
}

# Supplement S1 of doi 10.1093/pnasnexus/pgae420: causes of the collisions in 990 human and 990
# simulated trials. "Same action" is that both sped up or both slowed down, "no action" that both
# were passive, and "one too little" that one was passive or did too little.
PUBLISHED = Path(__file__).with_name("collision_accounts.csv")


def braked(course, condition, side, since, mps2):
    """What the world makes of a side that brakes from a sample on while the other drives on."""
    scenario, other = course.scenario, other_side(side)
    starts = {s: (course.positions_m[s][since], course.speeds_mps[s][since]) for s in SIDES}
    world = World(scenario, CONDITIONS[condition], TRACK, starts)
    sample = since
    while world.status is None:
        sample += 1
        action = None
        if sample <= course.last:
            before, after = course.speeds_mps[other][sample - 1 : sample + 1]
            drag = 0.5 + 0.005 * before**2 if scenario.resistance == "human" else 0.0
            net = (after - before) / scenario.step_s
            action = (net + drag) / scenario.max_acceleration_mps2
        actions = {side: -mps2 / scenario.max_acceleration_mps2, other: action}
        world.drive([actions["left"]], [actions["right"]])
    return world.status


@pytest.mark.parametrize("account", COLLISIONS)
def test_a_collision_is_told_by_who_braked_and_who_sped_up_before_it(account):
    assert collision_class(*crash(*EXAMPLES[account])) == account


@pytest.mark.parametrize(
    ("at", "account"), [(0, BOTH_SPED_UP), (1, "no valid plan"), (2, BOTH_SPED_UP)]
)
def test_an_invalid_plan_counts_only_where_it_was_driven_at_the_last_chance(at, account):
    course, decisions = crash(*INSISTING, {at: NO_PLAN})
    assert course.times_s[course.last_chance("left", BRAKING)] == pytest.approx(1.6)
    assert collision_class(course, decisions) == account


def test_who_braked_in_the_last_step_or_after_speeding_up_has_braked():
    for plan in ((0.4, 0.5, 0.5), (0.4, 0.4, -0.09), (-0.09, 0.5, 0.5)):
        course, decisions = crash("N_0_0", (0.3,) * 5, plan)
        assert course.speeds_mps["right"][-1] > course.speeds_mps["right"][0]
        braked = -0.09 in plan
        assert collision_class(course, decisions) == ("one braked" if braked else BOTH_SPED_UP)
    gentle = (0.4, 0.4, -0.07)
    assert collision_class(*crash("N_0_0", (0.3,) * 5, gentle)) == BOTH_SPED_UP


@pytest.mark.parametrize("rules", SCENARIOS)
@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize(
    "account", [BOTH_SPED_UP, "nobody braked, one sped up", "nobody braked or sped up"]
)
def test_braking_as_told_avoids_it_in_the_world_and_a_step_later_nothing_does(account, side, rules):
    condition, left, right, _ = EXAMPLES[account]
    course, _ = crash(condition, left, right, scenario=SCENARIOS[rules])
    chance = course.last_chance(side, BRAKING)
    least = course.least_mps2(side, BRAKING, chance)
    hardest = course.scenario.max_acceleration_mps2
    assert 0 < least <= hardest
    assert braked(course, condition, side, chance, least) == "finished"
    assert braked(course, condition, side, chance, least - 0.02) == "collided"
    assert braked(course, condition, side, chance + 1, hardest) == "collided"


def test_who_braked_as_hard_as_it_could_can_only_have_sped_up():
    weak = ScenarioConfig(max_acceleration_mps2=0.8)
    course, decisions = crash("N_0_0", (-1.0,) * 8, (-1.0,) * 8, scenario=weak)
    assert course.last_chance("left", BRAKING) is None
    assert course.last_chance("left", SPEEDING_UP) == last_escape(course)[0]
    assert collision_class(course, decisions) == "both braked"


def test_the_published_accounts_are_those_of_all_published_collisions():
    sums = Counter()
    for row in pd.read_csv(PUBLISHED).itertuples():
        sums[row.drivers] += row.collisions
    collided = human_outcomes()["status"].eq("collided").sum()
    targets = published("cei_targets").set_index(["measure", "term"])["value"]
    assert sums == {"humans": collided, "published model": targets["collisions", "count"]}
