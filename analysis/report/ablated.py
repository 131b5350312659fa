"""In plain words: what each driver's prompt variants change, and what could not be shown."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import comb, prod
from typing import Any

from analysis.data.study import Group, Study
from analysis.metrics import Metric, compared
from analysis.names import BASELINE
from analysis.stats.indicators import ALPHA
from analysis.stats.intervals import POWER
from analysis.tables import finished_tables
from analysis.tables.model import Row
from analysis.tables.notes import listed


@dataclass(frozen=True, slots=True)
class Change:
    """What a variant changes in one measure, named by ``what``.

    ``difference``, ``ci`` and ``detectable`` are in the unit of that measure. ``possible`` says
    whether a test of so few trials can give p < .05 at all.
    """

    setting: str
    what: str
    difference: float
    ci: tuple[float, float] | None
    p_holm: float
    detectable: float | None
    possible: bool

    @property
    def text(self) -> str:
        """``the gap by -2.40 m (95 % CI -3.23 to -1.57)``."""
        name, unit = _names()[self.what]
        interval = f" (95 % CI {self.ci[0]:+.2f} to {self.ci[1]:+.2f})" if self.ci else ""
        return f"{name} by {self.difference:+.2f} {unit}{interval}"


def _names() -> dict[str, tuple[str, str]]:
    """Each measure that may differ: how a sentence names it, and its unit."""
    return {
        metric.name: (metric.in_sentences, "points" if metric.rate else metric.unit)
        for metric in compared()
    }


def ablation_sentences(study: Study) -> list[str]:
    """What is shown about the variants of each driver, except those that stand-ins answered."""
    references = {group.driver: group for group in study.models if group.setting == study.reference}
    shown = [
        group for group in study.models if group.setting != study.reference and not group.scripted
    ]
    if not shown:
        return []
    # The sentences quote the table's values, so that text and table cannot disagree.
    (table,) = finished_tables(study.db, None, ["contrasts"], study)
    rows = {row.id: row for row in table.rows}
    return [
        text
        for label in dict.fromkeys(group.label for group in shown)
        for mine in [[group for group in shown if group.label == label]]
        for text in _of_driver(label, mine, study.reference, references.get(mine[0].driver), rows)
    ]


def _of_driver(
    label: str,
    groups: list[Group],
    reference: str,
    baseline: Group | None,
    rows: dict[str, Row],
) -> Iterator[str]:
    names = ", ".join(group.setting for group in groups)
    if all((group.trials["source"] == "driver").all() for group in groups):
        yield f"{label} is a program and reads no prompt: {names} can change nothing."
        return
    if baseline is None:
        lacking = "baseline" if reference == BASELINE else f"prompt {reference}"
        yield f"{label}: it has no {lacking} to compare with: what {names} changes cannot be said."
        return
    changes = [change for group in groups for change in _changes(group, baseline, rows)]
    for group in groups:
        yield from _differs(label, group, baseline, changes)
    # A test that could not have reached 5 % says nothing when it does not, unlike one
    # that could have found a difference and did not.
    possible = [one for one in changes if one.possible and one.p_holm >= ALPHA]
    yield from _not_shown(label, baseline, possible)
    yield from _too_few(label, [one for one in changes if not one.possible])
    yield from _not_compared(label, baseline, groups, changes)


def _changes(group: Group, baseline: Group, rows: dict[str, Row]) -> Iterator[Change]:
    for metric in compared():
        row = rows.get(f"{group.id}/{baseline.setting}/{metric.name}")
        if row is not None:
            # Before Holm's correction, which only makes p larger: a lenient bound.
            possible = not metric.rate or smallest_p(group, baseline, metric) < ALPHA
            values: dict[str, Any] = dict(row.values)
            yield Change(
                group.setting,
                metric.name,
                values["difference"],
                values["ci"],
                values["p_holm"],
                values.get("detectable"),
                possible,
            )


def smallest_p(group: Group, baseline: Group, metric: Metric) -> float:
    """The smallest p that Fisher's test of so many trials can give, whatever their outcomes.

    That is where the rate is 1 in one group and 0 in the other.
    """
    first, second = (
        one.trials.dropna(subset=[metric.column])["condition"].value_counts()
        for one in (group, baseline)
    )
    shared = [
        (int(first[name]), int(second[name])) for name in first.index.intersection(second.index)
    ]
    # Two-sided: where all sizes are equal, swapping the groups gives an equally large difference.
    extreme = 2 if all(n == m for n, m in shared) else 1
    return extreme / prod(comb(n + m, n) for n, m in shared)


def _differs(label: str, group: Group, baseline: Group, changes: list[Change]) -> Iterator[str]:
    found = [one.text for one in changes if one.setting == group.setting and one.p_holm < ALPHA]
    if found:
        yield (
            f"{label}, {group.setting} ({len(group.ended)} trials) differs from {_named(baseline)} "
            f"({len(baseline.ended)}), also after Holm's correction, in {listed(found)}."
        )


def _named(baseline: Group) -> str:
    setting = baseline.setting
    return f"the {BASELINE}" if setting == BASELINE else f"the prompt {setting}"


def _not_shown(label: str, baseline: Group, changes: list[Change]) -> Iterator[str]:
    if not changes:
        return
    sizes = [
        f"{_span(found)} {unit} in {name}"
        for what, (name, unit) in _names().items()
        for found in [
            [c.detectable for c in changes if c.what == what and c.detectable is not None]
        ]
        if found
    ]
    shown = f"{label}: no difference from {_named(baseline)} is shown, after Holm's correction, in "
    yield shown + (
        f"{_which(changes)}."
        if not sizes
        else f"{_which(changes)}. That does not show that there is none: the smallest difference "
        f"that one such test, not yet corrected, finds with a chance of {100 * POWER:.0f} % is "
        f"about {listed(sizes)}."
    )


def _too_few(label: str, changes: list[Change]) -> Iterator[str]:
    if changes:
        yield (
            f"{label}: nothing could have been shown in {_which(changes)}: with so few trials no "
            "outcome reaches p < .05."
        )


def _not_compared(
    label: str, baseline: Group, groups: list[Group], changes: list[Change]
) -> Iterator[str]:
    there = {(one.setting, one.what) for one in changes}
    lacking = [
        (group.setting, what)
        for what in _names()
        for group in groups
        if (group.setting, what) not in there
    ]
    if lacking:
        yield (
            f"{label}: not compared with {_named(baseline)}: "
            f"{_grouped(lacking)}. The notes of the table contrasts say why."
        )


def _which(changes: list[Change]) -> str:
    return _grouped([(one.setting, one.what) for one in changes])


def _grouped(found: list[tuple[str, str]]) -> str:
    """Measures, each with its variants; those with the same variants share a list."""
    alike: dict[str, list[str]] = {}
    for what, (name, _) in _names().items():
        settings = ", ".join(setting for setting, other in found if other == what)
        if settings:
            alike.setdefault(settings, []).append(name)
    return "; ".join(f"{listed(names)} ({settings})" for settings, names in alike.items())


def _span(values: list[float]) -> str:
    low, high = (f"{value:.2f}" for value in (min(values), max(values)))
    return low if low == high else f"{low} to {high}"
