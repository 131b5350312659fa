"""The reference drivers: their laws, and what is published of them."""

from collections import Counter
from dataclasses import replace
from math import exp, sqrt

import pytest
from hypothesis import given
from hypothesis import strategies as st

from merge_runner.config import ScenarioConfig
from merge_runner.drivers.registry import PROGRAMS
from merge_runner.errors import UsageError
from merge_runner.records import FAR_BEHIND_M, SIDES, Observation
from merge_runner.scenarios.merge.conditions import CONDITIONS, HUMAN_CONDITIONS
from merge_runner.scenarios.merge.vehicle import advance
from merge_runner_analysis.published import HUMAN_GAP_SD_M, published
from tests.support.cases import table
from tests.support.driven_trials import OTHER, both, play, spec

FINE = ScenarioConfig(step_s=0.05, plan_step_s=0.2)
DRAG = FINE.model_copy(update={"resistance": "human"})
# The human intercept is a lasting preference of one side, which no mirror turns round.
EVEN = PROGRAMS["human-odds"].with_changes("human-odds", {"odds_intercept": 0.0}, None)
MIRRORABLE = {"idm": PROGRAMS["idm"], "human-odds": EVEN, "quantal": PROGRAMS["quantal"]}


def changed(name, clock_s=None, **parameters):
    return PROGRAMS[name].with_changes(name, parameters, clock_s)


def of_side(trial, side):
    return [row for row in trial.states if row.side == side]


@pytest.mark.parametrize(("condition", "mirror"), [("N_0_0", "N_0_0"), ("L_2_-8", "R_-2_8")])
@pytest.mark.parametrize("left", MIRRORABLE)
@pytest.mark.parametrize("right", MIRRORABLE)
def test_a_mirrored_pair_gives_the_mirrored_trial(left, right, condition, mirror):
    pair = {"left": MIRRORABLE[left], "right": MIRRORABLE[right]}
    swapped = {OTHER[side]: program for side, program in pair.items()}
    one = play(pair, condition, seeds={"left": 5, "right": 77}, scenario=DRAG)
    other = play(swapped, mirror, seeds={"right": 5, "left": 77}, scenario=DRAG)
    assert (one.status, len(one.states)) == (other.status, len(other.states))
    assert OTHER.get(one.merged_first) == other.merged_first
    for side in SIDES:
        found = [row.position_m for row in of_side(one, side)]
        mirrored = [row.position_m for row in of_side(other, OTHER[side])]
        assert found == pytest.approx(mirrored, abs=1e-9)


@pytest.mark.parametrize("name", sorted({*PROGRAMS} - {"human-replay"}))
def test_a_program_declares_chance_exactly_where_another_seed_is_another_trial(name):
    def trial(condition, *seeds):
        seeds = dict(zip(SIDES, seeds, strict=True))
        return play(both(PROGRAMS[name]), condition, scenario=FINE, seeds=seeds)

    for condition in HUMAN_CONDITIONS:
        one, other = trial(condition, 1, 2), trial(condition, 2, 1)
        if one.states != other.states:
            break
    assert (one.states != other.states) == PROGRAMS[name].chance


def seen(own_mps=10.0, other_mps=10.0, distance_m=50.0, other_ahead_m=0.0):
    road = "merge" if distance_m > 0 else "straight"
    to_merge = distance_m if distance_m > 0 else None
    return Observation(
        road, own_mps, other_mps, other_ahead_m, to_merge, (), (), 100.0 - distance_m, 0.0
    )


async def accelerates(driver, observation, number=0):
    """The net acceleration that a driver decides on where there is no resistance."""
    decision = await driver.decide(observation, number)
    return decision.applied[0] * FINE.max_acceleration_mps2


@pytest.mark.parametrize(
    ("set_", "factor", "scenario"),
    [("highway-env", 0.6, FINE), ("highway-env", 1.5, DRAG), ("treiber-kesting", 1.0, DRAG)],
)
async def test_an_idm_alone_reaches_its_speed_and_never_passes_it(set_, factor, scenario):
    program = changed("idm", set=set_, desired_speed_factor=factor)
    driver = program.make(scenario, spec("N_0_0"), "left")
    position, speed, speeds = 50.0, 10.0, []
    for number in range(1200):
        alone = seen(own_mps=speed, distance_m=100.0 - position, other_ahead_m=-1000.0)
        decision = await driver.decide(alone, number)
        net = decision.applied[0] * scenario.max_acceleration_mps2
        net -= 0.5 + 0.005 * speed**2 if scenario is DRAG else 0.0
        position, speed = advance(position, speed, net, 0.05)
        speeds.append(speed)
    assert speeds[-1] == pytest.approx(10 * factor, rel=0.01)
    passed = max if factor >= 1 else min
    assert passed([10 * factor, *speeds]) == pytest.approx(10 * factor, abs=1e-9)


async def test_idm_brakes_by_its_published_equation():
    driver = PROGRAMS["idm"].make(FINE, spec("N_0_0"), "right")
    await driver.decide(seen(own_mps=10.0), 0)  # it wants to drive at 10 m/s from now on
    wanted_gap = 5.0 + 1.5 * 9.0 + 9.0 * 0.5 / (2 * sqrt(3.0 * 5.0))
    expected = 3.0 * (1 - 0.9**4 - (wanted_gap / 20.0) ** 2)
    ahead = seen(own_mps=9.0, other_mps=8.5, distance_m=-1.0, other_ahead_m=24.5)
    assert await accelerates(driver, ahead) == pytest.approx(expected)


IDM_NUMBERS = {name: st.floats(0.001, 1000) for name in PROGRAMS["idm"].values if name != "set"}
IDM_NUMBERS["exponent"] = st.floats(0.001, 40)


@given(st.fixed_dictionaries(IDM_NUMBERS), *[st.floats(0, 100)] * 3, st.floats(-100, 100))
async def test_an_idm_finds_an_acceleration_whatever_its_parameters(
    numbers, first_mps, own_mps, other_mps, ahead_m
):
    driver = changed("idm", **numbers).make(FINE, spec("N_0_0"), "left")
    await driver.decide(seen(own_mps=first_mps), 0)
    now = seen(own_mps, other_mps, distance_m=-1.0, other_ahead_m=ahead_m)
    assert abs(await accelerates(driver, now, 1)) <= FINE.max_acceleration_mps2


def test_of_two_idm_on_a_tie_exactly_one_yields_and_not_always_the_same():
    first = Counter()
    for repetition in range(1, 21):
        trial = play(both(PROGRAMS["idm"]), "N_0_0", repetition, scenario=FINE)
        assert trial.status == "finished"
        first[trial.merged_first] += 1
        slowest = {side: min(row.velocity_mps for row in of_side(trial, side)) for side in SIDES}
        assert slowest[trial.merged_first] == pytest.approx(10.0)
        assert slowest[OTHER[trial.merged_first]] < 9.0
    assert min(first["left"], first["right"]) > 4


def test_the_human_odds_and_gaps_are_the_published_ones():
    parameters = PROGRAMS["human-odds"].parameters
    gap = ("gap_intercept_m", "gap_abs_headway", "gap_abs_velocity_s", "gap_headway_x_velocity_s")
    who_first = ("odds_intercept", "odds_headway", "odds_velocity")
    for name, terms in (("paper_who_first", who_first), ("paper_gap", gap)):
        rows = published(name)
        values = rows.loc[rows["driver"] == "human", "b"].astype(float)
        assert [parameters[term] for term in terms] == list(values)
    assert parameters["gap_sd_m"] == HUMAN_GAP_SD_M


async def test_the_human_odds_are_drawn_and_both_sides_agree():
    wins, trials, certain = 0, 400, changed("human-odds", gap_sd_m=0.0)
    for repetition in range(1, trials + 1):
        sides = {side: certain.make(FINE, spec("L_2_-8", repetition), side) for side in SIDES}
        # Left is 2 m ahead at the merge point, and 0.8 m/s slower.
        left = await accelerates(sides["left"], seen(9.6, 10.4, 48.0, -6.0))
        right = await accelerates(sides["right"], seen(10.4, 9.6, 54.0, 6.0))
        assert (left < 0) != (right < 0)
        wins += right < 0
    share = 1 / (1 + exp(0.30 - 1.11 * 2.0 - 3.30 * 0.8))
    assert wins / trials == pytest.approx(share, abs=4 * sqrt(share * (1 - share) / trials))


@pytest.mark.parametrize("condition", ["L_4_0", "N_0_0", "R_-4_8"])
def test_the_second_car_opens_the_human_gap_with_one_acceleration(condition):
    trial = play(both(changed("human-odds", gap_sd_m=0.0)), condition, scenario=FINE)
    first, second = trial.merged_first, OTHER[trial.merged_first]
    assert {round(row.acceleration_mps2, 9) for row in of_side(trial, first)} == {0.0}
    held = [round(row.acceleration_mps2, 6) for row in of_side(trial, second)][1:]
    assert len(dict.fromkeys(held)) == 2
    step = next(k for k, row in enumerate(of_side(trial, first)) if row.position_m >= 100)
    gap = of_side(trial, first)[step].position_m - of_side(trial, second)[step].position_m - 4.5
    h, dv = CONDITIONS[condition].projected_headway_m, CONDITIONS[condition].relative_velocity_mps
    sign = 1 if first == "left" else -1
    mean = 3.54 + 0.17 * abs(h) - 0.20 * abs(dv) + 0.06 * (sign * h) * (sign * dv)
    assert gap == pytest.approx(mean, abs=0.15)


async def test_a_quantal_driver_brakes_where_a_collision_costs_more_and_nowhere_else():
    near, far = seen(distance_m=40.0, other_ahead_m=1.0), seen(other_ahead_m=-60.0)
    for cost, ahead, brakes in ((0.0, near, False), (1000.0, near, True), (1000.0, far, False)):
        program = changed("quantal", precision=1000.0, collision_cost=cost)
        driver = program.make(FINE, spec("N_0_0"), "left")
        assert (await accelerates(driver, ahead) < 0) is brakes
    assert await accelerates(driver, far) == 0.0


async def test_a_quantal_driver_draws_by_its_precision():
    drawn = Counter()
    for repetition in range(1, 301):
        driver = changed("quantal", precision=0.0).make(FINE, spec("N_0_0", repetition), "left")
        drawn[round(await accelerates(driver, seen()), 6)] += 1
    assert set(drawn) == {-2.5, -1.5, 0.0, 0.5}
    assert min(drawn.values()) > 45


@pytest.mark.parametrize(("name", "parameters", "said"), table("parameters", "refused"))
def test_parameters_that_cannot_be_are_refused(name, parameters, said):
    with pytest.raises(UsageError, match=said):
        changed(name, **parameters)


@pytest.mark.parametrize("side", SIDES)
async def test_human_odds_keeps_its_speed_and_draws_once_the_other_is_in_sight(side):
    always_yields = changed("human-odds", odds_intercept=-1000.0 if side == "left" else 1000.0)
    driver = always_yields.make(FINE, spec("N_0_0"), side)
    unseen = replace(seen(other_ahead_m=-FAR_BEHIND_M), other_seen=False)
    assert [await accelerates(driver, unseen, number) for number in range(3)] == [0.0] * 3
    assert await accelerates(driver, seen(distance_m=30.0), 3) < 0


@pytest.mark.parametrize("parameter", ["odds_intercept", "odds_headway", "odds_velocity"])
@pytest.mark.parametrize("value", [1000.0, -1000.0])
def test_human_odds_that_are_certain_are_drawn_as_others(parameter, value):
    program = changed("human-odds", **{parameter: value})
    trial = play(both(program), "L_4_8", scenario=FINE)
    assert trial.status in ("finished", "collided")


@pytest.mark.parametrize("name", ["idm", "quantal"])
async def test_a_driver_that_seems_to_stand_at_first_drives_on(name):
    driver = PROGRAMS[name].make(FINE, spec("N_0_0"), "left")
    for number, speed_mps in enumerate((0.0, 10.0)):
        assert -2.5 <= await accelerates(driver, seen(speed_mps), number) <= 2.5
