"""Table IV: the gap."""

from __future__ import annotations

from merge_runner_analysis.grouping import Group
from merge_runner_analysis.metrics import GAP
from merge_runner_analysis.published import citation, printed_value, published
from merge_runner_analysis.stats.indicators import fits
from merge_runner_analysis.stats.regressions import GAP_MARGIN_M, GAP_TERMS, by_pairs, gap_ols
from merge_runner_analysis.study import StudyResults
from merge_runner_analysis.tables.coefficients import (
    BY_PAIR,
    KEYS,
    TERM_NAMES,
    TESTED_ELSEWHERE,
    Fit,
    P,
    mixed_note,
    row_of_term,
)
from merge_runner_analysis.tables.model import Column, Optional, Row, Table, row_of


def gap(study: StudyResults) -> Table:
    """Return Table IV: linear regression of the gap (m) on |h|, |dv| and h*dv."""
    mean100 = "random intercept per pair, gap where the mean position reaches 100 m"
    fitted = {group: _fits(group) for group in study.measured}
    return Table(
        "gap",
        (
            *KEYS,
            Column("t", "t", "number", "b / SE"),
            P,
            Optional("hc3_se", "HC3 SE", "number", "HC3 standard error", digits=3),
            Optional("hc3_p", "HC3 p", "p", "its t test"),
            Optional("equivalence_p", "equiv. p", "p", "two one-sided tests of the margin"),
            Optional("velocity_p", "joint p", "p", "F test of all terms with relative velocity"),
        ),
        [
            row
            for term in GAP_TERMS
            for group in study.groups
            for row in (
                [row_of_term(group, term, fit, GAP.column) for fit in fitted[group]]
                if group in fitted
                else [_published(group, term)]
            )
        ],
        (
            "equiv. p and joint p, where they can be computed, are of all terms with relative "
            "velocity: equiv. p, that the predicted gaps of any two played conditions that differ "
            f"in relative velocity alone are less than {GAP_MARGIN_M:g} m apart (two one-sided "
            "tests of each with HC3 errors, the largest p: a small one shows it); joint p, that "
            "none of them has an effect",
            TESTED_ELSEWHERE,
            *mixed_note(study, "S6", mean100),
        ),
    )


def _fits(group: Group) -> list[Fit]:
    """Return fits by least squares and with HC3 errors, of humans also with errors by pair."""
    # HC3 errors (MacKinnon and White 1985) hold for unequal variances.
    every: list[Fit] = [("", "", {"": fits(group).ols, "hc3_": fits(group).hc3})]
    if not group.setting:
        mean100 = "gap_mean100_m"  # the definition of the gap that the published mixed model uses
        paired = by_pairs(gap_ols, group.trials, "gap_m")
        of_mean = by_pairs(lambda trials: gap_ols(trials, mean100), group.trials, mean100)
        every.append(("clustered/", BY_PAIR, {"": paired}))
        every.append(("clustered-mean100/", f"{BY_PAIR}, mean at 100 m", {"": of_mean}))
    return every


def _published(group: Group, term: str) -> Row:
    printed = published("paper_gap").query("driver == 'human' and term == @term").iloc[0]
    values = {name: printed_value(printed[name]) for name in ("b", "se", "t", "p")}
    note = f"published values, no human traces are imported ({citation('paper_gap')})"
    return row_of(
        group, {"term": TERM_NAMES[term], "n": int(printed["n"]), **values}, note, item=term
    )
