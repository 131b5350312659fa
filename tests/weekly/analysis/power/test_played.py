"""Simulated studies find what studies that are played find, at the stated rate."""

import json
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from merge_runner.emulator.driver import answer
from merge_runner.planted_effect import PlantedEffect
from merge_runner.records import SIDES, Slot
from merge_runner.scenarios.merge.conditions import CONDITIONS, HUMAN_CONDITIONS
from merge_runner.study.file import Effect
from merge_runner_analysis.power import power
from merge_runner_analysis.power.cases import Case, Contrast, Played
from merge_runner_analysis.power.truth import human, played, simulate
from merge_runner_analysis.stats.regressions import gap_ols, who_first_firth
from merge_runner_analysis.study import StudyResults
from tests.support.emulator_fixtures import first_prompt

REPS, STUDIES = 10, 20


def chance(case, question, simulations=150):
    return power(case, 1, simulations)[question]


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


@pytest.mark.parametrize("of_speed", [-0.9, -1.4])
def test_twenty_planted_studies_find_the_effect_at_the_stated_rate(of_speed):
    effect = PlantedEffect(x_relative_speed=of_speed)
    of_humans = human().relative_velocity
    truth = human().plus(Effect(relative_velocity=of_speed - of_humans), [])
    stated = chance(Case(truth, tuple(HUMAN_CONDITIONS), REPS), "I2")
    found = sum(
        slope.b < 0 and slope.p < 0.05
        for study in range(STUDIES)
        if (slope := who_first_firth(emulated(effect, REPS, study)).terms["relative_velocity"])
    )
    low, high = stats.binom.interval(0.99, STUDIES, stated)
    assert low <= found <= high
    assert 0.2 < stated < 1


def test_the_chance_to_find_nothing_is_that_of_a_false_alarm():
    nothing = 1e-5  # an effect of 0 is no row
    own = replace(human(), relative_velocity=nothing)
    assert (
        chance(Case(own, tuple(HUMAN_CONDITIONS), REPS), "I2") < 0.08
    )  # one side of a two-sided test at 5 %
    same = (Played("", "left", False, tuple(HUMAN_CONDITIONS), REPS, own),)
    for measure in ("gap", "goes first"):
        found = Contrast(same, same, measure, "default")
        assert chance(found, measure) == pytest.approx(0.05, abs=0.06)


def test_the_gaps_of_a_driver_as_played_scatter_as_those_that_it_left(prepare, tmp_path):
    study = ("baseline", "--model", "cei", "--reps", REPS, "--db", "cei.duckdb", "--json")
    assert prepare(tmp_path, "sweep", *study).code == 0
    told = prepare(tmp_path, "power", *study, "--sims", 20)
    rows = json.loads(told.out)["chances"]
    assert {row["truth"] for row in rows} == {"human", "cei/baseline as played"}
    (group,) = StudyResults(tmp_path / "cei.duckdb").models
    again = simulate(played(group), list(HUMAN_CONDITIONS), REPS, np.random.default_rng(1))
    errors = [
        gap_ols(trials, robust=True).terms["abs_projected_headway"].se
        for trials in (group.trials, again)
    ]
    assert errors[0] / errors[1] == pytest.approx(1, abs=0.3)
