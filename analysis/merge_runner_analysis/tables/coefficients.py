"""Rows of the regression tables: one for each term, driver and fit."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import astuple

from merge_runner_analysis.grouping import Group
from merge_runner_analysis.published import published
from merge_runner_analysis.stats.regressions import Regression
from merge_runner_analysis.study import StudyResults
from merge_runner_analysis.tables.model import GROUP_COLUMNS, Column, Row, Value, row_of

TERM_NAMES = {
    "intercept": "Intercept",
    "projected_headway": "Projected headway",
    "relative_velocity": "Relative velocity",
    "abs_projected_headway": "Abs. projected headway",
    "abs_relative_velocity": "Abs. relative velocity",
    "headway_x_velocity": "Headway : relative velocity",
}
TESTED_ELSEWHERE = (
    "whether two drivers differ cannot be read off their p-values: for drivers and humans the "
    "table verdicts tests it"
)
KEYS = (
    Column("term", "term"),
    *GROUP_COLUMNS,
    Column("n", "n", "count", "trials in the regression"),
    Column("b", "b", "number", "coefficient"),
    Column("se", "SE", "number", "standard error", digits=3),
)
P = Column("p", "p", "p", "Wald test")
# A prefix of row names, a suffix of labels, and a fit and a robust one to the same trials, by the
# prefix of their values' names.
Fit = tuple[str, str, dict[str, Regression]]
BY_PAIR = ", errors by pair"


def row_of_term(group: Group, term: str, fit: Fit, rests_on: str, note: object = "") -> Row:
    """Return a term's row by one of a group's fits to the trials with a value in this column."""
    item, label, regressions = fit
    values: dict[str, Value] = {
        "term": TERM_NAMES[term],
        "driver": group.label + label,
        "n": regressions[""].n,
    }
    for prefix, regression in regressions.items():
        if term in regression.terms:
            b, se, statistic, p = astuple(regression.terms[term])
            # A table shows one of z and t.
            named = {"b": b, "se": se, "z": statistic, "t": statistic, "p": p}
            values |= {prefix + name: value for name, value in named.items()}
    # I4 claims that these effects are absent. A large p is no evidence of that, so equivalence is
    # tested (Schuirmann 1987).
    if "hc3_" in regressions and term == "abs_relative_velocity":
        values["equivalence_p"] = regressions["hc3_"].equivalence_p
        values["velocity_p"] = regressions["hc3_"].velocity_p
    fits = regressions.values()
    remarks = dict.fromkeys(fact for fitted in fits for fact in (fitted.problem, fitted.remark))
    return row_of(group, values, *remarks, note, item=item + term, rests_on=rests_on)


def mixed_note(study: StudyResults, table: str, model: str) -> Iterator[str]:
    """Yield a note with the published mixed model, for comparison with the human rows."""
    if study.human in study.groups:
        values = "; ".join(
            f"{TERM_NAMES[row.term]} {row.estimate:g} (SE {row.std_error:g})"
            for row in published("human_mixed_models").query("table == @table").itertuples()
        )
        yield f"published human mixed model ({model}): {values}"
