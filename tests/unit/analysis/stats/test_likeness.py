"""A driver's gains of I5 beside those of humans."""

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from merge_runner_analysis.stats.indicators import likeness

PAIRS = 9
EACH = 10
USUAL = {"N_0_0": 0.0, "L_4_0": 2.0}


def gains(rows) -> pd.DataFrame:
    return pd.DataFrame(rows, columns=["trial_id", "condition", "pair", "gain"])


def humans(seed=1, between=0.1) -> pd.DataFrame:
    """Gains of SD 1 in two conditions whose means differ by 2, and of pairs that differ."""
    rng = np.random.default_rng(seed)
    rows = []
    for pair in range(PAIRS):
        own = rng.normal(0, between)
        for condition, usual in USUAL.items():
            for rep in range(EACH):
                trial = f"{pair}/{condition}/{rep}"
                rows.append((trial, condition, f"pair{pair}", usual + own + rng.normal(0, 1)))
    return gains(rows)


def driver(shift, n=200, condition="N_0_0") -> pd.DataFrame:
    values = USUAL[condition] + shift + np.random.default_rng(2).normal(0, 1, n)
    return gains([(f"t{i}", condition, None, value) for i, value in enumerate(values)])


def test_another_mix_of_conditions_is_no_difference_and_trials_without_action_do_not_count():
    """The driver finished in one condition alone, where human gains are higher by 2."""
    ours = driver(0, condition="L_4_0")
    found = likeness(ours, humans())
    assert (found.value, found.n) == (pytest.approx(0, abs=0.2), 200)
    assert likeness(pd.concat([ours, ours.assign(gain=np.nan)]), humans()) == found


def test_the_unit_is_the_spread_of_human_trials_within_conditions():
    human, ours = humans(between=0), driver(0.4)
    found = likeness(ours, human).value
    twice = [one.assign(gain=2 * one["gain"]) for one in (ours, human)]
    assert likeness(*twice).value == pytest.approx(found)
    apart = human["gain"] - human.groupby("condition")["gain"].transform("mean")
    spread = np.sqrt((apart**2).sum() / (len(human) - 2))
    usual = human.loc[human["condition"] == "N_0_0", "gain"].mean()
    assert found == pytest.approx((ours["gain"].mean() - usual) / spread)


def test_the_interval_is_welchs_over_trials_and_pairs():
    human, ours = humans(between=0.5), driver(0.1)
    one = human[human["condition"] == "N_0_0"]
    pairs = one.groupby("pair")["gain"].mean()
    expected = stats.ttest_ind(ours["gain"], pairs, equal_var=False).confidence_interval()
    spread = np.sqrt(((one["gain"] - one["gain"].mean()) ** 2).sum() / (len(one) - 1))
    found = likeness(ours, one)
    assert (found.low, found.high) == pytest.approx((expected.low / spread, expected.high / spread))


def test_one_pair_or_one_trial_or_none_cannot_be_compared():
    alone = humans().query("pair == 'pair3'")
    for ours, human in ((driver(0), alone), (driver(0, 1), humans()), (driver(0, 0), humans())):
        assert likeness(ours, human).bounds() is None
