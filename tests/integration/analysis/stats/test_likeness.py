"""I5: whether accelerations are held, and a driver's gains beside those of humans."""

from __future__ import annotations

from dataclasses import replace

import duckdb
import numpy as np
import pandas as pd
import pytest
from scipy import stats

from merge_runner.config import ScenarioConfig
from merge_runner_analysis.data.intermittency import measure_profiles
from merge_runner_analysis.data.load import SPEEDS, load
from merge_runner_analysis.data.study import Study
from merge_runner_analysis.stats.indicators import (
    Verdict,
    compared,
    mean_gain,
    piecewise_constant,
    score,
)
from merge_runner_analysis.stats.indicators import gains as trial_gains
from merge_runner_analysis.tables import make_tables
from tests.support.studies import SCENARIO, write_study, yielding

PAIRS = 9
EACH = 10


def gains(rows) -> pd.DataFrame:
    return pd.DataFrame(rows, columns=["trial_id", "condition", "pair", "gain"])


def humans(seed=1, between=0.1) -> pd.DataFrame:
    """Gains of SD 1 in two conditions whose means differ by 2, and of pairs that differ."""
    rng = np.random.default_rng(seed)
    rows = []
    for pair in range(PAIRS):
        own = rng.normal(0, between)
        for condition, usual in (("N_0_0", 0.0), ("L_4_0", 2.0)):
            for rep in range(EACH):
                trial = f"{pair}/{condition}/{rep}"
                rows.append((trial, condition, f"pair{pair}", usual + own + rng.normal(0, 1)))
    return gains(rows)


def driver(shift, n=200, seed=2, condition="N_0_0") -> pd.DataFrame:
    rng = np.random.default_rng(seed)
    usual = {"N_0_0": 0.0, "L_4_0": 2.0}[condition]
    values = usual + shift + rng.normal(0, 1, n)
    return gains([(f"t{i}", condition, None, value) for i, value in enumerate(values)])


def test_another_mix_of_conditions_is_no_difference():
    """The driver finished in one condition alone, where human gains are higher by 2."""
    found = compared(driver(0, condition="L_4_0"), humans())
    assert found.value == pytest.approx(0, abs=0.2)
    assert found.n == 200


def test_the_unit_is_the_spread_of_human_trials_within_conditions():
    human = humans(between=0)
    twice = human.assign(gain=2 * human["gain"])
    ours = driver(0.4)
    assert compared(ours, human).value == pytest.approx(
        compared(ours.assign(gain=2 * ours["gain"]), twice).value
    )
    apart = human["gain"] - human.groupby("condition")["gain"].transform("mean")
    spread = np.sqrt((apart**2).sum() / (len(human) - 2))
    usual = human.loc[human["condition"] == "N_0_0", "gain"].mean()
    assert compared(ours, human).value == pytest.approx((ours["gain"].mean() - usual) / spread)


def test_the_interval_is_welchs_over_trials_and_pairs():
    human, ours = humans(between=0.5), driver(0.1)
    one = human[human["condition"] == "N_0_0"]
    pairs = one.groupby("pair")["gain"].mean()
    expected = stats.ttest_ind(ours["gain"], pairs, equal_var=False).confidence_interval()
    spread = np.sqrt(((one["gain"] - one["gain"].mean()) ** 2).sum() / (len(one) - 1))
    found = compared(ours, one)
    assert (found.low, found.high) == pytest.approx((expected.low / spread, expected.high / spread))


def test_pairs_that_differ_widen_the_interval():
    narrow, wide = (compared(driver(0), humans(between=between)) for between in (0, 1))
    assert wide.high - wide.low > 2 * (narrow.high - narrow.low)


def test_one_pair_or_one_trial_or_none_cannot_be_compared():
    alone = humans().query("pair == 'pair3'")
    for ours, human in ((driver(0), alone), (driver(0, 1), humans()), (driver(0, 0), humans())):
        assert compared(ours, human).bounds() is None


def test_trials_without_action_do_not_count():
    ours = driver(0)
    still = pd.concat([ours, ours.assign(gain=np.nan)])
    assert compared(still, humans()) == compared(ours, humans())


def driving(tmp_path, **actions) -> Study:
    """One trial in each condition in which the left vehicle slows for 3 s, the right as told."""
    drives = [
        replace(drive, left=(-0.9, -0.6, -0.3), right=actions.get("right", ()))
        for drive in yielding("o3", reps=1)
    ]
    return Study(write_study(tmp_path / "t.duckdb", drives, actions.get("scenario", SCENARIO)))


def test_a_trial_has_the_mean_gain_of_the_vehicles_that_acted(tmp_path):
    study = driving(tmp_path)
    (group,) = study.models
    profiles = study.profiles_of(group).set_index(["trial_id", "side"])
    found = trial_gains(study, group).set_index("trial_id")
    assert len(found) == 11
    for trial in found.index:
        left, right = (profiles.loc[(trial, side)] for side in ("left", "right"))
        assert right["steady"]
        assert found.loc[trial, "gain"] == left["gain"]
        assert not found.loc[trial, "steady"]


def test_both_vehicles_count_where_both_acted(tmp_path):
    study = driving(tmp_path, right=(0.4, 0.0, 0.2))
    (group,) = study.models
    both = study.profiles_of(group).groupby("trial_id")["gain"].agg(["mean", "count"])
    assert (both["count"] == 2).all()
    found = trial_gains(study, group).set_index("trial_id")["gain"]
    assert found.to_dict() == pytest.approx(both.loc[found.index, "mean"].to_dict())


def test_a_model_that_drives_against_the_resistance_is_measured_as_without(tmp_path):
    """Its pedal is held: so are its accelerations, though its speed is nowhere a straight line."""
    study = driving(tmp_path, scenario=ScenarioConfig(resistance="human"), right=(0.4, 0.2, 0.0))
    slowed = load(SPEEDS, study.db)
    assert slowed["resisted"].all()
    with_it = measure_profiles(slowed.assign(resisted=False))["gain"]
    (group,) = study.models
    found = study.profiles_of(group)["gain"]
    assert (found > with_it).mean() > 0.9
    assert (found > 0).all()


@pytest.mark.slow
def test_a_trial_without_action_neither_passes_nor_fails_and_is_told(tmp_path):
    study = driving(tmp_path)
    with duckdb.connect(str(study.db)) as connection:
        connection.execute("UPDATE states SET velocity_mps = 10 WHERE trial_id LIKE '%L_4%'")
    study = Study(study.db)
    (group,) = study.models
    still = trial_gains(study, group).query("steady")
    assert list(still["condition"].sort_values()) == ["L_4_-8", "L_4_0", "L_4_8"]
    assert mean_gain(study, group).n == 8
    (indicators,) = make_tables(study, ["indicators"])
    (row,) = [row for row in indicators.rows if row.id == "o3/baseline/I5"]
    assert "I5 without 3 of 11 trials: no control action" in row.note
    assert (row.values["paper"], row.values["robust"]) == (None, True)
    assert row.values["value"] == mean_gain(study, group).value


@pytest.mark.slow
def test_a_driver_that_never_acts_has_no_number_and_it_is_said_why(tmp_path):
    study = driving(tmp_path)
    with duckdb.connect(str(study.db)) as connection:
        connection.execute("UPDATE states SET velocity_mps = 10")
    study = Study(study.db)
    (indicators,) = make_tables(study, ["indicators"])
    (row,) = [row for row in indicators.rows if row.id == "o3/baseline/I5"]
    assert "no finished trial with control action" in row.note


def test_a_driver_is_judged_by_its_own_accelerations_before_an_import_too(study):
    for group in study.models:
        found = score(study, group)
        assert found.robust["I5"] == Verdict(True)
        assert found.paper["I5"] == Verdict(None)
    human = score(study, study.human)
    assert human.paper["I5"] == Verdict(True, "by eye, the paper")
    assert human.robust["I5"] == Verdict(None, "by eye, the paper")


@pytest.mark.parametrize(
    ("gain", "passed"),
    [
        ([0.2, 0.3, 0.4], True),
        ([-0.2, -0.3, -0.4], False),
        ([-0.1, 0.5, 0.2], False),
        ([0.3, 0.3], True),  # without spread
        ([-0.3, -0.3], False),
    ],
)
def test_i5_is_one_sided_the_mean_gain_is_above_0(monkeypatch, gain, passed):
    rows = gains([(f"t{i}", "N_0_0", None, value) for i, value in enumerate(gain)])
    monkeypatch.setattr("merge_runner_analysis.stats.indicators.gains", lambda study, group: rows)
    assert piecewise_constant(None, None) == Verdict(passed)
