"""Data sets fitted at once are fitted as they are one by one, also in a study's own conditions."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from scipy import stats
from scipy.optimize import minimize
from scipy.special import expit

from merge_runner_analysis.stats.contrasts import contrast_means
from merge_runner_analysis.stats.many_fits import (
    Draws,
    firth_differences,
    firth_fits,
    gap_fits,
    logit_fits,
    mean_gap_differences,
)
from merge_runner_analysis.stats.regressions import (
    WHO_FIRST_TERMS,
    gap_ols,
    who_first_data,
    who_first_firth,
    who_first_logit,
)

HEADWAYS = np.array([-3.0, -1.0, 0.0, 0.5, 2.0, 3.0])
VELOCITIES = np.array([0.5, -0.4, 0.0, 1.2, -1.2, 0.3])
SETS = 6


def trials(rng, size, of_speed):
    """One data set of a study with conditions of its own."""
    at = np.repeat(np.arange(len(HEADWAYS)), size)
    h, dv = HEADWAYS[at], VELOCITIES[at]
    left = rng.random(len(at)) < expit(-0.3 + 1.1 * h + of_speed * dv)
    return pd.DataFrame(
        {
            "cell": at,
            "condition": at.astype(str),
            "projected_headway_m": h,
            "relative_velocity_mps": dv,
            "status": "finished",
            "merged_first": np.where(left, "left", "right"),
            "gap_m": rng.normal(4 + 0.3 * np.abs(h), 1.5),
        }
    )


def draws(tables):
    sums = np.zeros((4, len(tables), len(HEADWAYS)))
    for i, table in enumerate(tables):
        for cell, rows in table.groupby("cell"):
            left = (rows["merged_first"] == "left").sum()
            sums[:, i, cell] = len(rows), left, rows["gap_m"].sum(), (rows["gap_m"] ** 2).sum()
    return Draws(*sums, HEADWAYS, VELOCITIES)


@pytest.fixture(scope="module")
def tables():
    rng = np.random.default_rng(1)
    return [trials(rng, 8, -1.0) for _ in range(SETS)]


def test_fits_at_once_are_those_one_by_one_to_a_millionth(tables):
    together = draws(tables)
    ols, hc3 = gap_fits(together)
    for at_once, alone in (
        (logit_fits(together), who_first_logit),
        (ols, gap_ols),
        (hc3, lambda table: gap_ols(table, robust=True)),
    ):
        compared = 0
        for i, table in enumerate(tables):
            fit = alone(table)
            for j, term in enumerate(fit.terms.values()):
                assert at_once.b[i, j] == pytest.approx(term.b, abs=1e-6)
                assert at_once.p[i, j] == pytest.approx(term.p, abs=1e-6)
                compared += 1
        assert compared > SETS


def maximum(design, left, free):
    """Firth's penalised likelihood and its place, found by an optimiser that knows no weights."""

    def penalised(some):
        b = np.zeros(design.shape[1])
        b[free] = some
        linear = design @ b
        p = expit(linear)
        information = design.T @ (design * (p * (1 - p))[:, None])
        return np.logaddexp(0, linear).sum() - left @ linear - np.linalg.slogdet(information)[1] / 2

    # Differences of a likelihood that is known to 16 digits leave 8 of the place.
    found = minimize(penalised, np.zeros(len(free)), method="Powell", tol=1e-14)
    return -found.fun, found.x


def fitted(design, left):
    """Coefficients, and p-values of the slopes, of one data set."""
    every = list(range(design.shape[1]))
    best, b = maximum(design, left, every)
    ratios = [best - maximum(design, left, [o for o in every if o != at])[0] for at in every[1:]]
    return b, stats.chi2.sf(2 * np.array(ratios), 1)


def test_penalised_fits_at_once_are_those_one_by_one_to_a_millionth(tables):
    found = firth_fits(draws(tables))
    assert found.sound.all()
    for i, table in enumerate(tables):
        b, p = fitted(*who_first_data(table))
        assert found.b[i] == pytest.approx(b, abs=1e-6)
        assert found.p[i, 1:] == pytest.approx(p, abs=1e-6)
        alone = who_first_firth(table).terms.values()
        assert found.b[i] == pytest.approx([term.b for term in alone], abs=1e-5)
        assert found.p[i, 1:] == pytest.approx([term.p for term in alone][1:], abs=1e-5)


@pytest.mark.slow
def test_differences_at_once_are_those_of_one_model_of_both_groups(tables):
    rng = np.random.default_rng(2)
    others = [trials(rng, 5, 0.5) for _ in range(SETS)]
    found = [firth_differences(draws(tables), draws(others), term) for term in WHO_FIRST_TERMS[1:]]
    assert all(each.sound.all() for each in found)
    for i in range(SETS):
        (own, own_left), (rest, rest_left) = who_first_data(tables[i]), who_first_data(others[i])
        design = np.block([[rest, 0 * rest], [own, own]])
        b, p = fitted(design, np.concatenate([rest_left, own_left]))
        for at, each in enumerate(found, start=1):
            assert each.b[i] == pytest.approx(b[3:], abs=1e-5)
            assert each.p[i, at] == pytest.approx(p[2 + at], abs=1e-6)


def test_mean_gaps_differ_at_once_as_in_the_linear_model_of_one_by_one(tables):
    rng = np.random.default_rng(3)
    others = [trials(rng, 3, 0.5).query("cell != 2") for _ in range(SETS)]
    found, p = mean_gap_differences(draws(tables), draws(others))
    for i in range(SETS):
        alone = contrast_means(tables[i], others[i], "gap_m")
        assert found[i] == pytest.approx(alone.value, abs=1e-9)
        assert p[i] == pytest.approx(alone.p, abs=1e-9)
