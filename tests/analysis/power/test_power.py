"""What a study can find is what studies that are played find, at the stated rate."""

from __future__ import annotations

import asyncio
import dataclasses
import json
import time
from functools import cache

import pandas as pd
import pytest
from scipy import stats

from merge_runner.config import ScenarioConfig
from merge_runner.emulator.driver import answer
from merge_runner.planted_effect import PlantedEffect
from merge_runner.prompts.blocks import render_prompt
from merge_runner.records import SIDES, Slot
from merge_runner.run.plan import Options, make_plan
from merge_runner.run.sweep import unsent
from merge_runner.scenarios.merge.conditions import CONDITIONS, HUMAN_CONDITIONS
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner.scenarios.merge.world import World
from merge_runner_analysis.power.study import (
    BESIDE_HUMANS,
    OF_AN_ARM,
    OF_TWO_ARMS,
    Case,
    Search,
    chances,
)
from merge_runner_analysis.power.truths import SPEED, Conditions, human, planted
from merge_runner_analysis.stats.ceiling import ceiling, published_humans
from merge_runner_analysis.stats.indicators import ROBUST, judged
from merge_runner_analysis.stats.regressions import who_first_firth

HUMANS = Conditions(
    tuple(each.projected_headway_m for each in HUMAN_CONDITIONS.values()),
    tuple(each.relative_velocity_mps for each in HUMAN_CONDITIONS.values()),
)
_, SPEED_FOUND, GAP_FOUND, *_ = OF_AN_ARM
STUDIES = 20
PLANTED = """
repetitions = 10
[factors]
x_relative_speed = [-3.3, -0.2]
"""


def of_an_arm(test, truth, repetitions=10, *other):
    return Case(test, "", truth.name, truth, repetitions, *other)


def with_speed(value):
    return human().changed("who_first", SPEED, value)


@cache
def first_prompt(condition: str, side: str) -> str:
    scenario = ScenarioConfig()
    seen = World(scenario, CONDITIONS[condition], TRACK).observe(side)
    return render_prompt(seen, None, variant="baseline", scenario=scenario)


def emulated(effect: PlantedEffect, repetitions: int, sample_set: int) -> pd.DataFrame:
    """A study of the emulator, by what both of its drivers say first."""
    rows = []
    for name in HUMAN_CONDITIONS:
        for repetition in range(1, repetitions + 1):
            slots = [Slot(name, repetition, side, 0, sample_set) for side in SIDES]
            letters = "".join(answer(first_prompt(name, s.side), s, effect)[0] for s in slots)
            who = {"MY": "left", "YM": "right"}.get(letters)
            c = CONDITIONS[name]
            status = "finished" if who else "collided"
            rows.append((c.projected_headway_m, c.relative_velocity_mps, status, who))
    columns = ["projected_headway_m", "relative_velocity_mps", "status", "merged_first"]
    return pd.DataFrame(rows, columns=columns)


@pytest.mark.parametrize("of_speed", [-0.9, -1.4, -2.2])
def test_twenty_planted_studies_find_the_effect_at_the_stated_rate(of_speed):
    effect = PlantedEffect(x_relative_speed=of_speed)
    stated = Search(HUMANS, 1000, 0).chance(of_an_arm(SPEED_FOUND, planted(effect)), 10)
    found = sum(
        bool(judged(ROBUST["I2"], who_first_firth(emulated(effect, 10, study))).passed)
        for study in range(STUDIES)
    )
    low, high = stats.binom.interval(0.99, STUDIES, stated)
    assert low <= found <= high
    assert 0.2 < stated < 1


def test_the_chances_of_humans_are_their_ceiling():
    search = Search(HUMANS, 1000, 1)
    shares = ceiling(published_humans(), (10,) * len(HUMAN_CONDITIONS)).robust
    for name, question in zip((*ROBUST, "I1-I4"), OF_AN_ARM, strict=True):
        assert search.chance(of_an_arm(question, human()), 10) == pytest.approx(
            shares[name], abs=0.06
        )


@pytest.mark.slow
def test_the_chance_to_find_nothing_is_that_of_a_false_alarm():
    search, truth = Search(HUMANS, 1000, 2), with_speed(0.0)
    # Two-sided tests at 5 %, of which one side counts; between two arms both do.
    assert search.chance(of_an_arm(SPEED_FOUND, truth), 10) == pytest.approx(0.025, abs=0.015)
    gap, collisions = (of_an_arm(test, truth, 10, truth, 10) for test in OF_TWO_ARMS)
    assert search.chance(gap, 10) == pytest.approx(0.05, abs=0.025)
    assert search.chance(collisions, 10) < 0.05  # Fisher's test is conservative


@pytest.mark.parametrize(
    "case",
    [
        of_an_arm(SPEED_FOUND, human()),
        of_an_arm(GAP_FOUND, human()),
        of_an_arm(BESIDE_HUMANS[0], human(), 10, human()),
        of_an_arm(BESIDE_HUMANS[1], human(), 10, human()),
        of_an_arm(OF_TWO_ARMS[0], human(), 10, human(), 5),
    ],
    ids=["speed", "gap slope", "humans", "collisions", "gap of two arms"],
)
def test_the_smallest_effect_is_found_with_a_chance_of_80_percent_in_other_studies_too(case):
    smallest, none = Search(HUMANS, 400, 3).smallest(case), case.test.of(case.other)
    elsewhere = Search(HUMANS, 1000, 4)

    def chance(part):
        own = case.own.changed(case.test.field, case.test.at, none + part * smallest)
        return elsewhere.chance(dataclasses.replace(case, own=own), 10)

    assert chance(1) == pytest.approx(0.8, abs=0.07)
    assert chance(0.5) < 0.6


def test_so_many_trials_as_are_said_to_be_enough_are_enough_and_half_of_them_are_not():
    case = of_an_arm(SPEED_FOUND, with_speed(-1.2))
    enough = Search(HUMANS, 400, 5).fewest_repetitions(case)
    assert 10 < enough < 40
    elsewhere = Search(HUMANS, 1000, 6)
    assert elsewhere.chance(case, enough) == pytest.approx(0.8, abs=0.06)
    assert elsewhere.chance(case, enough // 2) < 0.7


def test_an_effect_that_four_times_the_trials_do_not_show_is_not_findable():
    search = Search(HUMANS, 200, 0)
    weak = of_an_arm(SPEED_FOUND, with_speed(-0.5))
    assert search.chance(weak, 40) < 0.8
    assert search.fewest_repetitions(weak) is None
    # One condition cannot tell the cues apart, however often it is played.
    alone = Search(Conditions((4.0,), (-0.8,)), 50, 0)
    assert alone.fewest_repetitions(of_an_arm(SPEED_FOUND, human())) is None
    assert alone.smallest(of_an_arm(SPEED_FOUND, human())) is None


def powered(tmp_path, study, model=(), simulations=60, seed=0):
    plan = make_plan(study, model)
    options = Options(db=tmp_path / "none.duckdb", cache=tmp_path / "none")
    expected = asyncio.run(unsent(plan, options, say=print, whole=True))
    return chances(plan, expected, [], simulations=simulations, seed=seed)


@pytest.mark.slow
def test_equal_seeds_give_equal_chances_and_other_seeds_others(tmp_path):
    one, same, other = (
        powered(tmp_path, "baseline", simulations=20, seed=seed) for seed in (0, 0, 1)
    )
    assert one == same
    assert one != other


@pytest.mark.slow
def test_a_planted_study_is_told_by_what_is_planted(tmp_path):
    (tmp_path / "planted.toml").write_text(PLANTED)
    found = powered(tmp_path, str(tmp_path / "planted.toml"))
    assert {each.truth for each in found} == {"as planted"}
    speeds = {each.arms: each for each in found if each.question == SPEED_FOUND.question}
    strong, weak = speeds["x_relative_speed=-3.3",], speeds["x_relative_speed=-0.2",]
    assert (strong.effect, weak.effect) == (-3.3, -0.2)
    assert strong.enough < strong.trials == 110
    assert weak.enough is None


@pytest.mark.long
def test_a_usual_study_takes_less_than_20_seconds_of_one_core(tmp_path):
    began = time.process_time()
    found = powered(tmp_path, "ablations", ("o3",), simulations=200)
    assert time.process_time() - began < 20
    # Seven ablations of the same size are one row.
    assert {len(each.arms) for each in found} == {1, 7}
    assert {each.truth for each in found} == {"human"}


@pytest.mark.slow
async def test_power_sends_and_makes_nothing_and_says_where_a_price_is_unknown(
    merge_runner, tmp_path
):
    (tmp_path / "experiments").mkdir()
    (tmp_path / "experiments/models.toml").write_text(
        '[dear]\nprovider = "openai"\nformat = "openai-chat"\nid = "no-such-model"\n'
        "max_output_tokens = 4000\n"
    )
    few = ("power", "baseline", "--model", "dear", "--reps", 4, "--sims", 20)
    run = await merge_runner(*few)
    assert run.code == 0, run.err
    assert "the whole study costs about unknown (x0.5), unknown (x1), unknown (x2) USD" in run.out
    assert "nothing to find" in run.out
    found = json.loads((await merge_runner(*few, "--json")).out)
    assert found["costs_usd"] == [None] * 3
    assert {each["trials"] for each in found["chances"]} == {44}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["experiments"]


def test_the_odds_of_the_emulator_are_those_that_the_humans_are_supposed_to_have():
    assert PlantedEffect().coefficients == human().who_first


PERSONA = """
repetitions = 4
[factors]
prompt = ["baseline", "hurried"]
x_persona = [{text = "You are late.", x_relative_speed = 2.0}]
[prompts.hurried]
add = [{text = "You are late."}]
"""


def test_a_planted_persona_is_supposed_where_the_prompt_contains_it(tmp_path):
    (tmp_path / "persona.toml").write_text(PERSONA)
    found = powered(tmp_path, str(tmp_path / "persona.toml"), simulations=20)
    effects = {each.arms[0]: each.effect for each in found if each.question == SPEED_FOUND.question}
    assert effects == {"baseline": -3.3, "hurried": pytest.approx(-1.3)}
