"""A measure of a driver against the humans, within the conditions that both have.

Where the human pairs are known, trials of one pair are correlated: the errors are clustered (see
``contrast_by_pairs``). Of published counts no pair is known, and all trials are independent: rates
and means are compared as those of two prompts are (see ``contrasts``), and intervals are too
narrow.
"""

from __future__ import annotations

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from merge_runner_analysis.data.study import Group
from merge_runner_analysis.metrics import Metric
from merge_runner_analysis.stats.contrasts import contrast_cells, contrast_means, shared_cells
from merge_runner_analysis.stats.intervals import Difference, difference
from merge_runner_analysis.stats.measures import trials_of, undecided
from merge_runner_analysis.stats.regressions import MIN_PAIRS

Array = NDArray[np.float64]

# A squared error that is smaller is a rounding of 0.
ROUNDING = 1e-24


def contrast_with_humans(human: Group, group: Group, metric: Metric) -> Difference | str:
    """Return the driver's measure minus the humans', or why that is not tested.

    The reason is empty where they share no condition.
    """
    for whose, one in (("the driver's", group), ("the humans'", human)):
        if cut_off := undecided(one, metric):
            return f"undecided is whether {cut_off} of {whose} trials collided"
    frames = trials_of(group, metric), trials_of(human, metric)
    if by_known_pairs(human, metric):
        return contrast_by_pairs(*frames, metric.column, rate=metric.rate)
    if metric.rate:
        cells = shared_cells(*frames, metric.column)
        return contrast_cells(cells) if cells else ""
    return contrast_means(*frames, metric.column) or ""


def by_known_pairs(human: Group, metric: Metric) -> bool:
    """Whether the human trials that have this metric are of known pairs."""
    return "pair" in trials_of(human, metric)


def contrast_by_pairs(
    driver: pd.DataFrame, human: pd.DataFrame, measure: str, *, rate: bool
) -> Difference | str:
    """Return the driver's mean minus the humans' by a linear model, or why it has no test.

    The model is least squares of the measure on the source (1: driver) with a level for each
    condition; of a rate it is a linear probability model. Its slope is D = Σ w (d - h) / W over the
    shared conditions, with d and h the means of n and m trials, w = n m / (n + m) and W = Σ w.

    The squared error is that of the humans plus that of the driver:

    - humans: Σ (D(g) - D)² (G - 1) / G, where D(g) is D without the pair g of G (the jackknife by
      cluster: Bell and McCaffrey 2002; CV3 of MacKinnon, Nielsen and Webb 2023), on G - 1 degrees
      of freedom;
    - driver: each trial is a cluster, which in the same jackknife gives HC3 (MacKinnon and White
      1985): Σ (x e / (1 - l))² / W² over its trials, with x = m / (n + m) of the trial's condition,
      its residual e in the model and its leverage l = 1 / (n + m) + x² / W. Of a rate it is at
      least Σ x² s² / W², where s² is the variance (n + m - 1 below) of all trials of the
      condition, which is the driver's where both rates are equal (Cochran 1954): HC3 is nearly 0
      where few trials of the driver all have the commoner outcome. It has as many degrees of
      freedom as the driver has trials in the shared conditions, less one.

    The test is Student's t with the degrees of freedom of the sum (Satterthwaite 1946); the
    interval and the detectable difference have the same error and the same degrees of freedom.
    """
    driver, human = (each.dropna(subset=[measure]) for each in (driver, human))
    shared = np.intersect1d(driver["condition"].unique(), human["condition"].unique())
    if not len(shared):
        return ""
    driver, human = (each[each["condition"].isin(shared)] for each in (driver, human))
    pairs, pair = np.unique(human["pair"].to_numpy(str), return_inverse=True)
    if len(pairs) < MIN_PAIRS:
        known = "1 human pair is" if len(pairs) == 1 else f"{len(pairs)} human pairs are"
        return f"{known} too few to tell how pairs differ"
    if len(driver) < 2:
        return "a single trial has no error"
    at, human_at = (np.searchsorted(shared, each["condition"]) for each in (driver, human))
    value, human_value = (each[measure].to_numpy(float) for each in (driver, human))
    # Trials and their sums by condition, of the humans by pair, too: (pairs, conditions).
    n: Array = np.bincount(at).astype(float)
    total: Array = np.bincount(at, value).astype(float)
    m_of, total_of = np.zeros((2, len(pairs), len(shared)))
    np.add.at(m_of, (pair, human_at), 1)
    np.add.at(total_of, (pair, human_at), human_value)
    m, human_total = m_of.sum(axis=0), total_of.sum(axis=0)

    slope = float(_slope(n, total, m, human_total))
    # Each pair has trials in these conditions: without one of three there are still some.
    without = _slope(n, total, m - m_of, human_total - total_of)
    of_pairs = float(((without - slope) ** 2).sum()) * (len(pairs) - 1) / len(pairs)

    size, x, weight = n + m, m / (n + m), float((n * m / (n + m)).sum())
    mean = (total + human_total) / size
    residual = value - mean[at] - slope * x[at]
    leverage = 1 / size[at] + x[at] ** 2 / weight
    of_trials = float(((x[at] * residual / (1 - leverage)) ** 2).sum()) / weight**2
    if rate:
        variance = mean * (1 - mean) * size / (size - 1)
        of_trials = max(of_trials, float((n * x**2 * variance).sum()) / weight**2)
    if max(of_trials, of_pairs) < ROUNDING:
        return "neither the driver nor the humans vary: there is nothing to test"
    errors = (of_trials**0.5, len(driver) - 1), (of_pairs**0.5, len(pairs) - 1)
    found = difference(slope, *errors, by=f"{len(pairs)} pairs")
    assert found is not None
    return found


def _slope(n: Array, total: Array, m: Array, human_total: Array) -> Array:
    """D of trials and sums by condition, the last axis; without human trials it weighs nothing."""
    weights = n * m / (n + m)
    apart = total / n - human_total / np.maximum(m, 1)
    return np.asarray((weights * apart).sum(axis=-1) / weights.sum(axis=-1))
