"""Differences between prompts, and between drivers and humans, corrected for their number."""

from __future__ import annotations

from collections.abc import Iterator

from analysis.data.study import Group, Study, in_one_study
from analysis.metrics import RULES_NOTE, Metric, compared
from analysis.stats.contrasts import (
    contrast_cells,
    contrast_means,
    contrast_rates,
    corrected,
    shared_cells,
)
from analysis.stats.intervals import Difference
from analysis.stats.measures import (
    counts,
    human_reference,
    known,
    outcomes_note,
    trials_of,
    undecided,
    values,
)
from analysis.tables.model import Column, Row, Table
from analysis.tables.notes import listed, replayed_notes, sample_notes
from merge_runner.study.file import BASELINE

# The columns that rest on human outcomes, in rows whose metric does.
COLUMNS = ("difference", "ci", "p", "p_holm", "p_bh", "n", "n_reference")


def contrasts(study: Study) -> Table:
    """Every prompt against its driver's reference, and every baseline against the humans.

    Without a baseline it is the reference that is set against the humans.
    """
    rows: list[Row] = []
    for driver in dict.fromkeys(group.driver for group in study.models):
        # A family is one question asked of several variants. Correcting over all metrics at once
        # would make the result depend on how many are registered.
        for metric in compared():
            rows += _family(study, driver, metric)
    rows += _against_humans(study)
    return Table(
        "contrasts",
        "Differences between prompts, and from humans",
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
            "prompts are compared within the conditions that both have: rates by the weights of "
            "Mantel and Haenszel, with Newcombe's interval and Fisher's exact test within "
            "conditions; means by least squares, with a seeded permutation test. Against humans "
            "rates are compared over all trials. A family is one measure of one driver over its "
            "prompts, or over all drivers against humans",
            "detectable: the smallest difference that is found at p < .05, before correction, with "
            "a power of .8; rates: by the exact power of Fisher's test, the reference's true rate "
            "being the observed one, in the direction in which less is enough; means: (t.975 + "
            "t.8) times the standard error of the linear model",
            RULES_NOTE,
            *_recordings_note(study),
            *replayed_notes(study),
            *shared_notes(study),
            *sample_notes(study, study.groups),
            *([] if rows else ["there is no pair of groups to compare"]),
        ),
    )


def _family(study: Study, driver: str, metric: Metric) -> list[Row]:
    """One measure of a driver's variants against its reference prompt."""
    groups = [group for group in study.models if group.driver == driver]
    reference = next((group for group in groups if group.setting == study.reference), None)
    if reference is None:
        return []
    pairs = [
        (group, reference)
        for group in groups
        if group is not reference and in_one_study(study, group, reference)
    ]
    return _corrected(pairs, metric, study.reference)


def _against_humans(study: Study) -> Iterator[Row]:
    """Every driver against the humans, for metrics whose human value can be tested."""
    if study.human not in study.groups:
        return
    prompt = BASELINE if study.compared else study.reference
    pairs = [
        (group, study.human)
        for group in study.models
        if group.setting == prompt and not group.caution
    ]
    for metric in compared():
        if known(study.human, metric) or _published_rate(metric) is not None:
            yield from _corrected(pairs, metric, "human")


def _recordings_note(study: Study) -> list[str]:
    """Which means cannot be compared with humans before the recordings are imported."""
    means = [one.in_lists for one in compared() if not (one.rate or known(study.human, one))]
    need = "needs" if len(means) == 1 else "need"
    command = "merge-runner human import"
    return [f"{listed(means)} against humans {need} the recordings: {command}"] if means else []


def _corrected(pairs: list[tuple[Group, Group]], metric: Metric, reference: str) -> list[Row]:
    """One family of contrasts; pairs without the measure are left out, also of its correction."""
    found = [
        (group, other, contrast)
        for group, other in pairs
        if (contrast := _contrast(group, other, metric)) is not None
    ]
    if not found:
        return []
    holm, bh = corrected([contrast.p for _, _, contrast in found])
    return [
        Row(
            f"{group.id}/{reference}/{metric.name}",
            (group.id, other.id),
            {
                "driver": group.label,
                "setting": group.setting,
                "reference": reference,
                "measure": metric.heading,
                # Rates are tested as fractions and shown in percentage points.
                "difference": contrast.value * (100 if metric.rate else 1),
                "ci": contrast.bounds(100 if metric.rate else 1),
                "p": contrast.p,
                "p_holm": float(holm[i]),
                "p_bh": float(bh[i]),
                "detectable": _percent(contrast.detectable, metric),
                "n": _n(group, metric),
                "n_reference": _n(other, metric),
            },
            "; ".join(filter(None, (_note(other, metric), _powerless(contrast, metric)))),
            counts=metric.counts,
            published=COLUMNS if metric.humans_from == "outcomes" else (),
        )
        for i, (group, other, contrast) in enumerate(found)
    ]


def _note(other: Group, metric: Metric) -> str:
    published = "" if known(other, metric) else _published_note(metric)
    return "; ".join(filter(None, (published, outcomes_note(other))))


def _contrast(group: Group, other: Group, metric: Metric) -> Difference | None:
    if undecided(group, metric) or undecided(other, metric):
        return None
    frames = trials_of(group, metric), trials_of(other, metric)
    if not metric.rate:
        return contrast_means(*frames, metric.column)
    if other.setting:
        both = shared_cells(*frames, metric.column)
        return contrast_cells(both) if both else None
    first, second = counts(group, metric), _rate(other, metric)
    return contrast_rates(first, second) if first[1] and second[1] else None


def _rate(group: Group, metric: Metric) -> tuple[int, int]:
    """Successes and n; for humans without traces, as implied by the published rate."""
    if known(group, metric):
        return counts(group, metric)
    return _published_rate(metric) or (0, 0)


def _published_rate(metric: Metric) -> tuple[int, int] | None:
    """The humans' successes and n, if their published rate comes with its number of trials."""
    found = human_reference(metric)
    if not metric.rate or found is None or found.n is None:
        return None
    # Fisher's test needs whole counts, and a published percentage is rounded.
    return round(found.n * found.value / 100), found.n


def _published_note(metric: Metric) -> str:
    found, rate = human_reference(metric), _published_rate(metric)
    assert found is not None
    assert rate is not None
    printed = "that the paper prints" if metric.paper_of_humans else f"of {found.source}"
    k, n = rate
    return f"human {metric.in_lists}: {k} of {n} trials, from the {found.value:.1f} % {printed}"


def _n(group: Group, metric: Metric) -> int:
    return _rate(group, metric)[1] if metric.rate else len(values(group, metric))


def _powerless(contrast: Difference, metric: Metric) -> str:
    if contrast.detectable is not None:
        return ""
    return f"{metric.heading}: so few trials can show no difference, however large"


def _percent(value: float | None, metric: Metric) -> float | None:
    return 100 * value if value is not None and metric.rate else value


def shared_notes(study: Study) -> list[str]:
    """Notes on replies that variants share with the baseline, where their prompts are equal."""
    named = {name: group.id for group in study.models for name in group.trials["spec_hash"]}
    return [
        f"{named[row.spec_hash]}: {row.shared} of {row.calls} calls share their reply with "
        f"{named[row.baseline]}, where prompt and slot are equal: the groups are not independent, "
        "and the tests, which take them as such, are conservative there"
        for row in study.shared.itertuples()
        if row.spec_hash in named and row.baseline in named
    ]
