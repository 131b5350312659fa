"""Differences between prompts."""

from __future__ import annotations

from collections.abc import Iterator
from math import isinf

from merge_runner_analysis.metrics import RULES_NOTE, Metric, shown_in
from merge_runner_analysis.stats.contrasts import (
    contrast,
    copied_of_shared,
    corrected,
    trials_by_cell,
)
from merge_runner_analysis.study import Study
from merge_runner_analysis.tables.model import Column, Optional, Row, Table, Value, interval

WITHIN = (
    "compared within the {} that both have: rates by the weights of Mantel and Haenszel, with "
    "Fisher's exact test and the melded interval that agrees with it; means by Welch's test in a "
    "model with a level for each of them"
)
FAMILY = (
    "Holm: a family is one measure over the levels of one factor, its reference apart; in "
    "`contrasts` over the prompts of one driver"
)
SAME_TRIALS = (
    "programs play no trial at one of both levels that they do not play at the other: no test"
)


def contrasts(study: Study) -> Table:
    """Every prompt against its driver's reference."""
    # A family is one question asked of several variants. Correcting over all metrics at once would
    # make the result depend on how many are registered.
    rows = [
        row
        for driver in dict.fromkeys(group.driver for group in study.models)
        for metric in shown_in("tables")
        for row in _family(study, driver, metric)
    ]
    return Table(
        "contrasts",
        (
            Column("driver", "driver"),
            Column("setting", "setting"),
            Column("reference", "against"),
            Column("measure", "measure"),
            Column("difference", "difference", "number", 2, "first minus second"),
            interval("ci", "of the same test"),
            Column("p", "p", "p", 3, "Fisher's exact test or Welch's"),
            Column("p_holm", "Holm", "p", 3, "corrected by Holm"),
            Optional("detectable", "detectable", "number", 2, "at p < .05 with power .8"),
            Column("n", "n", "count", 0, "trials of the setting in the shared conditions"),
            Column("n_reference", "n ref.", "count", 0, "trials of the reference in these"),
            Optional("freedom", "df", "number", 0, "of a t test"),
        ),
        rows,
        (
            f"{WITHIN.format('conditions')}. {FAMILY}. Detectable: before correction; of rates by "
            "the exact power of Fisher's test of all these trials as if of one condition, in the "
            "direction in which less is enough, of means (t.975 + t.8) times the standard error",
            RULES_NOTE,
            *_same_as_reference(study),
            *([] if rows else ["there is no pair of judged groups to compare"]),
        ),
    )


def _same_as_reference(study: Study) -> Iterator[str]:
    """Which prompts have no row, since programs do not read them."""
    own = {g.driver: g for g in study.models if g.setting == study.reference}
    same = []
    for group in study.models:
        other = own.get(group.driver)
        if other in (None, group):
            continue
        if copied_of_shared(study, (group, other), "condition")[0]:
            same.append(group.id)
    if same:
        yield f"{', '.join(same)}, beside {study.reference}: {SAME_TRIALS}"


def _family(study: Study, driver: str, metric: Metric) -> Iterator[Row]:
    """One measure of a driver's prompts against its reference; p are corrected for their number."""
    groups = {group.setting: group for group in study.models if group.driver == driver}
    other = groups.pop(study.reference, None)
    found = {
        group: difference.times(100 if metric.rate else 1)
        for group in groups.values()
        if other and (difference := contrast(study, (group, other), metric))
    }
    holm = corrected([difference.p for difference in found.values() if difference.p is not None])
    for (group, difference), p_holm in zip(found.items(), holm, strict=True):
        assert other is not None
        first, second = (
            frame["condition"]
            for frame in trials_by_cell(study, (group, other), metric, "condition", shared=True)
        )
        values: dict[str, Value] = {
            "driver": group.label,
            "setting": group.setting,
            "reference": other.setting,
            "measure": metric.heading,
            "difference": difference.value,
            "ci": difference.bounds(),
            "p": difference.p,
            "p_holm": p_holm,
            "detectable": difference.detectable,
            "n": len(first),
            "n_reference": len(second),
            "freedom": None if isinf(difference.freedom) else difference.freedom,
        }
        few = f"{metric.heading}: so few trials can show no difference, however large"
        yield Row(
            f"{group.id}/{other.setting}/{metric.name}",
            (group.id, other.id),
            values,
            few if difference.detectable is None else "",
            metric.column,
            tuple(sorted({*first})),
        )
