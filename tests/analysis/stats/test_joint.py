"""The joint model of a driver and the humans, against fits of one design and simulated pairs."""

from __future__ import annotations

from functools import cache
from math import inf, sqrt

import numpy as np
import pandas as pd
import pytest
from scipy import stats
from scipy.special import expit
from statsmodels.discrete.discrete_model import Logit
from statsmodels.regression.linear_model import OLS

from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner_analysis.data.imported_humans import RECORDINGS, imported
from merge_runner_analysis.data.reference_data import human_outcomes, published
from merge_runner_analysis.data.study import Group
from merge_runner_analysis.stats.intervals import detectable
from merge_runner_analysis.stats.joint import GAP, WHO_FIRST, interactions
from merge_runner_analysis.stats.regressions import by_pairs, gap_data, gap_ols, who_first_data

H, V = np.array([(c.projected_headway_m, c.relative_velocity_mps) for c in CONDITIONS.values()]).T
# Between pairs of humans: SD of the logit's intercept and of the gap in m, as published (S4, S6).
LOGIT_SD, GAP_SD_M = 0.5, 1.3


def driven(rng, pairs, reps, *, alone=False, gap_more=0.0, turned=0.0) -> pd.DataFrame:
    """Finished trials of pairs who differ; ``alone``: of a copy whose every trial is a new pair."""
    names = np.tile(list(CONDITIONS), reps * pairs)
    h, v = np.tile(H, reps * pairs), np.tile(V, reps * pairs)
    who = np.arange(len(h)) if alone else np.repeat(np.arange(pairs), len(H) * reps)
    bias, offset = rng.normal(0, [[LOGIT_SD], [GAP_SD_M]], (2, who[-1] + 1))[:, who]
    left = rng.random(len(h)) < expit(-0.3 + bias + 0.6 * h - (1.5 + turned) * v)
    gap = 4.1 + gap_more + offset + 0.15 * abs(h) - 0.18 * abs(v) + 0.06 * h * v
    trials = pd.DataFrame(
        {
            "condition": names,
            "projected_headway_m": h,
            "relative_velocity_mps": v,
            "status": "finished",
            "merged_first": np.where(left, "left", "right"),
            "gap_m": gap + rng.normal(0, 1.3, len(h)),
        }
    )
    return trials if alone else trials.assign(pair=[f"pair{i}" for i in who])


def group(trials, setting="baseline", **more) -> Group:
    name = "driver" if setting else "human"
    return Group(name, setting, "s", trials, label=name, models=(name,), name=name, **more)


def humans(trials) -> Group:
    return group(trials, "")


def driver(seed=1, reps=10, **more) -> Group:
    return group(driven(np.random.default_rng(seed), 1, reps, alone=True, **more))


@cache
def not_imported() -> Group:
    return group(human_outcomes(), "", measured=False)


def of(found, outcome):
    chosen = [one for one in found if one.outcome == outcome]
    assert [one.problem for one in chosen] == [""] * len(chosen)
    return chosen


def joined(one, other):
    """The design of both with the source in every term, the second being the source 1."""
    return np.vstack([np.hstack([one, 0 * one]), np.hstack([other, other])])


def test_it_is_the_logit_of_both_with_the_source_in_every_term():
    (x, left), (own, own_left) = (who_first_data(g.outcomes) for g in (not_imported(), driver()))
    fit = Logit(np.concatenate([left, own_left]), joined(x, own)).fit(disp=0)
    found = of(interactions(not_imported(), driver()), WHO_FIRST)
    assert [one.found.by for one in found] == ["ML"] * 3
    assert [one.found.value for one in found] == pytest.approx(fit.params[3:], abs=1e-6)
    assert [one.human for one in found] == pytest.approx(fit.params[:3], abs=1e-6)
    assert [one.driver for one in found] == pytest.approx(fit.params[:3] + fit.params[3:], abs=1e-6)
    assert [one.found.p for one in found] == pytest.approx(fit.pvalues[3:], rel=1e-4)
    bounds = np.array([(one.found.low, one.found.high) for one in found])
    assert bounds == pytest.approx(fit.conf_int()[3:], abs=1e-5)
    assert [(one.n, one.n_human, one.found.freedom) for one in found] == [(110, 962, inf)] * 3


def test_the_gaps_interactions_are_those_of_least_squares_over_both():
    human, own = humans(driven(np.random.default_rng(2), 9, 2)), driver()
    (x, gap, _), (z, own_gap, _) = gap_data(human.trials), gap_data(own.trials)
    fit = OLS(np.concatenate([gap, own_gap]), joined(x, z)).fit()
    found = of(interactions(human, own), GAP)
    assert [one.found.value for one in found] == pytest.approx(fit.params[4:])
    assert [one.human for one in found] == pytest.approx(fit.params[:4])


def test_with_a_pair_for_each_trial_the_jackknife_gives_hc3_errors():
    trials = driver().trials.assign(pair=[f"pair{i}" for i in range(110)])
    found, hc3 = by_pairs(gap_ols, trials, "gap_m"), gap_ols(trials, robust=True)
    for name, term in found.terms.items():
        # HC3 leaves out the factor (n - 1) / n.
        assert term.se == pytest.approx(hc3.terms[name].se * sqrt(109 / 110))


@pytest.mark.parametrize("pairs", [0, 1, 2])
def test_fewer_than_three_pairs_have_no_errors_by_pair(pairs):
    named = [f"pair{i % pairs}" for i in range(110)] if pairs else None
    found = by_pairs(gap_ols, driver().trials.assign(pair=named), "gap_m")
    assert found.terms == {}
    assert found.problem == f"{pairs} pairs are too few for errors by pair"


def leverage_errors(trials):
    """The jackknife's errors without a refit: each pair's residuals, corrected by its leverage."""
    x, gap, chosen = gap_data(trials)
    inverse = np.linalg.inv(x.T @ x)
    residual = gap - x @ inverse @ x.T @ gap
    total = np.zeros((4, 4))
    pairs = chosen["pair"].to_numpy()
    for pair in np.unique(pairs):
        own = x[pairs == pair]
        hat = own @ inverse @ own.T
        moved = inverse @ own.T @ np.linalg.solve(np.eye(len(own)) - hat, residual[pairs == pair])
        total += np.outer(moved, moved)
    g = len(np.unique(pairs))
    return np.sqrt(np.diag(total) * (g - 1) / g)


def test_errors_by_pairs_add_up_with_those_of_the_driver():
    human, own = humans(driven(np.random.default_rng(2), 9, 2)), driver()
    mine, theirs = gap_ols(own.trials, robust=True).terms.values(), leverage_errors(human.trials)
    for one, term, se in zip(of(interactions(human, own), GAP), mine, theirs, strict=True):
        total = term.se**2 + se**2
        # Satterthwaite: 9 pairs have 8 degrees of freedom, 110 trials and 4 terms 106.
        freedom = total**2 / (term.se**4 / 106 + se**4 / 8)
        half = stats.t.ppf(0.975, freedom) * sqrt(total)
        assert one.found.freedom == pytest.approx(freedom)
        assert (one.found.low, one.found.high) == pytest.approx(
            (one.found.value - half, one.found.value + half)
        )
        assert one.found.p == pytest.approx(
            2 * stats.t.sf(abs(one.found.value) / sqrt(total), freedom)
        )
        assert "9 pairs" in one.remark


def test_before_an_import_the_gap_is_compared_with_the_published_regression():
    found = of(interactions(not_imported(), driver()), GAP)
    rows = published("paper_gap").query("driver == 'human'").set_index("term")
    mine = gap_ols(driver().trials, robust=True).terms
    for one in found:
        b, se = rows.loc[one.term, ["b", "se"]].astype(float)
        assert (one.human, one.n_human) == (b, 962)
        assert one.found.value == pytest.approx(mine[one.term].b - b)
        total = sqrt(mine[one.term].se ** 2 + se**2)
        half = stats.t.ppf(0.975, one.found.freedom) * total
        assert one.found.high - one.found.value == pytest.approx(half)
        assert "as published" in one.remark


def test_unknown_pairs_are_said_to_make_the_intervals_too_narrow():
    found = interactions(not_imported(), driver())
    assert len(found) == 7
    assert all("not published" in one.remark and "too narrow" in one.remark for one in found)


def partly(pairs) -> Group:
    trials = driven(np.random.default_rng(3), pairs, 1)
    assert not imported(trials.assign(origin=RECORDINGS)).complete
    return group(trials, "", published_outcomes=human_outcomes())


def test_of_a_partial_import_the_gaps_count_and_the_published_outcomes_stay():
    found = interactions(partly(3), driver())
    assert {one.n_human for one in of(found, GAP)} == {33}
    assert {one.n_human for one in of(found, WHO_FIRST)} == {962}
    assert all("3 pairs" in one.remark for one in of(found, GAP))
    assert of(found, WHO_FIRST) == of(interactions(not_imported(), driver()), WHO_FIRST)


def test_two_pairs_are_no_reference_for_the_gap():
    found = interactions(partly(2), driver())
    assert {one.n_human for one in of(found, GAP)} == {962}
    assert of(found, GAP) == of(interactions(not_imported(), driver()), GAP)


def separated() -> Group:
    """Who is ahead goes first, and else who is slower: without an exception."""
    trials = driver(reps=4).trials
    ahead = trials["projected_headway_m"] - 2 * trials["relative_velocity_mps"]
    left = (ahead > 0) | ((ahead == 0) & (np.arange(len(trials)) % 2 == 0))
    return group(trials.assign(merged_first=np.where(left, "left", "right")))


def test_a_difference_from_a_separated_driver_is_not_estimable_and_has_no_number():
    for human in (not_imported(), humans(driven(np.random.default_rng(2), 9, 2))):
        found = [one for one in interactions(human, separated()) if one.outcome == WHO_FIRST]
        assert [(one.found, one.driver, one.human) for one in found] == [(None, None, None)] * 3
        assert all(one.problem.startswith("separation: no finite estimate") for one in found)
        assert len(of(interactions(human, separated()), GAP)) == 4


def without(trials):
    return group(trials.assign(status="collided", merged_first=None, gap_m=np.nan))


DEGENERATE = {
    "no finished trial": without(driver().trials),
    "the left vehicle merged first in all 110 trials": group(
        driver().trials.assign(merged_first="left")
    ),
    "too few conditions": group(driver().trials.query("condition == 'N_0_0'")),
    "1 finished trial": group(driver().trials.head(1)),
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("reason", DEGENERATE)
def test_data_that_allow_no_comparison_give_a_reason(reason):
    found = interactions(not_imported(), DEGENERATE[reason])
    lacking = [one for one in found if one.problem]
    assert {one.term for one in lacking} >= {"intercept", "projected_headway", "relative_velocity"}
    assert any(reason in one.problem for one in lacking)
    assert {one.found for one in lacking} == {None}


def test_humans_whose_fit_hangs_on_one_pair_are_no_reference_for_who_merges_first():
    trials = driven(np.random.default_rng(2), 3, 2)
    ahead = np.where(trials["projected_headway_m"] > 0, "left", "right")
    trials.loc[trials["pair"] != "pair0", "merged_first"] = ahead[trials["pair"] != "pair0"]
    found = interactions(humans(trials), driver())
    lacking = [one for one in found if one.outcome == WHO_FIRST]
    assert {one.found for one in lacking} == {None}
    assert all(one.problem.startswith("humans: without pair0: separation") for one in lacking)


def test_the_detectable_difference_is_found_in_four_of_five_studies():
    found = of(interactions(not_imported(), driver()), WHO_FIRST)
    for one in found:
        se = (one.found.high - one.found.value) / stats.norm.ppf(0.975)
        assert stats.norm.sf(stats.norm.ppf(0.975) - one.found.detectable / se) == pytest.approx(
            0.8
        )
    # Few degrees of freedom cost power: the exact power is that of the noncentral t.
    found = 1 - stats.nct.cdf(stats.t.ppf(0.975, 8), 8, detectable(1.0, 8))
    assert found == pytest.approx(0.8, abs=0.02)
