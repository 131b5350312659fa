"""Differences between prompts, and between drivers and humans, corrected for their number."""

from __future__ import annotations

from collections.abc import Iterator

from analysis.data.study import BASELINE, Group, Study
from analysis.stats.contrasts import contrast_means, contrast_rates, corrected
from analysis.stats.intervals import Difference
from analysis.stats.measures import (
    BOXES,
    JOINT,
    MEASURES,
    RULES_NOTE,
    Measure,
    counts,
    estimate,
    known,
    outcomes_note,
    published_human,
    undecided,
)
from analysis.tables.model import Column, Row, Table
from analysis.tables.notes import sample_notes

# Of a row: those that the outcomes of humans are in.
COLUMNS = ("difference", "ci", "p", "p_holm", "p_bh", "n", "n_reference")
JOINT_NOTE = "human joint rate: 510 of 962 trials, from the 53.0 % that the paper prints"


def contrasts(study: Study) -> Table:
    """Every variant against its driver's baseline, and every baseline against the humans."""
    rows: list[Row] = []
    for driver in dict.fromkeys(group.driver for group in study.models):
        for measure in MEASURES:
            rows += _family(study, driver, measure)
    rows += _against_humans(study)
    return Table(
        "contrasts",
        "Differences from the baseline prompt, and of the baseline from humans",
        (
            Column("driver", "driver"),
            Column("setting", "setting"),
            Column("reference", "against"),
            Column("measure", "measure"),
            Column("difference", "difference", "number", 2, "first minus second"),
            Column("ci", "95 % CI", "interval", 2, "Newcombe; least squares", optional=True),
            Column("p", "p", "p", 3, "Fisher's exact or permutation test"),
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
            Column("n", "n", "count", 0, "trials of the setting"),
            Column("n_reference", "n ref.", "count", 0, "trials of the reference"),
        ),
        rows,
        (
            "rates: Fisher's exact test; means: their difference within conditions, tested by "
            "permutation, seeded; a family is one measure of one driver over its variants, or over "
            "all drivers against humans",
            "detectable: the smallest difference that is found at p < .05, before correction, with "
            "a power of .8; rates: by the exact power of Fisher's test, the reference's true rate "
            "being the observed one, in the direction in which less is enough; means: (t.975 + "
            "t.8) times the standard error of the linear model",
            RULES_NOTE,
            *(
                []
                if study.human.measured
                else ["gap and RMSE against humans need the recordings: merge-runner human import"]
            ),
            *shared_notes(study),
            *sample_notes(study, study.groups),
            *([] if rows else ["there is no pair of groups to compare"]),
        ),
    )


def _family(study: Study, driver: str, measure: Measure) -> list[Row]:
    """One measure of a driver's variants against its baseline."""
    groups = [group for group in study.models if group.driver == driver]
    baseline = next((group for group in groups if group.setting == BASELINE), None)
    if baseline is None:
        return []
    pairs = [(group, baseline) for group in groups if group.setting != BASELINE]
    return _corrected(pairs, measure, "baseline")


def _against_humans(study: Study) -> Iterator[Row]:
    """Every driver's baseline against the humans, as far as these are known."""
    if study.human not in study.groups:
        return
    pairs = [(group, study.human) for group in study.models if group.setting == BASELINE]
    for measure in MEASURES:
        if known(study.human, measure) or measure is JOINT:
            yield from _corrected(pairs, measure, "human")


def _corrected(pairs: list[tuple[Group, Group]], measure: Measure, reference: str) -> list[Row]:
    """A family of contrasts; groups without the measure are left out of it."""
    found = [
        (group, other, contrast)
        for group, other in pairs
        if (contrast := _contrast(group, other, measure)) is not None
    ]
    if not found:
        return []
    holm, bh = corrected([contrast.p for _, _, contrast in found])
    return [
        Row(
            f"{group.id}/{reference}/{measure.name}",
            (group.id, other.id),
            {
                "driver": group.label,
                "setting": group.setting,
                "reference": reference,
                "measure": measure.heading,
                "difference": contrast.value * (100 if measure.rate else 1),
                "ci": contrast.bounds(100 if measure.rate else 1),
                "p": contrast.p,
                "p_holm": float(holm[i]),
                "p_bh": float(bh[i]),
                "detectable": _percent(contrast.detectable, measure),
                "n": _n(group, measure),
                "n_reference": _n(other, measure),
            },
            "; ".join(filter(None, (_note(group, other, measure), _powerless(contrast, measure)))),
            counts=measure.counts,
            published=COLUMNS if measure is BOXES else (),
        )
        for i, (group, other, contrast) in enumerate(found)
    ]


def _note(group: Group, other: Group, measure: Measure) -> str:
    named = {group.id: undecided(group, measure), other.id: undecided(other, measure)}
    remarks = [f"{name}, {remark}" for name, remark in named.items() if remark]
    if not known(other, measure):
        remarks.append(JOINT_NOTE)
    return "; ".join(filter(None, [*remarks, outcomes_note(other)]))


def _contrast(group: Group, other: Group, measure: Measure) -> Difference | None:
    if measure.rate:
        first, second = counts(group, measure), _rate(other, measure)
        return contrast_rates(first, second) if first[1] and second[1] else None
    return contrast_means(group.finished, other.finished, measure.column)


def _rate(group: Group, measure: Measure) -> tuple[int, int]:
    """Successes and n; the humans' joint rate before an import is the published 53.0 % of 962."""
    if known(group, measure):
        return counts(group, measure)
    finished = len(group.finished)
    return round(finished * published_human(measure) / 100), finished


def _n(group: Group, measure: Measure) -> int:
    if measure.rate:
        return _rate(group, measure)[1]
    return estimate(group, measure).n


def _powerless(contrast: Difference, measure: Measure) -> str:
    if contrast.detectable is not None:
        return ""
    return f"{measure.heading}: so few trials can show no difference, however large"


def _percent(value: float | None, measure: Measure) -> float | None:
    return 100 * value if value is not None and measure.rate else value


def shared_notes(study: Study) -> list[str]:
    """Variants share a reply with the baseline where their prompts are equal."""
    named = {group.spec_hash: group.id for group in study.models}
    return [
        f"{named[row.spec_hash]}: {row.shared} of {row.calls} calls share their reply with "
        f"{named[row.baseline]}, where prompt and slot are equal: the groups are not independent, "
        "and the tests, which take them as such, are conservative there"
        for row in study.shared.itertuples()
        if row.spec_hash in named and row.baseline in named
    ]
