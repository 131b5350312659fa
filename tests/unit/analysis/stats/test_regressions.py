"""The regressions against printed figures and against computations that share no code with them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from firthmodels import FirthLogisticRegression, detect_separation
from scipy import optimize, stats

from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner_analysis.data.reference_data import human_outcomes
from merge_runner_analysis.stats.regressions import (
    Counts,
    gap_ols,
    who_first_firth,
    who_first_logit,
)

# A library's warning must not reach the user: what it warns of is a problem in words.
pytestmark = pytest.mark.filterwarnings("error")

CELLS = [(c.projected_headway_m, c.relative_velocity_mps) for c in CONDITIONS.values()]
COLUMNS = ["projected_headway_m", "relative_velocity_mps", "status", "merged_first", "gap_m"]
WHO_FIRST = ["intercept", "projected_headway", "relative_velocity"]
GAP = ["intercept", "abs_projected_headway", "abs_relative_velocity", "headway_x_velocity"]
# Heinze and Schemper (2002), endometrial cancer.
ENDOMETRIAL = {
    "estimates": [3.7745594, 2.9292733, -0.0347517, -2.6041638],
    "p": [0.009124, 0.387482, 0.0000251],  # of NV, PI and EH
}


def frame(rows) -> pd.DataFrame:
    return pd.DataFrame(rows, columns=COLUMNS)


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
    rng = np.random.default_rng(5)
    return frame(
        [
            (h, dv, "finished", first(h, dv, rep), rng.normal(4, 1.8))
            for rep in range(reps)
            for h, dv in CELLS
        ]
    )


def who_first_arrays(trials):
    h, dv = trials["projected_headway_m"], trials["relative_velocity_mps"]
    return np.column_stack([np.ones(len(trials)), h, dv]), 1.0 * (trials["merged_first"] == "left")


def numbers(fit, names):
    """Estimates, standard errors and p-values of a fit."""
    assert fit.problem == ""
    assert list(fit.terms) == names
    terms = fit.terms.values()
    return ([t.b for t in terms], [t.se for t in terms], [t.p for t in terms])


def no_fit(fit, reason):
    assert fit.terms == {}
    assert reason in fit.problem


# Independent computations


def log_likelihood(b, design, left):
    linear = design @ b
    return (left * linear - np.logaddexp(0, linear)).sum()


def hessian(function, at, step=1e-3):
    """Second derivatives by central differences."""
    moves = np.eye(len(at)) * step
    return np.array(
        [
            [
                function(at + i + j) - function(at + i - j) - function(at - i + j)
                + function(at - i - j)
                for j in moves
            ]
            for i in moves
        ]
    ) / (4 * step**2)  # fmt: skip


def peer(design, left):
    """Estimates, errors and p-values of firthmodels."""
    fit = FirthLogisticRegression(max_iter=1000, gtol=1e-6, xtol=1e-6).fit(design[:, 1:], left)
    b = np.array([fit.intercept_, *fit.coef_])
    p = 1 / (1 + np.exp(-design @ b))
    errors = np.sqrt(np.diag(np.linalg.inv(design.T @ (design * (p * (1 - p))[:, None]))))
    return b, errors, np.roll(fit.lrt().lrt_pvalues_, 1)  # it puts the intercept's last


def least_squares(trials, *, robust):
    """OLS or HC3 of the gap by plain linear algebra: estimates, errors, t, p."""
    h, dv = (trials[name].to_numpy() for name in COLUMNS[:2])
    x, y = np.column_stack([np.ones(len(h)), abs(h), abs(dv), h * dv]), trials["gap_m"].to_numpy()
    inverse = np.linalg.inv(x.T @ x)
    b = np.linalg.lstsq(x, y, rcond=None)[0]
    residual = y - x @ b
    if robust:
        leverage = np.diag(x @ inverse @ x.T)
        covariance = inverse @ x.T @ np.diag((residual / (1 - leverage)) ** 2) @ x @ inverse
    else:
        covariance = inverse * (residual @ residual) / (len(y) - 4)
    errors = np.sqrt(np.diag(covariance))
    return b, errors, b / errors, 2 * stats.t.sf(abs(b / errors), len(y) - 4)


# Who merges first


def test_the_human_counts_give_the_papers_logit_to_the_printed_digits():
    fit = who_first_logit(human_outcomes())
    assert fit.n == 962
    printed = {
        "intercept": ("-0.304", "0.135", "-2.26"),
        "projected_headway": ("1.111", "0.075", "14.89"),
        "relative_velocity": ("-3.304", "0.310", "-10.64"),
    }
    assert printed == {
        name: (f"{term.b:.3f}", f"{term.se:.3f}", f"{term.statistic:.2f}")
        for name, term in fit.terms.items()
    }
    assert f"{fit.terms['intercept'].p:.3f}" == "0.024"


def test_28_of_990_human_trials_collided():
    collided = (human_outcomes()["status"] == "collided").sum()
    assert (collided, len(human_outcomes())) == (28, 990)
    assert round(100 * collided / 990, 2) == 2.83


@pytest.mark.parametrize(
    "trials", [human_outcomes(), drawn(1, 5, 0.4, 0.6, -1.5)], ids=["humans", "55 trials"]
)
def test_the_logit_is_the_maximum_of_the_likelihood_with_wald_tests(trials):
    finished = trials[trials["status"] == "finished"]
    data = who_first_arrays(finished)
    best = optimize.minimize(lambda b: -log_likelihood(b, *data), np.zeros(3), method="BFGS")
    errors = np.sqrt(np.diag(np.linalg.inv(hessian(lambda b: -log_likelihood(b, *data), best.x))))
    b, se, p = numbers(who_first_logit(trials), WHO_FIRST)
    assert b == pytest.approx(best.x, rel=1e-3)
    assert se == pytest.approx(errors, rel=1e-3)
    assert p == pytest.approx(2 * stats.norm.sf(np.abs(best.x / errors)), rel=0.05)


@pytest.mark.parametrize("fit", [who_first_logit, who_first_firth])
def test_with_the_sides_swapped_only_the_intercept_changes_its_sign(fit):
    trials = drawn(2, 5, 0.7, 0.6, -1.0)
    swapped = trials.assign(
        projected_headway_m=-trials["projected_headway_m"],
        relative_velocity_mps=-trials["relative_velocity_mps"],
        merged_first=trials["merged_first"].map({"left": "right", "right": "left"}),
    )
    b, se, p = numbers(fit(trials), WHO_FIRST)
    mirrored = numbers(fit(swapped), WHO_FIRST)
    assert b[0] > 0.2
    assert mirrored[0] == pytest.approx([-b[0], b[1], b[2]], rel=1e-3)
    assert mirrored[1:] == (pytest.approx(se, rel=1e-3), pytest.approx(p, rel=1e-3))


@pytest.mark.parametrize("fit", [who_first_logit, who_first_firth])
def test_only_finished_trials_with_a_first_merger_count(fit):
    trials = drawn(3, 5, 0.0, 0.5, -1.0)
    others = [
        (4.0, 0.8, "collided", None, None),
        (4.0, 0.8, "collided", "right", None),
        (4.0, 0.8, "timeout", "right", None),
        (4.0, 0.8, "failed", "right", None),
        (4.0, 0.8, "finished", None, 3.0),
    ]
    assert fit(pd.concat([trials, frame(others)])) == fit(trials)
    assert fit(trials).n == 55


def test_the_penalised_fit_gives_the_published_endometrial_figures():
    patients = pd.read_csv(Path(__file__).with_name("data") / "endometrial.csv")
    assert len(patients) == 79
    design = np.column_stack([np.ones(79), patients[["NV", "PI", "EH"]]])
    left = patients["HG"].to_numpy(float)
    fit = Counts(design, np.ones(79), left).fit()
    assert fit.b == pytest.approx(ENDOMETRIAL["estimates"], abs=2e-6)
    assert [fit.p(term) for term in (1, 2, 3)] == pytest.approx(ENDOMETRIAL["p"], rel=2e-3)


@pytest.mark.parametrize(
    "trials",
    [
        pytest.param(human_outcomes(), id="humans"),
        pytest.param(drawn(1, 5, 0.4, 0.6, -1.5), id="unseparated"),
        pytest.param(
            ruled(5, lambda h, dv, rep: "left" if h - 3 * dv > 0.1 else "right"), id="separated"
        ),
        pytest.param(
            ruled(4, lambda h, dv, rep: "left" if h + dv + rep % 2 > 0.5 else "right"),
            id="quasi-separated",
        ),
    ],
)
def test_the_penalised_fit_is_that_of_firthmodels(trials):
    finished = trials[trials["status"] == "finished"]
    b, errors, p = peer(*who_first_arrays(finished))
    fit = who_first_firth(trials)
    assert fit.n == len(finished)
    found = numbers(fit, WHO_FIRST)
    assert found[0] == pytest.approx(b, rel=1e-3, abs=1e-3)
    assert found[1] == pytest.approx(errors, rel=1e-3)
    assert found[2] == pytest.approx(p, rel=1e-3)
    assert [term.statistic for term in fit.terms.values()] == [None] * 3


@pytest.mark.parametrize(
    "trials",
    [
        pytest.param(drawn(1, 5, 0.4, 0.6, -1.5), id="unseparated"),
        pytest.param(
            ruled(5, lambda h, dv, rep: "left" if h - 3 * dv > 0.1 else "right"), id="separated"
        ),
    ],
)
def test_profile_intervals_are_those_of_firthmodels_and_agree_with_the_tests(trials):
    design, left = who_first_arrays(trials)
    model = FirthLogisticRegression(max_iter=1000, gtol=1e-6, xtol=1e-6).fit(design[:, 1:], left)
    expected = np.roll(model.conf_int(method="pl"), 1, axis=0)
    fit = who_first_firth(trials)
    for (name, term), bounds in zip(fit.terms.items(), expected, strict=True):
        low, high = fit.interval(name, 0.95)
        assert (low, high) == pytest.approx(tuple(bounds), rel=1e-3, abs=1e-3)
        assert (low <= 0 <= high) == (term.p >= 0.05)


def test_a_difference_of_groups_is_the_interaction_of_a_penalised_model_of_both():
    own, rest = drawn(7, 4, 0.2, 0.9, -1.0), drawn(8, 6, 0.0, 0.5, -2.0)
    (x, x_left), (y, y_left) = who_first_arrays(own), who_first_arrays(rest)
    design = np.block([[y, 0 * y], [x, x]])[:, 1:]
    model = FirthLogisticRegression(max_iter=1000, gtol=1e-6, xtol=1e-6)
    model.fit(design, np.concatenate([y_left, x_left])).lrt()
    terms = who_first_firth(own, less=rest).terms
    assert [term.b for term in terms.values()] == pytest.approx(model.coef_[2:], rel=1e-3, abs=1e-3)
    p = model.lrt_pvalues_[2:5]
    assert [term.p for term in terms.values()] == pytest.approx(p, rel=1e-3)
    no_fit(who_first_firth(own, less=rest.iloc[:2]), "2 finished trials with a first merger, too")


def test_small_and_separated_data_have_intervals_about_their_estimates_or_none():
    for seed in range(12):
        few, others = (
            drawn(seed + k, 1, *np.random.default_rng(seed).normal(0, 3, 3)) for k in (0, 50)
        )
        for fit in (who_first_firth(few), who_first_firth(few, less=others)):
            for name, term in fit.terms.items():
                found = fit.interval(name, 0.95)
                assert found is None or found[0] < term.b < found[1]


def test_the_penalised_fit_takes_the_iterations_that_separation_needs():
    counts = [5, 1, 5, 1, 5, 4, 2, 1, 5, 2, 2]
    rows = [
        (h, dv, "finished", "left" if h + 3 * dv > 0.1 else "right", 4.0)
        for (h, dv), n in zip(CELLS, counts, strict=True)
        for _ in range(n)
    ]
    b, _, _ = numbers(who_first_firth(frame(rows)), WHO_FIRST)
    assert b == pytest.approx(peer(*who_first_arrays(frame(rows)))[0], rel=1e-3)


def test_separation_is_found_where_firthmodels_finds_it():
    separated = 0
    for seed in range(60):
        trials = drawn(seed, 2, *np.random.default_rng(seed).normal(0, 2, 3))
        design, left = who_first_arrays(trials)
        expected = ~np.roll(detect_separation(design[:, 1:], left).is_finite, 1)
        infinite = Counts(design, np.ones(len(left)), left).infinite()
        assert infinite.tolist() == expected.tolist()
        separated += infinite.any()
    assert 10 < separated < 50


def test_complete_separation_is_named_and_leaves_the_penalised_fit():
    trials = ruled(5, lambda h, dv, rep: "left" if h - 3 * dv > 0.1 else "right")
    no_fit(
        who_first_logit(trials),
        "separation: no finite estimate of projected_headway, relative_velocity, intercept",
    )
    assert who_first_firth(trials).terms


def test_quasi_separation_names_the_terms_without_an_estimate():
    """The left is first where h > 5 dv, and both sides are where h = 5 dv: the level is known."""

    def first(h, dv, rep):
        order = h - 5 * dv
        return ("left" if rep % 2 else "right") if order == 0 else ("left", "right")[order < 0]

    fit = who_first_logit(ruled(4, first))
    no_fit(fit, "separation: no finite estimate of projected_headway, relative_velocity;")
    assert "intercept" not in fit.problem


@pytest.mark.parametrize("fit", [who_first_logit, who_first_firth])
@pytest.mark.parametrize("side", ["left", "right"])
def test_one_side_always_first_leaves_nothing_to_explain(fit, side):
    no_fit(fit(ruled(2, lambda h, dv, rep: side)), "who merged first is the same in all 22 trials")


# The gap


@pytest.fixture(scope="module")
def gaps() -> pd.DataFrame:
    """55 finished trials, with more noise where the headway is larger."""
    rng = np.random.default_rng(11)
    rows = [
        (h, dv, "finished", "left", 3.5 + 0.2 * abs(h) - 0.4 * abs(dv) + 0.1 * h * dv
         + rng.normal() * (0.5 + abs(h)))
        for h, dv in CELLS * 5
    ]  # fmt: skip
    return frame(rows)


def test_the_gap_is_regressed_by_ordinary_least_squares(gaps):
    fit = gap_ols(gaps)
    b, errors, t, p = least_squares(gaps, robust=False)
    assert numbers(fit, GAP) == tuple(pytest.approx(values) for values in (b, errors, p))
    assert [term.statistic for term in fit.terms.values()] == pytest.approx(t)
    assert (fit.n, fit.freedom) == (55, 51)


def test_robust_errors_of_the_gap_are_hc3_with_t_tests(gaps):
    fit = gap_ols(gaps, robust=True)
    b, errors, t, p = least_squares(gaps, robust=True)
    assert numbers(fit, GAP) == tuple(pytest.approx(values) for values in (b, errors, p))
    assert [term.statistic for term in fit.terms.values()] == pytest.approx(t)
    assert (fit.n, fit.freedom) == (55, 51)
    assert fit.terms["intercept"].se != pytest.approx(gap_ols(gaps).terms["intercept"].se, rel=0.1)


def test_the_product_of_the_gap_is_signed():
    """A gap that grows by h * dv: of |h| * |dv| it would be a fifth, with a large residual."""
    rng = np.random.default_rng(4)
    rows = [(h, dv, "finished", "left", 6 + h * dv + rng.normal(0, 0.01)) for h, dv in CELLS * 3]
    fit = gap_ols(frame(rows))
    assert [term.b for term in fit.terms.values()] == pytest.approx([6, 0, 0, 1], abs=0.02)


def test_the_gap_does_not_depend_on_the_signs_of_its_main_effects():
    rng = np.random.default_rng(4)
    rows = [
        (h, dv, "finished", "left", 6 + abs(h) / 2 - abs(dv) + rng.normal(0, 0.01))
        for h, dv in CELLS * 3
    ]
    fit = gap_ols(frame(rows))
    assert [term.b for term in fit.terms.values()] == pytest.approx([6, 0.5, -1, 0], abs=0.02)


@pytest.mark.parametrize("robust", [False, True])
def test_only_finished_trials_with_a_gap_count(gaps, robust):
    others = [
        (4.0, 0.8, "collided", None, 99.0),
        (4.0, 0.8, "timeout", "left", 99.0),
        (4.0, 0.8, "failed", None, 99.0),
        (4.0, 0.8, "finished", "left", np.nan),
        (4.0, 0.8, "finished", "left", None),
    ]
    assert gap_ols(pd.concat([gaps, frame(others)]), robust=robust) == gap_ols(gaps, robust=robust)


@pytest.mark.parametrize("robust", [False, True])
@pytest.mark.parametrize("gap", [0.0, 0.1, 3.7, 8.37, 1234.5])
def test_equal_gaps_leave_nothing_to_test(gap, robust):
    for reps in (1, 7):
        rows = [(h, dv, "finished", "left", gap) for h, dv in CELLS * reps]
        no_fit(gap_ols(frame(rows), robust=robust), "the gaps vary by less than 1 cm")


@pytest.mark.parametrize("robust", [False, True])
def test_gaps_that_vary_by_a_centimetre_are_fitted(robust):
    shares = np.random.default_rng(6).permutation(np.linspace(0, 1, 2 * len(CELLS)))
    for range_m, problem in ((0.0099, "the gaps vary by less than 1 cm"), (0.0101, "")):
        rows = [
            (h, dv, "finished", "left", 4 + range_m * share)
            for (h, dv), share in zip(CELLS * 2, shares, strict=True)
        ]
        fit = gap_ols(frame(rows), robust=robust)
        assert fit.problem.startswith(problem)
        assert bool(fit.terms) == (not problem)


@pytest.mark.parametrize("robust", [False, True])
def test_a_gap_that_is_not_finite_is_named(gaps, robust):
    gaps = gaps.assign(gap_m=[np.inf, *gaps["gap_m"][1:]])
    no_fit(gap_ols(gaps, robust=robust), "a gap is not finite")


def test_a_single_trial_that_decides_a_coefficient_has_no_hc3_errors():
    """Only one trial has equal speeds."""
    cells = [cell for cell in CELLS if cell[1]] * 3 + [(0.0, 0.0)]
    rng = np.random.default_rng(1)
    trials = frame([(h, dv, "finished", "left", rng.normal(4, 1)) for h, dv in cells])
    no_fit(gap_ols(trials, robust=True), "a single trial decides a coefficient")
    assert gap_ols(trials).terms


@pytest.mark.parametrize("robust", [False, True])
def test_the_gap_needs_more_trials_than_coefficients(robust):
    rng = np.random.default_rng(1)
    cells = [(4.0, 0.8), (-4.0, 0.8), (0.0, 0.0), (4.0, 0.0), (0.0, 0.8)]
    trials = frame([(h, dv, "finished", "left", rng.normal(4, 1)) for h, dv in cells])
    no_fit(gap_ols(trials[:4], robust=robust), "4 finished trials with a gap")
    assert gap_ols(trials).freedom == 1


# Too little data

FITS = {
    "logit": who_first_logit,
    "firth": who_first_firth,
    "ols": gap_ols,
    "hc3": lambda trials: gap_ols(trials, robust=True),
}
every_fit = pytest.mark.parametrize("fit", FITS.values(), ids=FITS)


@every_fit
def test_no_finished_trial_is_said(fit):
    collided = frame([(h, dv, "collided", None, None) for h, dv in CELLS])
    for trials in (collided, collided[:0]):
        no_fit(fit(trials), "no finished trial with a ")
        assert fit(trials).n == 0


@every_fit
def test_one_trial_is_too_few(fit):
    no_fit(fit(frame([(4.0, 0.8, "finished", "left", 3.0)])), "1 finished trial with a ")


@pytest.mark.parametrize("fit", [who_first_logit, who_first_firth])
def test_as_many_trials_as_coefficients_are_too_few(fit):
    cells = [(4.0, 0.8), (0.0, 0.0), (0.0, -0.8)]
    sides = ("left", "right", "left")
    rows = [(*cell, "finished", side, 3.0) for cell, side in zip(cells, sides, strict=True)]
    no_fit(fit(frame(rows)), "3 finished trials with a first merger")


@every_fit
def test_one_condition_cannot_tell_the_terms_apart(fit):
    rng = np.random.default_rng(1)
    rows = [(4.0, 0.8, "finished", ("left", "right")[k % 2], rng.normal(4, 1)) for k in range(20)]
    no_fit(fit(frame(rows)), "too few or in too few conditions to tell the terms apart")


@every_fit
def test_small_samples_give_finite_terms_or_a_reason(fit):
    for seed in range(25):
        rng = np.random.default_rng(seed)
        n = int(rng.integers(2, 23))
        trials = drawn(seed, 2, *rng.normal(0, 2, 3)).sample(n, random_state=1)
        found = fit(trials)
        assert bool(found.terms) != bool(found.problem)
        for term in found.terms.values():
            assert np.isfinite([term.b, term.se, term.p]).all()
            assert term.se > 0
