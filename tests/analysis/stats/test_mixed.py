"""The mixed models against likelihoods that are written down and integrated independently."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from scipy import integrate, optimize, stats

from analysis.data.reference_data import published
from analysis.stats.mixed import gap_mixed, who_first_mixed
from analysis.stats.regressions import gap_ols, who_first_logit
from merge_runner.scenarios.merge.conditions import CONDITIONS

pytestmark = pytest.mark.filterwarnings("error")

CELLS = [(c.projected_headway_m, c.relative_velocity_mps) for c in CONDITIONS.values()]
BIASES = (-1.6, 0.9, 2.0, -0.7)  # of the pairs, for the left vehicle to go first
FITS = pytest.mark.parametrize("fit", [gap_mixed, who_first_mixed])


def of_pairs(seed, pairs=4, reps=2) -> pd.DataFrame:
    """Finished trials of pairs that differ in who goes first and in their gaps."""
    rng = np.random.default_rng(seed)
    rows = []
    for pair in range(pairs):
        bias, offset = BIASES[pair % 4], rng.normal(0, 1.3)
        for h, dv in CELLS * reps:
            left = rng.random() < 1 / (1 + np.exp(-(0.3 + 0.6 * h - 1.5 * dv + bias)))
            gap = 4 + 0.2 * abs(h) - 0.3 * abs(dv) + 0.1 * h * dv + offset + rng.normal(0, 1.2)
            rows.append((h, dv, "finished", "left" if left else "right", gap, f"pair{pair}"))
    columns = ["projected_headway_m", "relative_velocity_mps", "status", "merged_first"]
    return pd.DataFrame(rows, columns=[*columns, "gap_m", "pair"])


def estimates(fit):
    assert fit.problem == ""
    return [term.b for term in fit.terms.values()], [term.se for term in fit.terms.values()]


def restricted(trials):
    """Estimates and errors of the gap, by restricted likelihood with the full covariance."""
    h, dv = trials["projected_headway_m"].to_numpy(), trials["relative_velocity_mps"].to_numpy()
    x, y = np.column_stack([np.ones(len(h)), abs(h), abs(dv), h * dv]), trials["gap_m"].to_numpy()
    same = np.equal.outer(trials["pair"].to_numpy(), trials["pair"].to_numpy()).astype(float)

    def solved(logs):
        covariance = np.exp(logs[0]) * np.eye(len(y)) + np.exp(logs[1]) * same
        weights = np.linalg.inv(covariance)
        information = x.T @ weights @ x
        b = np.linalg.solve(information, x.T @ weights @ y)
        residual = y - x @ b
        loss = np.linalg.slogdet(covariance)[1] + np.linalg.slogdet(information)[1]
        return loss + residual @ weights @ residual, b, information

    best = optimize.minimize(lambda logs: solved(logs)[0], [0.0, 0.0], method="Nelder-Mead")
    _, b, information = solved(best.x)
    return b, np.sqrt(np.diag(np.linalg.inv(information)))


def hessian(function, at, step=5e-3):
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


class Marginal:
    """The likelihood of who goes first with a normal intercept per pair, integrated out."""

    def __init__(self, trials):
        self.pairs = []
        for _, rows in trials.groupby("pair"):
            h, dv = rows["projected_headway_m"], rows["relative_velocity_mps"]
            x = np.column_stack([np.ones(len(rows)), h, dv])
            self.pairs.append((x, 1.0 * (rows["merged_first"] == "left").to_numpy()))

    @staticmethod
    def joint(u, parameters, x, left):
        """Likelihood of a pair's trials times the density of its standardised intercept."""
        linear = (x @ parameters[:3])[:, None] + np.exp(parameters[3]) * np.atleast_1d(u)
        log = (left[:, None] * linear - np.logaddexp(0, linear)).sum(axis=0)
        return np.exp(log - np.atleast_1d(u) ** 2 / 2) / np.sqrt(2 * np.pi)

    def by_quadrature(self, parameters):
        def joint(u, *pair):
            return self.joint(u, parameters, *pair)[0]

        precise = {"epsabs": 0, "epsrel": 1e-10, "points": [-2, 0, 2]}
        return sum(
            np.log(integrate.quad(joint, -8, 8, args=pair, **precise)[0]) for pair in self.pairs
        )

    def on_a_grid(self, parameters):
        grid, step = np.linspace(-8, 8, 801, retstep=True)
        return sum(np.log(self.joint(grid, parameters, *pair).sum() * step) for pair in self.pairs)


def test_the_gaps_mixed_model_is_fitted_by_restricted_likelihood():
    for seed in (0, 1):
        trials = of_pairs(seed)
        b, errors = restricted(trials)
        found, found_errors = estimates(gap_mixed(trials))
        assert found == pytest.approx(b, rel=1e-3, abs=1e-3)
        assert found_errors == pytest.approx(errors, rel=2e-3)


def test_pairs_widen_the_intercepts_error_and_narrow_the_slopes():
    trials = of_pairs(0, pairs=6)
    mixed, plain = gap_mixed(trials).terms, gap_ols(trials).terms
    assert mixed["intercept"].se > 1.2 * plain["intercept"].se
    assert mixed["abs_projected_headway"].se < plain["abs_projected_headway"].se


def test_the_mixed_logit_is_the_maximum_of_the_integrated_likelihood():
    """11 trials of each pair, and pairs that differ much: a normal approximation would be off."""
    trials = of_pairs(3, reps=1)
    likelihood = Marginal(trials)
    best = optimize.minimize(
        lambda b: -likelihood.on_a_grid(b), [0.0, 0.5, -0.5, 0.0], options={"gtol": 1e-7}
    ).x
    assert np.exp(best[3]) > 2
    highest = likelihood.by_quadrature(best)
    assert likelihood.on_a_grid(best) == pytest.approx(highest, abs=1e-7)
    # By quadrature too it falls off to all sides.
    for move in np.vstack([np.eye(4), -np.eye(4)]) * 0.02:
        assert likelihood.by_quadrature(best + move) < highest
    errors = np.sqrt(np.diag(np.linalg.inv(-hessian(likelihood.on_a_grid, best))))
    found, found_errors = estimates(who_first_mixed(trials))
    assert found == pytest.approx(best[:3], rel=1e-4)
    assert found_errors == pytest.approx(errors[:3], rel=1e-3)


def test_pairs_that_do_not_differ_give_the_plain_logit():
    """All pairs drove alike, so that the intercept's variance is estimated as none."""
    one = of_pairs(4, pairs=1, reps=3)
    trials = pd.concat([one.assign(pair=pair) for pair in ("a", "b", "c")])
    found, errors = estimates(who_first_mixed(trials))
    plain, plain_errors = estimates(who_first_logit(trials))
    assert found == pytest.approx(plain, rel=1e-3, abs=1e-3)
    assert errors == pytest.approx(plain_errors, rel=2e-2)


def test_gaps_of_pairs_that_do_not_differ_give_the_pooled_slopes():
    """Three equal pairs: the variance between them is 0, at the edge of what it can be."""
    one = of_pairs(4, pairs=1, reps=3)
    trials = pd.concat([one.assign(pair=pair) for pair in ("a", "b", "c")])
    assert "the pairs do not differ" in gap_mixed(trials).remark
    found, errors = estimates(gap_mixed(trials))
    plain, plain_errors = estimates(gap_ols(trials))
    assert found == pytest.approx(plain, rel=1e-3, abs=1e-3)
    assert errors == pytest.approx(plain_errors, rel=1e-2)


@FITS
def test_terms_are_tested_by_the_normal_distribution(fit):
    for term in fit(of_pairs(4)).terms.values():
        assert term.statistic == pytest.approx(term.b / term.se)
        assert term.p == pytest.approx(2 * stats.norm.sf(abs(term.b / term.se)))


def test_separated_pairs_give_no_logit_but_the_reason():
    trials = of_pairs(4, pairs=9)
    side = np.where(trials["projected_headway_m"] > 0, "left", "right")
    found = who_first_mixed(trials.assign(merged_first=side))
    assert found.terms == {}
    assert "separation" in found.problem


@FITS
def test_only_finished_trials_count(fit):
    trials = of_pairs(4)
    others = trials.assign(status="collided", pair="pair9", gap_m=50.0)
    found = fit(pd.concat([trials, others]))
    assert found.n == 88
    assert found == fit(trials)


@FITS
@pytest.mark.parametrize("pairs", [0, 1, 2])
def test_fewer_than_three_pairs_are_too_few(fit, pairs):
    found = fit(of_pairs(4, pairs=4).query("pair < @name", local_dict={"name": f"pair{pairs}"}))
    assert found.terms == {}
    assert found.problem == f"{pairs} pairs are too few for a random intercept"


@FITS
def test_trials_of_no_pair_have_no_random_intercept(fit):
    found = fit(of_pairs(4).assign(pair=None))
    assert found.terms == {}
    assert found.problem == "0 pairs are too few for a random intercept"


@FITS
def test_one_condition_cannot_tell_the_terms_apart(fit):
    found = fit(of_pairs(4).query("projected_headway_m == 4 and relative_velocity_mps == 0"))
    assert found.terms == {}
    assert found.problem.endswith("too few conditions to tell the terms apart")


def test_the_published_mixed_models_load():
    tables = published("human_mixed_models").set_index(["table", "term"])
    rows = tables.apply(tuple, axis=1).to_dict()
    assert rows == {
        ("S4", "intercept"): (-0.32, 0.212),
        ("S4", "projected_headway"): (1.15, 0.08),
        ("S4", "relative_velocity"): (-3.413, 0.321),
        ("S6", "intercept"): (4.13, 0.45),
        ("S6", "abs_projected_headway"): (0.15, 0.04),
        ("S6", "abs_relative_velocity"): (-0.18, 0.17),
        ("S6", "headway_x_velocity"): (0.18, 0.03),
    }
