"""Profile intervals of Firth's fit, against an optimiser that shares no code with it."""

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy import stats
from scipy.optimize import minimize
from scipy.special import expit

from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner_analysis.stats.regressions import who_first_firth
from tests.support.outcomes import frame, who_first_arrays

CELLS = [(one.projected_headway_m, one.relative_velocity_mps) for one in HUMAN_CONDITIONS.values()]
TERMS = ("intercept", "projected_headway", "relative_velocity")
RNG = np.random.default_rng(1)
# Directions and sizes of the starts: a profile of few trials has maxima near and far.
STARTS = RNG.standard_normal((3000, 3)) * 10 ** RNG.uniform(-1, 2, (3000, 1))


def likelihood(design, left, b) -> np.ndarray:
    """Firth's penalised log-likelihood of coefficients, (..., terms)."""
    linear = b @ design.T
    weights = expit(linear) * expit(-linear)
    information = np.einsum("...r,ri,rj->...ij", weights, design, design)
    with np.errstate(divide="ignore"):
        sign, penalty = np.linalg.slogdet(information)
    found = (left * linear - np.logaddexp(0, linear)).sum(axis=-1) + penalty / 2
    return np.where((sign > 0) & (penalty > -575), found, -1e9)


def highest(design, left, held: int | None = None, value=0.0) -> float:
    """The highest penalised log-likelihood of all, or with one coefficient held at a value."""

    def placed(free):
        return free if held is None else np.insert(free, held, value, axis=-1)

    starts = STARTS if held is None else STARTS[:, :2]
    order = np.argsort(-likelihood(design, left, placed(starts)))[:25]
    found = (
        minimize(lambda free: -likelihood(design, left, placed(free)), start, method="Nelder-Mead",
                 options={"xatol": 1e-7, "fatol": 1e-10})
        for start in starts[order]
    )  # fmt: skip
    return max(-one.fun for one in found)


def trials_of(*left: int, right: Sequence[int]) -> list[tuple[int, bool]]:
    """Trials of conditions, by their numbers, in which the left or the right went first."""
    return [*((cell, True) for cell in left), *((cell, False) for cell in right)]


@settings(max_examples=12, deadline=None)
@given(
    st.lists(st.tuples(st.integers(0, 10), st.booleans()), min_size=6, max_size=14),
    st.sampled_from([0, 1, 2]),
    st.sampled_from([0.9, 0.95, 0.99]),
)
# The maximum that is reached from the estimate is not the highest one.
@example(trials_of(0, 8, 8, 9, right=(2, 4, 4, 4)), 2, 0.95)
@example(trials_of(9, 10, 10, right=(0, 0, 1, 2, 2, 3, 4, 6)), 1, 0.99)
def test_the_likelihood_ratio_at_each_end_of_an_interval_is_the_quantile(trials, term, level):
    """Also of few trials, whose profiles have several maxima."""
    sides = ((*CELLS[cell], "left" if left else "right") for cell, left in trials)
    rows = frame([(h, dv, "finished", side, 4.0) for h, dv, side in sides])
    fit = who_first_firth(rows)
    ends = fit.interval(TERMS[term], level)
    if fit.problem:
        assert ends is None
        return
    design, left = who_first_arrays(rows)
    top = highest(design, left.to_numpy())
    for end in ends:
        lost = 2 * (top - highest(design, left.to_numpy(), term, end))
        assert lost == pytest.approx(stats.chi2.ppf(level, 1), abs=1e-4)
