"""Tables III and IV: who merged first, and the gap at the merge point."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import NamedTuple

from merge_runner_analysis.data.reference_data import citation, printed_value, published
from merge_runner_analysis.data.study import Group, Study
from merge_runner_analysis.stats.indicators import fits
from merge_runner_analysis.stats.measures import outcomes_note
from merge_runner_analysis.stats.regressions import (
    GAP_MARGIN_M,
    GAP_TERMS,
    WHO_FIRST_TERMS,
    Regression,
    by_pairs,
    gap_ols,
    who_first_logit,
)
from merge_runner_analysis.tables.model import (
    GROUP_COLUMNS,
    Column,
    Optional,
    Row,
    Table,
    Value,
    row_of,
)

TERM_NAMES = {
    "intercept": "Intercept",
    "projected_headway": "Projected headway",
    "relative_velocity": "Relative velocity",
    "abs_projected_headway": "Abs. projected headway",
    "abs_relative_velocity": "Abs. relative velocity",
    "headway_x_velocity": "Headway : relative velocity",
}
WITH_MERGER = "status = 'finished' AND merged_first IS NOT NULL"
WITH_GAP = "gap_m IS NOT NULL"
TESTED_ELSEWHERE = (
    "whether two drivers differ cannot be read off their p-values: for drivers and humans the "
    "table verdicts tests it"
)
KEYS = (
    Column("term", "term"),
    *GROUP_COLUMNS,
    Column("n", "n", "count", 0, "trials in the regression"),
    Column("b", "b", "number", 2, "coefficient"),
    Column("se", "SE", "number", 3, "standard error"),
)
P = Column("p", "p", "p", 3, "Wald test")


class Fit(NamedTuple):
    """A fit of a group's trials, and a robust one whose values' names begin with ``prefix``.

    ``item`` and ``label`` tell a further fit of the same trials from the first.
    """

    main: Regression
    robust: Regression | None = None
    prefix: str = ""
    item: str = ""
    label: str = ""


def who_first(study: Study) -> Table:
    """Table III: logistic regression of left-first on h (m) and dv (m/s)."""
    return Table(
        "who-first",
        (
            *KEYS,
            Column("z", "z", "number", 2, "b / SE"),
            P,
            Optional("firth_b", "Firth b", "number", 2, "Firth's penalised estimate"),
            Optional("firth_se", "SE", "number", 3, "its standard error"),
            Optional("firth_p", "LR p", "p", 3, "its likelihood-ratio test"),
        ),
        [
            row
            for term in WHO_FIRST_TERMS
            for group in study.groups
            for row in _rows(group, term, _who_first_fits(group), WITH_MERGER)
        ],
        (TESTED_ELSEWHERE, *_mixed_note(study, "S4", "random intercept per pair")),
    )


def gap(study: Study) -> Table:
    """Table IV: linear regression of the gap (m) on |h|, |dv| and h*dv."""
    rows: list[Row] = []
    for term in GAP_TERMS:
        for group in study.groups:
            if group.measured:
                rows += _rows(group, term, _gap_fits(group), WITH_GAP)
            else:
                rows.append(_published_gap(group, term))
    return Table(
        "gap",
        (
            *KEYS,
            Column("t", "t", "number", 2, "b / SE"),
            P,
            Optional("hc3_se", "HC3 SE", "number", 3, "HC3 standard error"),
            Optional("hc3_p", "HC3 p", "p", 3, "its t test"),
            Optional("equivalence_p", "equiv. p", "p", 3, "two one-sided tests of the margin"),
            Optional("velocity_p", "joint p", "p", 3, "F test of all terms with relative velocity"),
        ),
        rows,
        (
            "of all terms with relative velocity together: equiv. p, that the predicted gaps of "
            "any two played conditions that differ in relative velocity alone are less than "
            f"{GAP_MARGIN_M:g} m apart (two one-sided tests of each with HC3 errors, the largest "
            "p: a small one shows it); joint p, that none of them has an effect",
            TESTED_ELSEWHERE,
            *_mixed_note(
                study, "S6", "random intercept per pair, gap where the mean position reaches 100 m"
            ),
        ),
    )


@cache
def _who_first_fits(group: Group) -> tuple[Fit, ...]:
    """By maximum likelihood and by Firth's fit, the humans also with errors by pair."""
    # Wald's p fails where conditions nearly separate the outcomes, as those of humans do (Hauck and
    # Donner 1977); Firth's penalty (1993) keeps estimates finite there.
    fit = Fit(fits(group).logit, fits(group).firth, "firth_")
    if group.setting or not group.measured:
        return (fit,)
    # Repeated trials of a pair are alike, which the pooled fit ignores.
    paired = by_pairs(who_first_logit, group.trials, "merged_first")
    return (fit, Fit(paired, item="clustered/", label=", errors by pair"))


@cache
def _gap_fits(group: Group) -> tuple[Fit, ...]:
    """By least squares and with HC3 errors, the humans also with errors by pair."""
    fit = Fit(fits(group).ols, fits(group).hc3, "hc3_")
    if group.setting:
        return (fit,)
    mean100 = "gap_mean100_m"  # the definition of the gap that the published mixed model uses
    paired = by_pairs(gap_ols, group.trials, "gap_m")
    of_mean = by_pairs(lambda trials: gap_ols(trials, mean100), group.trials, mean100)
    return (
        fit,
        Fit(paired, item="clustered/", label=", errors by pair"),
        Fit(of_mean, item="clustered-mean100/", label=", errors by pair, mean at 100 m"),
    )


def _rows(group: Group, term: str, every: tuple[Fit, ...], counts: str) -> Iterator[Row]:
    """The rows of a term."""
    for fit in every:
        main, robust = fit.main, fit.robust
        values = {
            "term": TERM_NAMES[term],
            "driver": group.label + fit.label,
            "n": main.n,
            **_values(main, term),
            **(_values(robust, term, fit.prefix) if robust else {}),
        }
        # I4 claims that these effects are absent. A large p is no evidence of that, so equivalence
        # is tested (Schuirmann 1987); HC3 errors (MacKinnon and White 1985) hold for unequal
        # variances.
        if robust and term == "abs_relative_velocity":
            values["equivalence_p"] = robust.equivalence_p
            values["velocity_p"] = robust.velocity_p
        problems = dict.fromkeys((main.problem, robust.problem if robust else main.remark))
        pooled = "" if fit.label or counts == WITH_GAP else outcomes_note(group)
        yield row_of(group, values, *problems, pooled, item=fit.item + term, counts=counts)


def _values(fit: Regression, term: str, prefix: str = "") -> dict[str, Value]:
    """A coefficient's values; its statistic goes under both z and t, and a table shows one."""
    found = fit.terms.get(term)
    if found is None:
        return {}
    return {
        f"{prefix}b": found.b,
        f"{prefix}se": found.se,
        f"{prefix}z": found.statistic,
        f"{prefix}t": found.statistic,
        f"{prefix}p": found.p,
    }


def _mixed_note(study: Study, table: str, model: str) -> Iterator[str]:
    """A note with the published mixed model, for comparison with the human rows."""
    if study.human in study.groups:
        values = "; ".join(
            f"{TERM_NAMES[row.term]} {row.estimate:g} (SE {row.std_error:g})"
            for row in published("human_mixed_models").query("table == @table").itertuples()
        )
        yield f"published human mixed model ({model}): {values}"


def _published_gap(group: Group, term: str) -> Row:
    """The humans' row of Table IV as the paper prints it."""
    printed = published("paper_gap").query("driver == 'human' and term == @term").iloc[0]
    values = {name: printed_value(printed[name]) for name in ("b", "se", "t", "p")}
    note = f"published values, no human traces are imported ({citation('paper_gap')})"
    return row_of(
        group, {"term": TERM_NAMES[term], "n": int(printed["n"]), **values}, note, item=term
    )
