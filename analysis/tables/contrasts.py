"""Differences between prompts, corrected for their number; for humans see ``verdicts``."""

from __future__ import annotations

from collections.abc import Iterator
from math import isinf

from merge_runner.text_safety import quoted
from merge_runner_analysis.data.study import Group, Study, in_one_study
from merge_runner_analysis.metrics import RULES_NOTE, Metric, compared
from merge_runner_analysis.stats.contrasts import (
    contrast_cells,
    contrast_means,
    corrected,
    shared_cells,
)
from merge_runner_analysis.stats.intervals import Difference
from merge_runner_analysis.stats.measures import trials_of, undecided
from merge_runner_analysis.tables.model import Column, Optional, Row, Table, Value, interval


def contrasts(study: Study) -> Table:
    """Every prompt against its driver's reference."""
    # A family is one question asked of several variants. Correcting over all metrics at once would
    # make the result depend on how many are registered.
    rows = [
        row
        for driver in dict.fromkeys(group.driver for group in study.models)
        for metric in compared()
        for row in _family(study, driver, metric)
    ]
    judged = "judged " if study.unjudged else ""
    return Table(
        "contrasts",
        (
            Column("driver", "driver"),
            Column("setting", "setting"),
            Column("reference", "against"),
            Column("measure", "measure"),
            Column("difference", "difference", "number", 2, "first minus second"),
            interval("ci", "Newcombe; least squares"),
            Column("p", "p", "p", 3, "Fisher's exact test or t test"),
            Column("p_holm", "Holm", "p", 3, "corrected by Holm"),
            Column("p_bh", "BH", "p", 3, "corrected by Benjamini and Hochberg"),
            Optional("detectable", "detectable", "number", 2, "at p < .05 with power .8"),
            Column("n", "n", "count", 0, "trials of the setting in the shared conditions"),
            Column("n_reference", "n ref.", "count", 0, "trials of the reference in these"),
            Optional("freedom", "df", "number", 0, "of a t test"),
        ),
        rows,
        (
            "all are compared within the conditions that both have: rates by the weights of Mantel "
            "and Haenszel, with Newcombe's interval and Fisher's exact test within conditions; "
            "means by least squares, with its t test. A family is one measure of "
            "one driver over its prompts",
            "detectable: the smallest difference that is found at p < .05, before correction, with "
            "a power of .8; rates: by the exact power of Fisher's test of all these trials as if "
            "of one condition, the reference's true rate being the observed one, in the direction "
            "in which less is enough; means: (t.975 + t.8) times the standard error",
            RULES_NOTE,
            *([] if rows else [f"there is no pair of {judged}groups to compare"]),
        ),
    )


def _family(study: Study, driver: str, metric: Metric) -> Iterator[Row]:
    """One measure of a driver's prompts against its reference; p are corrected for their number."""
    groups = {group.setting: group for group in study.models if group.driver == driver}
    other = groups.pop(study.reference, None)
    found = [
        (group, other, contrast)
        for group in groups.values()
        if other and in_one_study(study, group, other)
        if (contrast := _contrast(group, other, metric))
    ]
    if found:
        families = zip(*corrected([contrast.p for *_, contrast in found]), strict=True)
        for pair, (holm, bh) in zip(found, families, strict=True):
            yield _row(*pair, metric, {"p_holm": float(holm), "p_bh": float(bh)})


def _contrast(group: Group, other: Group, metric: Metric) -> Difference | None:
    """The difference between two prompts; None if they share no condition or are undecided."""
    if undecided(group, metric) or undecided(other, metric):
        return None
    if not metric.rate:
        return contrast_means(group.trials, other.trials, metric.column)
    both = shared_cells(group.trials, other.trials, metric.column)
    return contrast_cells(both) if both else None


def _row(
    group: Group, other: Group, contrast: Difference, metric: Metric, p: dict[str, Value]
) -> Row:
    first, second = (
        trials_of(one, metric).dropna(subset=[metric.column])["condition"] for one in (group, other)
    )
    named = ", ".join(quoted(name) for name in sorted({*first} & {*second}))
    factor, least = 100 if metric.rate else 1, contrast.detectable
    return Row(
        f"{group.id}/{other.setting}/{metric.name}",
        (group.id, other.id),
        {
            "driver": group.label,
            "setting": group.setting,
            "reference": other.setting,
            "measure": metric.heading,
            "difference": factor * contrast.value,
            "ci": contrast.bounds(factor),
            "p": contrast.p,
            **p,
            "detectable": None if least is None else factor * least,
            "n": int(first.isin(second).sum()),
            "n_reference": int(second.isin(first).sum()),
            "freedom": None if isinf(contrast.freedom) else contrast.freedom,
        },
        f"{metric.heading}: so few trials can show no difference, however large"
        if least is None
        else "",
        f"{metric.counts} AND condition IN ({named})",
    )
