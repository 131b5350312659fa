"""Table III: who merged first."""

from __future__ import annotations

from merge_runner_analysis.grouping import Group
from merge_runner_analysis.metrics import LEFT_FIRST
from merge_runner_analysis.stats.indicators import fits
from merge_runner_analysis.stats.measures import outcomes_note
from merge_runner_analysis.stats.regressions import WHO_FIRST_TERMS, by_pairs, who_first_logit
from merge_runner_analysis.study import StudyResults
from merge_runner_analysis.tables.coefficients import (
    BY_PAIR,
    KEYS,
    TESTED_ELSEWHERE,
    Fit,
    P,
    mixed_note,
    row_of_term,
)
from merge_runner_analysis.tables.model import Column, Optional, Table


def who_first(study: StudyResults) -> Table:
    """Return Table III: logistic regression of left-first on h (m) and dv (m/s)."""
    fitted = {group: _fits(group) for group in study.groups}
    return Table(
        "who-first",
        (
            *KEYS,
            Column("z", "z", "number", "b / SE"),
            P,
            Optional("firth_b", "Firth b", "number", "Firth's penalised estimate"),
            Optional("firth_se", "SE", "number", "its standard error", digits=3),
            Optional("firth_p", "LR p", "p", "its likelihood-ratio test"),
        ),
        [
            row_of_term(group, term, fit, LEFT_FIRST.column, "" if fit[1] else outcomes_note(group))
            for term in WHO_FIRST_TERMS
            for group in study.groups
            for fit in fitted[group]
        ],
        (
            "b, SE, z and p: the paper's maximum likelihood with Wald's tests; Firth b, SE and LR "
            "p: the penalised estimate that the verdicts rest on, with its likelihood-ratio test",
            TESTED_ELSEWHERE,
            *mixed_note(study, "S4", "random intercept per pair"),
        ),
    )


def _fits(group: Group) -> list[Fit]:
    """Return fits by maximum likelihood and by Firth, of humans also with errors by pair."""
    # Wald's p fails where conditions nearly separate the outcomes, as with humans (Hauck and
    # Donner 1977); Firth's penalty (1993) keeps estimates finite there.
    every: list[Fit] = [("", "", {"": fits(group).logit, "firth_": fits(group).firth})]
    if not group.setting and group.measured:
        # Repeated trials of a pair are alike, which the pooled fit ignores.
        paired = by_pairs(who_first_logit, group.trials, "merged_first")
        every.append(("clustered/", BY_PAIR, {"": paired}))
    return every
