"""Differences between prompts, corrected for their number; for humans see ``verdicts``."""

from __future__ import annotations

from math import isinf

from merge_runner.text_safety import quoted
from merge_runner_analysis.data.study import Group, Study
from merge_runner_analysis.metrics import RULES_NOTE, Metric, shown_in
from merge_runner_analysis.stats.contrasts import contrast, corrected
from merge_runner_analysis.stats.intervals import Difference
from merge_runner_analysis.stats.measures import trials_of
from merge_runner_analysis.tables.model import Column, Optional, Row, Table, interval


def contrasts(study: Study) -> Table:
    """Every prompt against its driver's reference."""
    rows: list[Row] = []
    for driver in dict.fromkeys(group.driver for group in study.models):
        # A family is one question asked of several variants. Correcting over all metrics at once
        # would make the result depend on how many are registered.
        for metric in shown_in("tables"):
            rows += _family(study, driver, metric)
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


def _family(study: Study, driver: str, metric: Metric) -> list[Row]:
    """One measure of a driver's prompts against its reference; p are corrected for their number."""
    groups = {group.setting: group for group in study.models if group.driver == driver}
    other = groups.pop(study.reference, None)
    if other is None:
        return []
    contrasts = {
        group: found
        for group in groups.values()
        if (found := contrast(study, (group, other), metric))
    }
    if not contrasts:
        return []
    families = zip(*corrected([found.p for found in contrasts.values()]), strict=True)
    return [
        _row(group, other, metric, found, float(holm), float(bh))
        for (group, found), (holm, bh) in zip(contrasts.items(), families, strict=True)
    ]


def _row(
    group: Group, other: Group, metric: Metric, found: Difference, holm: float, bh: float
) -> Row:
    first, second = (
        trials_of(one, metric).dropna(subset=[metric.column])["condition"] for one in (group, other)
    )
    named = ", ".join(quoted(name) for name in sorted({*first} & {*second}))
    # Rates are tested as fractions and shown in percentage points.
    factor = 100 if metric.rate else 1
    powerless = f"{metric.heading}: so few trials can show no difference, however large"
    return Row(
        f"{group.id}/{other.setting}/{metric.name}",
        (group.id, other.id),
        {
            "driver": group.label,
            "setting": group.setting,
            "reference": other.setting,
            "measure": metric.heading,
            "difference": found.value * factor,
            "ci": found.bounds(factor),
            "p": found.p,
            "p_holm": holm,
            "p_bh": bh,
            "detectable": None if found.detectable is None else found.detectable * factor,
            "n": int(first.isin(second).sum()),
            "n_reference": int(second.isin(first).sum()),
            "freedom": None if isinf(found.freedom) else found.freedom,
        },
        powerless if found.detectable is None else "",
        counts=f"{metric.counts} AND condition IN ({named})",
    )
