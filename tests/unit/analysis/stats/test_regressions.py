"""The regressions against printed figures and against computations that share no code with them."""

from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from firthmodels import FirthLogisticRegression, detect_separation

from analysis.research.independent.recompute_statistics import equivalence_p, joint_p, least_squares
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner_analysis.published import human_outcomes
from merge_runner_analysis.stats.firth import Counts
from merge_runner_analysis.stats.regressions import (
    gap_ols,
    who_first_firth,
    who_first_logit,
)
from tests.support.outcomes import COLUMNS, frame, who_first_arrays

# A library's warning must not reach the user: what it warns of is a problem in words.
pytestmark = pytest.mark.filterwarnings("error", "ignore::ResourceWarning")

CELLS = [(c.projected_headway_m, c.relative_velocity_mps) for c in CONDITIONS.values()]
WHO_FIRST = ["intercept", "projected_headway", "relative_velocity"]
GAP = ["intercept", "abs_projected_headway", "abs_relative_velocity", "headway_x_velocity"]
BOTH_FITS = pytest.mark.parametrize("fit", [who_first_logit, who_first_firth])
ROBUST = pytest.mark.parametrize("robust", [False, True])


def drawn(seed, reps, intercept, headway, velocity) -> pd.DataFrame:
    """Finished trials of all conditions, who was first drawn from a logit."""
    rng = np.random.default_rng(seed)
    rows = []
    for h, dv in CELLS * reps:
        left = rng.random() < 1 / (1 + np.exp(-(intercept + headway * h + velocity * dv)))
        rows.append((h, dv, "finished", "left" if left else "right", rng.normal(4, 1.8)))
    return frame(rows)


def ruled(reps, first) -> pd.DataFrame:
    """Finished trials of all conditions; ``first(h, dv, rep)`` says who was first."""
    rows = [
        (h, dv, "finished", first(h, dv, rep), 4.0 + rep) for rep in range(reps) for h, dv in CELLS
    ]
    return frame(rows)


def of_gaps(reps, gap_of, cells=CELLS) -> pd.DataFrame:
    """Finished trials with gaps of ``gap_of(h, dv)``, and some noise of SD 1 where it takes it."""
    rng = np.random.default_rng(11)
    rows = [(h, dv, "finished", "left", gap_of(h, dv, rng.normal())) for h, dv in cells * reps]
    return frame(rows)


HUMANS, OVERLAPPING = human_outcomes(), drawn(1, 5, 0.4, 0.6, -1.5)
SEPARATED = ruled(5, lambda h, dv, rep: "left" if h - 3 * dv > 0.1 else "right")


def numbers(fit, names):
    """Estimates, standard errors and p-values of a fit."""
    assert fit.problem is None
    assert list(fit.terms) == names
    terms = fit.terms.values()
    return [t.b for t in terms], [t.se for t in terms], [t.p for t in terms]


def no_fit(fit, reason):
    assert fit.terms == {}
    assert reason in str(fit.problem)


def firthmodels(design, left):
    return FirthLogisticRegression(max_iter=1000, gtol=1e-6, xtol=1e-6).fit(design[:, 1:], left)


def peer(design, left):
    """Estimates, errors and p-values of firthmodels."""
    fit = firthmodels(design, left)
    b = np.array([fit.intercept_, *fit.coef_])
    p = 1 / (1 + np.exp(-design @ b))
    errors = np.sqrt(np.diag(np.linalg.inv(design.T @ (design * (p * (1 - p))[:, None]))))
    return b, errors, np.roll(fit.lrt().lrt_pvalues_, 1)  # it puts the intercept's last


# Who merges first


def test_the_human_counts_give_the_papers_logit_to_the_printed_digits():
    fit = who_first_logit(HUMANS)
    assert fit.n == 962
    assert [f"{t.b:.3f} {t.se:.3f} {t.statistic:.2f}" for t in fit.terms.values()] == [
        "-0.304 0.135 -2.26", "1.111 0.075 14.89", "-3.304 0.310 -10.64",
    ]  # fmt: skip
    assert f"{fit.terms['intercept'].p:.3f}" == "0.024"


@BOTH_FITS
def test_only_finished_trials_with_a_first_merger_count(fit):
    others = [
        (4.0, 0.8, "collided", None, None),
        (4.0, 0.8, "collided", "right", None),
        (4.0, 0.8, "timeout", "right", None),
        (4.0, 0.8, "failed", "right", None),
        (4.0, 0.8, "finished", None, 3.0),
    ]
    assert fit(pd.concat([OVERLAPPING, frame(others)])) == fit(OVERLAPPING)
    assert fit(OVERLAPPING).n == 55


def test_the_penalised_fit_gives_the_published_endometrial_figures():
    """Heinze and Schemper (2002), endometrial cancer: NV, PI and EH of 79 patients."""
    patients = pd.read_csv(Path(__file__).with_name("data") / "endometrial.csv")
    design = np.column_stack([np.ones(79), patients[["NV", "PI", "EH"]]])
    fit = Counts(design, np.ones(79), patients["HG"].to_numpy(float)).fit()
    assert fit.b == pytest.approx([3.7745594, 2.9292733, -0.0347517, -2.6041638], abs=2e-6)
    p = [fit.p(term) for term in (1, 2, 3)]
    assert p == pytest.approx([0.009124, 0.387482, 0.0000251], rel=2e-3)


COUNTS = [5, 1, 5, 1, 5, 4, 2, 1, 5, 2, 2]


@pytest.mark.parametrize(
    "trials",
    [
        pytest.param(HUMANS, id="humans"),
        pytest.param(SEPARATED, id="separated"),
        pytest.param(
            frame([(h, dv, "finished", "left" if h + 3 * dv > 0.1 else "right", 4.0)
                   for (h, dv), n in zip(CELLS, COUNTS, strict=True) for _ in range(n)]),
            id="of many iterations",
        ),
    ],
)  # fmt: skip
def test_the_penalised_fit_is_that_of_firthmodels(trials):
    finished = trials[trials["status"] == "finished"]
    fit = who_first_firth(trials)
    assert fit.n == len(finished)
    for found, expected in zip(
        numbers(fit, WHO_FIRST), peer(*who_first_arrays(finished)), strict=True
    ):
        assert found == pytest.approx(expected, rel=1e-3, abs=1e-3)
    assert [term.statistic for term in fit.terms.values()] == [None] * 3


def test_a_difference_of_groups_is_the_interaction_of_a_penalised_model_of_both():
    own, rest = drawn(7, 4, 0.2, 0.9, -1.0), drawn(8, 6, 0.0, 0.5, -2.0)
    (x, x_left), (y, y_left) = who_first_arrays(own), who_first_arrays(rest)
    model = firthmodels(np.block([[y, 0 * y], [x, x]]), np.concatenate([y_left, x_left])).lrt()
    terms = who_first_firth(own, less=rest).terms.values()
    assert [term.b for term in terms] == pytest.approx(model.coef_[2:], rel=1e-3, abs=1e-3)
    assert [term.p for term in terms] == pytest.approx(model.lrt_pvalues_[2:5], rel=1e-3)
    no_fit(
        who_first_firth(own, less=rest.iloc[:2]),
        "2 finished trials in which one went first: too",
    )


def test_separation_is_found_where_firthmodels_finds_it():
    separated = 0
    for seed in range(30):
        trials = drawn(seed, 2, *np.random.default_rng(seed).normal(0, 2, 3))
        design, left = who_first_arrays(trials)
        expected = ~np.roll(detect_separation(design[:, 1:], left).is_finite, 1)
        infinite = Counts(design, np.ones(len(left)), left).infinite()
        assert infinite.tolist() == expected.tolist()
        separated += infinite.any()
    assert 5 < separated < 25


def level_at_5(h, dv, rep):
    """The left is first where h > 5 dv, and either side where h = 5 dv."""
    order = h - 5 * dv
    return ("left" if rep % 2 else "right") if order == 0 else ("left", "right")[order < 0]


def test_separation_names_the_terms_without_an_estimate_and_leaves_the_penalised_fit():
    says = "separation: no finite estimate of projected_headway, relative_velocity"
    no_fit(who_first_logit(SEPARATED), f"{says}, intercept")
    no_fit(who_first_logit(ruled(4, level_at_5)), f"{says};")
    assert who_first_firth(SEPARATED).terms


@BOTH_FITS
@pytest.mark.parametrize("side", ["left", "right"])
def test_one_side_always_first_leaves_nothing_to_explain(fit, side):
    no_fit(fit(ruled(2, lambda h, dv, rep: side)), "who merged first is the same in all 22 trials")


# The gap

# With more noise where the headway is larger.
GAPS = of_gaps(5, lambda h, dv, e: 3.5 + 0.2 * abs(h) - 0.4 * abs(dv) + h * dv / 10 + e * abs(h))


@ROBUST
def test_the_gap_is_regressed_by_least_squares_with_plain_or_hc3_errors(robust):
    fit = gap_ols(GAPS, robust=robust)
    h, dv = (GAPS[name].to_numpy() for name in COLUMNS[:2])
    x = np.column_stack([np.ones(len(h)), abs(h), abs(dv), h * dv])
    plain, hc3, covariance = least_squares(x, GAPS["gap_m"].to_numpy())
    found = [[term.b, term.se, term.statistic, term.p] for term in fit.terms.values()]
    assert np.array(found) == pytest.approx(hc3 if robust else plain)
    assert ([*fit.terms], fit.n, fit.freedom) == (GAP, 55, 51)
    if robust:
        assert fit.velocity_p == pytest.approx(joint_p(hc3[2:, 0], covariance[2:, 2:], 51))
        rows = [
            x[i] - x[j] for i, j in product(range(11), repeat=2) if h[i] == h[j] and dv[i] > dv[j]
        ]
        expected = equivalence_p(hc3[:, 0], covariance, np.array(rows), 51)
        assert fit.equivalence_p == pytest.approx(expected)


@ROBUST
def test_only_finished_trials_with_a_gap_count(robust):
    others = [
        (4.0, 0.8, "collided", None, 99.0),
        (4.0, 0.8, "timeout", "left", 99.0),
        (4.0, 0.8, "failed", None, 99.0),
        (4.0, 0.8, "finished", "left", np.nan),
        (4.0, 0.8, "finished", "left", None),
    ]
    assert gap_ols(pd.concat([GAPS, frame(others)]), robust=robust) == gap_ols(GAPS, robust=robust)


@ROBUST
def test_gaps_that_vary_by_less_than_a_centimetre_leave_nothing_to_test(robust):
    for gap in (0.0, 0.1, 8.37, 1234.5):
        for reps in (1, 7):
            equal = of_gaps(reps, lambda h, dv, e, gap=gap: gap)
            no_fit(gap_ols(equal, robust=robust), "the gaps vary by less than 1 cm")
    shares = np.random.default_rng(6).permutation(np.linspace(0, 1, 22))
    trials = of_gaps(2, lambda h, dv, e: 4.0)
    no_fit(gap_ols(trials.assign(gap_m=4 + 0.0099 * shares), robust=robust), "less than 1 cm")
    assert gap_ols(trials.assign(gap_m=4 + 0.0101 * shares), robust=robust).terms


@ROBUST
def test_a_gap_that_is_not_finite_is_named(robust):
    gaps = GAPS.assign(gap_m=[np.inf, *GAPS["gap_m"][1:]])
    no_fit(gap_ols(gaps, robust=robust), "a gap is not finite")


def test_a_single_trial_that_decides_a_coefficient_has_no_hc3_errors():
    """Only one trial has equal speeds."""
    cells = [cell for cell in CELLS if cell[1]] * 3 + [(0.0, 0.0)]
    trials = of_gaps(1, lambda h, dv, e: 4 + e, cells)
    no_fit(gap_ols(trials, robust=True), "a single trial decides a coefficient")
    assert gap_ols(trials).terms


@ROBUST
def test_the_gap_needs_more_trials_than_coefficients(robust):
    cells = [(4.0, 0.8), (-4.0, 0.8), (0.0, 0.0), (4.0, 0.0), (0.0, 0.8)]
    trials = of_gaps(1, lambda h, dv, e: 4 + e, cells)
    no_fit(gap_ols(trials[:4], robust=robust), "4 trials with a gap")
    assert gap_ols(trials).freedom == 1


# Too little data

EVERY_FIT = pytest.mark.parametrize(
    "fit", [who_first_logit, who_first_firth, gap_ols, lambda trials: gap_ols(trials, robust=True)]
)


@EVERY_FIT
def test_too_little_data_are_said(fit):
    collided = frame([(h, dv, "collided", None, None) for h, dv in CELLS])
    for trials in (collided, collided[:0]):
        no_fit(fit(trials), "no ")
        assert fit(trials).n == 0
    no_fit(fit(frame([(4.0, 0.8, "finished", "left", 3.0)])), "1 ")
    one_cell = [(4.0, 0.8, "finished", ("left", "right")[k % 2], 4.0 + k) for k in range(20)]
    no_fit(
        fit(frame(one_cell)),
        "too few, or in too few situations, to estimate effects of headway and speed",
    )
    if fit in (who_first_logit, who_first_firth):  # as many trials as coefficients
        few = OVERLAPPING.iloc[[0, 1, 5]].assign(merged_first=["left", "right", "left"])
        no_fit(fit(few), "3 finished trials in which one went first")
