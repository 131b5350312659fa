"""Estimates of a group of trials by a metric, and the published ones of humans."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from merge_runner_analysis.cache import remembered
from merge_runner_analysis.facts import Fact, Why
from merge_runner_analysis.grouping import Group
from merge_runner_analysis.metrics import BOXES, JUDGED, Metric
from merge_runner_analysis.published import citation, published
from merge_runner_analysis.stats.estimate import Array, Estimate
from merge_runner_analysis.stats.intervals import LEVEL, mean
from merge_runner_analysis.stats.intervals import estimate as interval_of
from merge_runner_analysis.stats.score_interval import wilson

PAPER = "paper_ablation_quantitative"


def trials_of(group: Group, metric: Metric) -> pd.DataFrame:
    """Return the trials that have a metric; for humans, the published outcomes if they have it."""
    return group.outcomes if metric.column in group.outcomes else group.trials


def values(group: Group, metric: Metric) -> pd.Series:
    """Return the values of the trials that count; all counts of trials are of these."""
    return trials_of(group, metric)[metric.column].dropna()


def counts(group: Group, metric: Metric) -> tuple[int, int]:
    """Return the successes and n of a rate."""
    sample = values(group, metric)
    return int(sample.astype(bool).sum()), len(sample)


@remembered
def estimate(group: Group, metric: Metric) -> Estimate:
    """Return the metric of a group with its 95 % interval, rates in percent.

    With undecided trials a rate has an interval of both worst cases, and no value (Manski 1989).
    """
    if metric.estimator == "mean":
        trials = trials_of(group, metric)
        return _ratio(trials, metric) if metric.weight else mean_of(trials, metric.column)
    sample = values(group, metric).to_numpy(float)
    if metric.estimator == "median":
        return median(sample)
    k, cut_off = float(sample.sum()), undecided(group, metric)
    if not (every := len(sample) + cut_off):
        return Estimate()
    low, high = wilson(k / every, every)[0], wilson((k + cut_off) / every, every)[1]
    value = None if cut_off else 100 * k / every
    return Estimate(value, 100 * low, 100 * high, len(sample), k=int(k), undecided=cut_off)


def _ratio(trials: pd.DataFrame, metric: Metric) -> Estimate:
    """Return the weighted mean of trials, with the interval of a ratio of sums."""
    known = trials[[metric.column, metric.weight_column]].dropna()
    value, weight = known[metric.column], known[metric.weight_column]
    sample = linear(value.to_numpy(), weight.to_numpy(), np.zeros(len(known), int))
    k = round(float((value * weight).sum()) / 100)
    return replace(mean(sample), k=k)


def linear(value: Array, weight: Array, cells: NDArray[np.int_]) -> Array:
    """Return values with a cell's ratio as their mean (linearised; Cochran 1977)."""
    _, cells = np.unique(cells, return_inverse=True)
    sums, weights = np.bincount(cells, value * weight), np.bincount(cells, weight)
    ratio, mean_weight = (sums / weights)[cells], (weights / np.bincount(cells))[cells]
    return np.asarray(ratio + (value - ratio) * weight / mean_weight)


def mean_of(trials: pd.DataFrame, column: str, shares: pd.Series | None = None) -> Estimate:
    """Return the mean, weighted by ``shares`` of conditions; for humans a jackknife over pairs."""
    if "pair" not in trials or trials["pair"].isna().all():
        return mean(trials[column].to_numpy(float))
    trials = trials[["condition", "pair", column]].dropna()
    if trials.empty:
        return Estimate()
    if shares is None:
        shares = trials["condition"].value_counts()
    cells = trials.groupby(["pair", "condition"])[column].agg(["size", "sum"]).unstack(fill_value=0)
    # Of all pairs, then without one after the other; conditions without a trial have no weight.
    sizes, sums = (
        np.vstack([of.sum(axis=0), of.sum(axis=0) - of])
        for of in (cells["size"].to_numpy(), cells["sum"].to_numpy())
    )
    weights = (sizes > 0) * shares.reindex(cells["size"].columns, fill_value=0).to_numpy()
    with np.errstate(invalid="ignore"):  # one pair alone may have driven there
        means = (sums / np.maximum(sizes, 1) * weights).sum(axis=1) / weights.sum(axis=1)
    whole = float(means[0])
    if (pairs := len(sizes) - 1) < 2:
        return Estimate(whole, n=len(trials))
    se = float(((means[1:] - whole) ** 2).sum() * (pairs - 1) / pairs) ** 0.5
    return interval_of(whole, se, pairs - 1, len(trials))


def median(sample: np.ndarray) -> Estimate:
    """Return a median with its interval of order statistics; fewer than six values have none."""
    if not len(sample):
        return Estimate()
    n, ordered = len(sample), np.sort(sample)
    low, high = _ranks(n)
    ends = float(ordered[low]) if low >= 0 else None, float(ordered[high]) if high < n else None
    return Estimate(float(np.median(sample)), *ends, n)


@cache
def _ranks(n: int) -> tuple[int, int]:
    """Return the places of a median's ends, faster than scipy's quantile_test."""
    from scipy.stats import binom

    outside = (1 - LEVEL) / 2
    return int(binom.ppf(outside, n, 0.5)) - 1, int(binom.isf(outside, n, 0.5))


@remembered
def undecided(group: Group, metric: Metric) -> int:
    """Return the number of trials that another collision rule ended before this one could."""
    if metric.value not in JUDGED or not known(group, metric):
        return 0
    trials = trials_of(group, metric)
    return int((trials[metric.column].isna() & (trials["status"] != "failed")).sum())


def undecided_note(group: Group, metric: Metric) -> Fact | None:
    """Return the bounds of a rate with undecided trials; None without such trials."""
    if not (cut_off := undecided(group, metric)):
        return None
    k, n = counts(group, metric)
    every = n + cut_off
    if metric is BOXES:
        return Fact(Why.UNDECIDED_BOXES, (k, k + cut_off, every, cut_off))
    ends = 100 * k / every, 100 * (k + cut_off) / every
    return Fact(Why.UNDECIDED, (metric.heading, cut_off, every, *ends))


def known(group: Group, metric: Metric) -> bool:
    """Return whether a group's trials have this metric: humans may have only outcomes."""
    trials = trials_of(group, metric)
    if group.published_outcomes is None:
        return True
    return metric.column in trials and bool(trials[metric.column].notna().any())


def estimate_or_reference(group: Group, metric: Metric) -> Estimate | None:
    """Return a group's estimate; for humans without traces the paper's value, or None."""
    if known(group, metric):
        return estimate(group, metric)
    if not metric.paper_of_humans:
        return None
    row = published(PAPER).query("driver == 'human'").iloc[0]
    return Estimate(float(row[metric.paper_of_humans]), source=Fact(Why.CITED, (citation(PAPER),)))


def no_human_value(metric: Metric) -> Fact:
    """Return why the humans have no value of a metric before an import."""
    why = Why.OTHER_RULE if metric.value in JUDGED else Why.NOT_PUBLISHED
    return Fact(why, (metric.heading,))


def outcomes_note(group: Group) -> Fact | None:
    """Return which numbers rest on published outcomes, if only some traces are imported."""
    if not group.measured or group.traced:
        return None
    sizes = len(group.outcomes), len(group.trials), len(group.finished)
    return Fact(Why.OUTCOMES, (BOXES.heading, *sizes))
