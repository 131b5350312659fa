"""Differences between prompts, corrected for their number; for humans see ``verdicts``."""

from __future__ import annotations

from collections.abc import Mapping
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
from merge_runner_analysis.tables.model import Column, Row, Table
from merge_runner_analysis.tables.notes import sample_notes


def contrasts(study: Study) -> Table:
    """Every prompt against its driver's reference."""
    rows: list[Row] = []
    for driver in dict.fromkeys(group.driver for group in study.models):
        # A family is one question asked of several variants. Correcting over all metrics at once
        # would make the result depend on how many are registered.
        for metric in compared():
            rows += _family(study, driver, metric)
    judged = "judged " if study.unjudged else ""
    return Table(
        "contrasts",
        "Differences between prompts",
        (
            Column("driver", "driver"),
            Column("setting", "setting"),
            Column("reference", "against"),
            Column("measure", "measure"),
            Column("difference", "difference", "number", 2, "first minus second"),
            Column("ci", "95 % CI", "interval", 2, "Newcombe; least squares", optional=True),
            Column("p", "p", "p", 3, "Fisher's exact test or t test"),
            Column("p_holm", "Holm", "p", 3, "corrected by Holm"),
            Column("p_bh", "BH", "p", 3, "corrected by Benjamini and Hochberg"),
            Column(
                "detectable",
                "detectable",
                "number",
                2,
                "smallest difference, in either direction, found at p < .05 with power .8",
                optional=True,
            ),
            Column("n", "n", "count", 0, "trials of the setting in the shared conditions"),
            Column(
                "n_reference", "n ref.", "count", 0, "trials of the reference in these conditions"
            ),
            Column("freedom", "df", "number", 0, "of a t test", optional=True),
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
            "in which less is enough; means: (t.975 + t.8) times the standard error of the linear "
            "model, with its degrees of freedom",
            RULES_NOTE,
            *_shared_notes(study),
            *sample_notes(study, study.groups, pooled=False),
            *([] if rows else [f"there is no pair of {judged}groups to compare"]),
        ),
    )


def _family(study: Study, driver: str, metric: Metric) -> list[Row]:
    """One measure of a driver's variants against its reference prompt."""
    groups = [group for group in study.models if group.driver == driver]
    reference = next((group for group in groups if group.setting == study.reference), None)
    if reference is None:
        return []
    found = {
        group: _contrast(group, reference, metric)
        for group in groups
        if group is not reference and in_one_study(study, group, reference)
    }
    return _corrected(found, reference, metric, study.reference)


def _corrected(
    contrasted: Mapping[Group, Difference | str], other: Group, metric: Metric, reference: str
) -> list[Row]:
    """One family of contrasts; groups without one are left out, also of its correction."""
    found = {group: one for group, one in contrasted.items() if isinstance(one, Difference)}
    if not found:
        return []
    holm, bh = corrected([contrast.p for contrast in found.values()])
    return [
        _row(group, other, metric, contrast, reference, (float(holm[i]), float(bh[i])))
        for i, (group, contrast) in enumerate(found.items())
    ]


def _row(
    group: Group,
    other: Group,
    metric: Metric,
    contrast: Difference,
    reference: str,
    corrected_p: tuple[float, float],
) -> Row:
    first, second = (
        trials_of(one, metric).dropna(subset=[metric.column])["condition"] for one in (group, other)
    )
    in_both = first.isin(second), second.isin(first)
    whole = all(part.all() for part in in_both)
    named = ", ".join(quoted(name) for name in sorted(first[in_both[0]].unique()))
    # Rates are tested as fractions and shown in percentage points.
    factor = 100 if metric.rate else 1
    return Row(
        f"{group.id}/{reference}/{metric.name}",
        (group.id, other.id),
        {
            "driver": group.label,
            "setting": group.setting,
            "reference": reference,
            "measure": metric.heading,
            "difference": contrast.value * factor,
            "ci": contrast.bounds(factor),
            "p": contrast.p,
            "p_holm": corrected_p[0],
            "p_bh": corrected_p[1],
            "detectable": None if contrast.detectable is None else contrast.detectable * factor,
            "n": int(in_both[0].sum()),
            "n_reference": int(in_both[1].sum()),
            "freedom": None if isinf(contrast.freedom) else contrast.freedom,
        },
        _powerless(contrast, metric),
        counts=metric.counts if whole else f"{metric.counts} AND condition IN ({named})",
    )


def _contrast(group: Group, other: Group, metric: Metric) -> Difference | str:
    """The difference between two prompts; empty where they share no condition or are undecided."""
    if undecided(group, metric) or undecided(other, metric):
        return ""
    if not metric.rate:
        return contrast_means(group.trials, other.trials, metric.column) or ""
    both = shared_cells(group.trials, other.trials, metric.column)
    return contrast_cells(both) if both else ""


def _powerless(contrast: Difference, metric: Metric) -> str:
    if contrast.detectable is not None:
        return ""
    return f"{metric.heading}: so few trials can show no difference, however large"


def _shared_notes(study: Study) -> list[str]:
    """Notes on replies that variants share with the baseline, where their prompts are equal."""
    named = {name: group.id for group in study.models for name in group.trials["spec_hash"]}
    return [
        f"{named[row.spec_hash]}: {row.shared} of {row.calls} calls share their reply with "
        f"{named[row.baseline]}, where prompt and slot are equal: the groups are not independent, "
        "and the tests, which take them as such, are conservative there"
        for row in study.shared.itertuples()
        if row.spec_hash in named and row.baseline in named
    ]
