"""What a study can find is what studies that are played find, at the stated rate."""

from __future__ import annotations

import asyncio
import json
from functools import cache

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from merge_runner.config import ScenarioConfig
from merge_runner.emulator.driver import answer
from merge_runner.errors import UsageError
from merge_runner.planted_effect import PlantedEffect
from merge_runner.prompts.blocks import prompt_of, render_prompt
from merge_runner.records import SIDES, Slot
from merge_runner.run.plan import Options, make_plan
from merge_runner.run.sweep import unsent
from merge_runner.scenarios.merge.conditions import CONDITIONS, HUMAN_CONDITIONS
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner.scenarios.merge.world import World
from merge_runner.study.file import Effect
from merge_runner_analysis.power import HUMANS, Case, chances, human, simulate
from merge_runner_analysis.stats.indicators import TESTED, ceiling
from merge_runner_analysis.stats.regressions import gap_ols, who_first_firth, who_first_logit

STUDIES = 20
PLANTED = """
repetitions = 10
[factors]
x_relative_speed = [-3.3, -0.2]
"""
NAMED = """
models = ["idm"]
repetitions = 10
[factors]
prompt = ["baseline", "A1"]
resistance = ["none", "human"]
[effect]
prompt = { gap_m = 2.0, relative_velocity = 3.0 }
resistance = { collided = 0.4 }
"""


def chance(case, question, simulations=150):
    return case.chances(list(HUMAN_CONDITIONS), 1, simulations)[question]


@cache
def first_prompt(condition: str, side: str) -> str:
    scenario = ScenarioConfig()
    seen = World(scenario, CONDITIONS[condition], TRACK).observe(side)
    return render_prompt(seen, None, prompt=prompt_of("baseline"), scenario=scenario)


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


@pytest.mark.slow
@pytest.mark.parametrize("of_speed", [-0.9, -1.4])
def test_twenty_planted_studies_find_the_effect_at_the_stated_rate(of_speed):
    effect = PlantedEffect(x_relative_speed=of_speed)
    of_humans = human().relative_velocity
    stated = chance(Case(human().plus(Effect(relative_velocity=of_speed - of_humans)), 10), "I2")
    found = sum(
        slope.b < 0 and slope.p < 0.05
        for study in range(STUDIES)
        if (slope := who_first_firth(emulated(effect, 10, study)).terms["relative_velocity"])
    )
    low, high = stats.binom.interval(0.99, STUDIES, stated)
    assert low <= found <= high
    assert 0.2 < stated < 1


def test_simulated_trials_scatter_about_their_truth():
    truth = human()._replace(collided=0.1)
    trials = simulate(truth, list(HUMAN_CONDITIONS), 2000, np.random.default_rng(1))
    assert len(trials) == 22_000
    assert (trials["status"] == "collided").mean() == pytest.approx(0.1, abs=0.01)
    who_first, gap = who_first_logit(trials), gap_ols(trials)
    for name, term in who_first.terms.items():
        assert term.b == pytest.approx(getattr(truth, name), abs=4 * term.se)
    for value, term in zip(truth[3:7], gap.terms.values(), strict=True):
        assert term.b == pytest.approx(value, abs=4 * term.se)


@pytest.mark.slow
def test_the_chances_of_humans_are_their_ceiling():
    shares = ceiling((10,) * len(HUMAN_CONDITIONS))["robust"]
    found = Case(human(), 10).chances(list(HUMAN_CONDITIONS), 1, 150)
    for name in TESTED:
        assert found[name] == pytest.approx(shares[name], abs=0.12)


@pytest.mark.slow
def test_the_chance_to_find_nothing_is_that_of_a_false_alarm():
    nothing = 1e-9  # an effect of 0 is no row
    own = human()._replace(relative_velocity=nothing)
    assert chance(Case(own, 10), "I2") < 0.08  # one side of a two-sided test at 5 %
    own = own._replace(gap_m=own.gap_m + nothing, collided=own.collided + nothing)
    found = Case(own, 10, "first", own._replace(gap_m=own.gap_m - 2 * nothing), 10)
    assert chance(found, "gap") == pytest.approx(0.05, abs=0.06)


def test_what_is_the_same_has_no_chance_to_be_told_apart():
    assert Case(human(), 10, "first", human(), 10).effects == {}
    assert Case(human(), 10, HUMANS, human()).effects == {}
    braver = human()._replace(gap_m=9.0, collided=0.5)
    assert list(Case(braver, 10, HUMANS, human()).effects) == ["collisions"]


def powered(tmp_path, study, model=(), simulations=20):
    plan = make_plan(study, model)
    options = Options(db=tmp_path / "none.duckdb", cache=tmp_path / "none")
    expected = asyncio.run(unsent(plan, options, say=print, whole=True))
    return [row.values for row in chances(plan, expected.cost_usd, [], simulations)]


def test_what_is_compared_with_the_humans_is_found_in_the_table_verdicts(tmp_path):
    (tmp_path / "braver.toml").write_text(
        'models = ["idm"]\nrepetitions = 1\n[factors]\nprompt = ["baseline", "A1"]\n'
        "[effect]\nprompt = { collided = 0.4 }\n"
    )
    found = powered(tmp_path, str(tmp_path / "braver.toml"), simulations=1)
    assert {one["table"] for one in found if one["against"] == HUMANS} == {"verdicts"}
    assert {one["table"] for one in found if one["question"] == "collisions"} >= {"contrasts"}


@pytest.mark.slow
def test_a_planted_study_is_told_by_what_is_planted(tmp_path):
    (tmp_path / "planted.toml").write_text(PLANTED)
    found = powered(tmp_path, str(tmp_path / "planted.toml"))
    assert {each["truth"] for each in found} == {"as planted"}
    speeds = {each["arms"]: each for each in found if each["question"] == "I2"}
    strong, weak = speeds["x_relative_speed=-3.3"], speeds["x_relative_speed=-0.2"]
    assert (strong["effect"], weak["effect"]) == (-3.3, -0.2)
    assert strong["enough"] <= strong["trials"] == 110
    assert weak["enough"] is None


@pytest.mark.slow
def test_an_effect_that_the_study_names_beside_a_factor_is_supposed(tmp_path):
    (tmp_path / "named.toml").write_text(NAMED)
    found = powered(tmp_path, str(tmp_path / "named.toml"), simulations=2)
    differ = {
        (each["arms"], each["question"]): each["effect"]
        for each in found
        if each["against"] == "resistance=none baseline"
    }
    assert differ == {
        ("resistance=human baseline", "collisions"): pytest.approx(0.4),
        ("resistance=none A1", "gap"): pytest.approx(2),
        ("resistance=none A1", "relative velocity"): pytest.approx(3),
        ("resistance=human A1", "gap"): pytest.approx(2),
        ("resistance=human A1", "relative velocity"): pytest.approx(3),
        ("resistance=human A1", "collisions"): pytest.approx(0.4),
    }
    (tmp_path / "odd.toml").write_text(NAMED.replace("resistance = {", "resistence = {"))
    with pytest.raises(UsageError, match="resistence"):
        make_plan(str(tmp_path / "odd.toml"), ())


@pytest.mark.slow
def test_equal_arms_share_a_row_and_half_of_the_trials_find_less(tmp_path):
    found = powered(tmp_path, "ablations", ("o3",), simulations=8)
    assert {each["arms"].count(",") for each in found} == {0, 6}
    assert {each["truth"] for each in found} == {"human"}
    (gap,) = (each for each in found if each["question"] == "gap")
    assert gap["times_0.5"] < gap["times_4"] == 100
    assert gap["cost_usd"] > 0


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
    assert "44 trials, an unknown price; 20 simulated studies" in run.out
    found = json.loads((await merge_runner(*few, "--json")).out)
    assert found["cost_usd"] is None
    assert {each["trials"] for each in found["chances"]} == {44}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["experiments"]


def test_the_odds_of_the_emulator_are_those_that_the_humans_are_supposed_to_have():
    assert PlantedEffect().coefficients == human()[:3]


PERSONA = """
repetitions = 4
[factors]
prompt = ["baseline", "hurried"]
x_persona = [{text = "You are late.", x_relative_speed = 2.0}]
[prompts.hurried]
add = [{text = "You are late."}]
"""


@pytest.mark.slow
def test_a_planted_persona_is_supposed_where_the_prompt_contains_it(tmp_path):
    (tmp_path / "persona.toml").write_text(PERSONA)
    found = powered(tmp_path, str(tmp_path / "persona.toml"), simulations=2)
    effects = {each["arms"]: each["effect"] for each in found if each["question"] == "I2"}
    assert effects == {"baseline": -3.3, "hurried": pytest.approx(-1.3)}
