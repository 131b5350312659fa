"""Differences between two groups of trials: exact and permutation tests, and corrections."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy import stats

SEED = 260409609
PERMUTATIONS = 9999
LEVEL = 0.95


@dataclass(frozen=True, slots=True)
class Contrast:
    """A difference (first minus second) with its 95 % interval and a two-sided p-value."""

    difference: float
    low: float | None
    high: float | None
    p: float


def contrast_rates(first: tuple[int, int], second: tuple[int, int]) -> Contrast:
    """Two rates, (successes, n) each: Fisher's exact test, Newcombe's score interval (1998)."""
    from statsmodels.stats.proportion import confint_proportions_2indep

    (a, n), (b, m) = first, second
    low, high = confint_proportions_2indep(a, n, b, m, method="newcomb", alpha=1 - LEVEL)
    p = stats.fisher_exact([[a, n - a], [b, m - b]]).pvalue
    return Contrast(a / n - b / m, float(low), float(high), float(p))


def contrast_means(first: pd.DataFrame, second: pd.DataFrame, measure: str) -> Contrast:
    """Two means: a permutation test within conditions, and Welch's interval.

    The groups are shuffled within each condition alone, so that another mix of conditions, as when
    one group collides more in some, cannot make a difference. Seeded.
    """
    a, b = first.dropna(subset=[measure]), second.dropna(subset=[measure])
    x, y = a[measure].to_numpy(float), b[measure].to_numpy(float)
    difference = float(x.mean() - y.mean())
    interval: tuple[float | None, float | None] = (None, None)
    if min(len(x), len(y)) > 1 and x.std() + y.std() > 0:
        welch = stats.ttest_ind(x, y, equal_var=False).confidence_interval(LEVEL)
        interval = float(welch.low), float(welch.high)
    return Contrast(difference, *interval, _permutation_p(a, b, measure))


def _permutation_p(a: pd.DataFrame, b: pd.DataFrame, measure: str) -> float:
    """Share of shuffles, the observed one included, with as large a difference of means."""
    rng = np.random.default_rng(SEED)
    sums = np.zeros(PERMUTATIONS)
    both = pd.concat([a, b])
    total = float(both[measure].sum())
    for condition in sorted(both["condition"].unique()):
        values = both.loc[both["condition"] == condition, measure].to_numpy(float)
        chosen = int((a["condition"] == condition).sum())
        order = np.argsort(rng.random((PERMUTATIONS, len(values))), axis=1)[:, :chosen]
        sums += values[order].sum(axis=1)
    differences = sums / len(a) - (total - sums) / len(b)
    observed = abs(float(a[measure].mean() - b[measure].mean()))
    extreme = int((np.abs(differences) >= observed - 1e-12).sum())
    return (extreme + 1) / (PERMUTATIONS + 1)


def corrected(p: list[float]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A family's p-values by Holm (1979) and by Benjamini and Hochberg (1995)."""
    from statsmodels.stats.multitest import multipletests

    return multipletests(p, method="holm")[1], multipletests(p, method="fdr_bh")[1]
