"""Coefficients of a prompt variant against those of its driver's reference prompt."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

from analysis.data.study import Group, Study, in_one_study
from analysis.stats.contrasts import corrected
from analysis.stats.group_scores import fits
from analysis.stats.intervals import Difference
from analysis.stats.regressions import differences

Differences = Callable[[Group, Group], Mapping[str, Difference]]


@dataclass(frozen=True, slots=True)
class Corrected:
    """A difference of a variant, and its p corrected over the variants of its driver."""

    found: Difference
    holm: float
    bh: float


def variants(study: Study) -> Iterator[tuple[Group, Group | None]]:
    """Every prompt with its driver's reference, None where that was not played."""
    references = {group.driver: group for group in study.models if group.setting == study.reference}
    for group in study.models:
        if group.setting != study.reference:
            yield group, references.get(group.driver)


def corrected_differences(study: Study, compare: Differences) -> dict[tuple[str, str], Corrected]:
    """By group and term what there is; a family is one term of one driver over its variants."""
    families: dict[tuple[str, str], dict[str, Difference]] = {}
    for group, baseline in variants(study):
        if baseline is not None and in_one_study(study, group, baseline):
            for term, found in compare(group, baseline).items():
                families.setdefault((group.driver, term), {})[group.id] = found
    return {
        (name, term): Corrected(found, float(holm), float(bh))
        for (_, term), family in families.items()
        for (name, found), holm, bh in zip(
            family.items(), *corrected([one.p for one in family.values()]), strict=True
        )
    }


def gap_differences(group: Group, baseline: Group) -> dict[str, Difference]:
    """By term of the gap's regression, with HC3 errors; empty where a group has no such fit."""
    return differences(fits(group).hc3, fits(baseline).hc3, "HC3")


def who_first_differences(group: Group, baseline: Group) -> dict[str, Difference]:
    """By term of the logit; empty where one of the two has no finite estimate."""
    return differences(fits(group).logit, fits(baseline).logit, "logit")
