"""How often intervals hold the truth and tests find nothing, in simulated studies."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from benchmarks.ceiling import DATA_SETS, data_sets, shares
from merge_runner_analysis.data.reference_data import published
from merge_runner_analysis.stats.contrasts import contrast_means
from merge_runner_analysis.stats.first_action import exchange_rate, mean, slope
from merge_runner_analysis.stats.intervals import melded
from merge_runner_analysis.stats.regressions import who_first_firth
from tests.support.studies import Drive, changed, write_study
from tests.support.tables import values_of
from tests.unit.analysis.stats.test_contrasts import group
from tests.unit.analysis.stats.test_first_action import HEADWAY, SLOPE, VELOCITY, drawn
from tests.unit.analysis.stats.test_regressions import (
    OVERLAPPING,
    firthmodels,
    who_first_arrays,
)


def test_a_small_group_that_scatters_differs_by_chance_in_one_of_twenty():
    rng, found = np.random.default_rng(5), 0
    for _ in range(400):
        first = group(N_0_0=rng.normal(2, 4, 3), L_4_8=rng.normal(8, 4, 3))
        second = group(N_0_0=rng.normal(2, 1, 30), L_4_8=rng.normal(8, 1, 30))
        found += contrast_means(first, second, "gap_m").p < 0.05
    assert 0.02 * 400 < found < 0.08 * 400


@pytest.mark.parametrize("rates", [(0.02, 0.03), (0.3, 0.03), (0.5, 0.5), (0.0, 0.03)])
def test_a_melded_interval_holds_the_true_difference_in_95_percent(rates):
    """Over all outcomes of 9 trials beside 20."""
    n, m, covered = 9, 20, 0.0
    for a in range(n + 1):
        for b in range(m + 1):
            chance = stats.binom.pmf(a, n, rates[0]) * stats.binom.pmf(b, m, rates[1])
            if chance > 1e-6:
                p = stats.fisher_exact([[a, n - a], [b, m - b]]).pvalue
                low, high = melded((a / n, n), (b / m, m), p)
                covered += chance * (low <= rates[0] - rates[1] <= high)
    assert covered > 0.949


@pytest.mark.parametrize(
    ("estimate", "truth"), [(slope, SLOPE), (mean, 0.0), (exchange_rate, -VELOCITY / HEADWAY)]
)
def test_intervals_of_first_actions_cover_the_truth_as_often_as_they_say(estimate, truth):
    rng = np.random.default_rng(4)
    found = [estimate(drawn(rng)) for _ in range(200)]  # few have separated words, and no rate
    inside = np.mean([one.low < truth < one.high for one in found if one])
    assert 0.9 <= inside <= 0.99  # three standard errors of such a share


@pytest.mark.parametrize("n", [2, 10, 50])
def test_the_script_of_the_ceiling_computes_what_ships(n):
    curve = published("human_ceiling").set_index(["n", "indicator", "rule"])["share"]
    found = shares(n, first=60)
    assert len(found) == 10
    for key, share in found.items():
        low, high = stats.binom.interval(0.999, 60, curve[n, *key])
        assert low <= round(60 * share) <= high


def test_a_data_set_has_so_many_published_outcomes_of_each_condition():
    assert list(next(data_sets(5))["condition"].value_counts()) == [5] * 11
    every = pd.concat(set_ for _, set_ in zip(range(DATA_SETS), data_sets(2), strict=True))
    assert (every["status"] == "collided").mean() == pytest.approx(28 / 990, abs=0.005)
    of_finished = every[every["status"] == "finished"]
    assert (of_finished["merged_first"] == "left").mean() == pytest.approx(465 / 962, abs=0.02)


def test_profile_intervals_are_those_of_firthmodels_and_agree_with_the_tests():
    expected = np.roll(firthmodels(*who_first_arrays(OVERLAPPING)).conf_int(method="pl"), 1, axis=0)
    fit = who_first_firth(OVERLAPPING)
    for (name, term), bounds in zip(fit.terms.items(), expected, strict=True):
        low, high = fit.interval(name, 0.95)
        assert (low, high) == pytest.approx(tuple(bounds), rel=1e-3, abs=1e-3)
        assert (low <= 0 <= high) == (term.p >= 0.05)


PROGRAM = json.dumps({side: {"program": "own", "chance": True} for side in ("left", "right")})


def drives(driver, rng):
    """Trials of a program: who goes first, and how hard either drives, are drawn for each."""
    for condition in ("L_4_-8", "N_0_0", "R_-4_8"):
        for rep in range(1, 7):
            hard, sign = rng.uniform(0.1, 0.6, 2), rng.choice([-1, 1])
            left, right = (sign * hard[0],) * 3, (-sign * hard[1],) * 3
            yield Drive(driver, "baseline", condition, rep, left, right)


def with_prompts(names):
    """Statements after which programs played the same trials with other prompts, too."""
    for name in names:
        for table in ("trials", "states"):
            variant = f", '{name}' AS variant" if table == "trials" else ""
            yield (
                f"INSERT INTO {table} SELECT * REPLACE (replace(trial_id, 'baseline', '{name}') AS "
                f"trial_id, replace(spec_hash, 'baseline', '{name}') AS spec_hash{variant}) "
                f"FROM {table} WHERE trial_id LIKE '%/baseline/%'"
            )
        yield f"INSERT INTO specs VALUES ('one-{name}', '{PROGRAM}'), ('two-{name}', '{PROGRAM}')"


def test_programs_of_one_distribution_differ_in_no_more_studies_than_stated(tmp_path):
    """Each is played with eight prompts that it does not read, from draws of its own.

    A study's tests are correlated, so that 8 % is allowed for a true rate of 5 %.
    """
    rejected, tested = 0, 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        path = tmp_path / f"{seed}.duckdb"
        write_study(path, [*drives("one", rng), *drives("two", rng)])
        study = changed(
            path,
            f"UPDATE specs SET spec = '{PROGRAM}'",
            "UPDATE trials SET source = 'driver'",
            *with_prompts([f"A{number}" for number in range(1, 8)]),
        )
        known = values_of(study, "factors").items()
        rows = [row for name, row in known if name.startswith("model=two/")]
        assert {row["trials"] for row in rows} == {36 // 2}
        p = [row["p"] for row in rows if row.get("p") is not None]
        rejected, tested = rejected + sum(value < 0.05 for value in p), tested + len(p)
    assert tested >= 150
    assert rejected <= 0.08 * tested
