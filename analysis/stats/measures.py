"""What a group of trials comes to by a metric, and what is known of the humans."""

from __future__ import annotations

import numpy as np
import pandas as pd
from scipy import stats

from merge_runner_analysis.data.reference_data import citation, published
from merge_runner_analysis.data.study import Group
from merge_runner_analysis.metrics import BOXES, JUDGED, HumanReference, Metric
from merge_runner_analysis.stats.intervals import LEVEL, Estimate, mean, proportion

PAPER = "paper_ablation_quantitative"


def trials_of(group: Group, metric: Metric) -> pd.DataFrame:
    """The trials that a metric is found in, of humans perhaps the published outcomes."""
    return group.outcomes if metric.humans_from == "outcomes" else group.trials


def values(group: Group, metric: Metric) -> pd.Series:
    """The values of the trials that count. Everything that counts trials counts these."""
    return trials_of(group, metric)[metric.column].dropna()


def counts(group: Group, metric: Metric) -> tuple[int, int]:
    """Successes and n of a rate."""
    found = values(group, metric)
    return int(found.astype(bool).sum()), len(found)


def estimate(group: Group, metric: Metric) -> Estimate:
    """The metric of a group with its 95 % interval, rates in percent.

    Where trials end undecided a rate has no value, and the interval is that of both worst cases
    (Manski 1989): from none of them to all of them.
    """
    match metric.estimator:
        case "mean":
            return mean(values(group, metric).to_numpy(float))
        case "median":
            return median(values(group, metric).to_numpy(float))
    k, n = counts(group, metric)
    cut_off = undecided(group, metric)
    if not n + cut_off:
        return Estimate(None, None, None, 0)
    least, most = (proportion(k + more, n + cut_off) for more in (0, cut_off))
    assert least.value is not None
    assert least.low is not None
    assert most.high is not None
    return Estimate(None if cut_off else 100 * least.value, 100 * least.low, 100 * most.high, n)


def median(sample: np.ndarray) -> Estimate:
    """A median with its interval of order statistics; fewer than six values have no interval."""
    if not len(sample):
        return Estimate(None, None, None, 0)
    value = float(np.median(sample))
    found = stats.quantile_test(sample, q=value, p=0.5).confidence_interval(LEVEL)
    low, high = (None if np.isnan(end) else float(end) for end in found)
    return Estimate(value, low, high, len(sample))


def undecided(group: Group, metric: Metric) -> int:
    """How many trials another collision rule ended, so that they are not known to collide by it."""
    if metric.value not in JUDGED or not known(group, metric):
        return 0
    trials = trials_of(group, metric)
    return int((trials[metric.column].isna() & (trials["status"] != "failed")).sum())


def undecided_note(group: Group, metric: Metric) -> str:
    """What is known of a rate some of whose trials are undecided; empty where none is."""
    cut_off = undecided(group, metric)
    if not cut_off:
        return ""
    k, n = counts(group, metric)
    every = n + cut_off
    said = (
        f"{metric.heading}: {cut_off} of {every} trials are undecided, since another collision "
        f"rule ended them; between {100 * k / every:.1f} and {100 * (k + cut_off) / every:.1f} %"
    )
    if metric is not BOXES:  # what humans did is recorded
        return said
    return f'{said}. A study whose [scenario] has collision_rule = "rectangle" decides them'


def known(group: Group, metric: Metric) -> bool:
    """Whether a group's trials hold this metric.

    Before an import humans have outcomes alone, and until it is complete no collisions but these.
    """
    if metric.humans_from == "all recordings":
        return group.measured and group.published_outcomes is None
    return group.measured or metric.humans_from == "outcomes"


def human_reference(metric: Metric) -> HumanReference | None:
    """What the paper says of the humans."""
    if not metric.paper_of_humans:
        return None
    row = published(PAPER).query("driver == 'human'").iloc[0]
    return HumanReference(float(row[metric.paper_of_humans]), None, None, citation(PAPER))


def estimate_or_reference(group: Group, metric: Metric) -> Estimate | HumanReference | None:
    """What a group comes to; of humans without traces what is published, None where nothing is."""
    return estimate(group, metric) if known(group, metric) else human_reference(metric)


def no_human_value(metric: Metric) -> str:
    """Why the humans have no value of a metric before their recordings are imported."""
    if metric.value in JUDGED:
        return f"{metric.heading}: published human collisions are boxes that overlap"
    if metric.humans_from == "all recordings":
        imported = "not all human recordings are imported"
    else:
        imported = "no human traces are imported"
    return f"{metric.heading}: no human value is published, and {imported}"


def outcomes_note(group: Group) -> str:
    """What rests on the published outcomes, where only a part of the traces is imported."""
    if not group.measured or group.published_outcomes is None:
        return ""
    return (
        f"who merged first and {BOXES.heading}: the {len(group.published_outcomes)} published "
        f"outcomes; the rest: {len(group.trials)} imported trials, {len(group.finished)} finished"
    )
