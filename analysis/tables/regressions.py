"""Tables III and IV: who merged first, and the gap at the merge point."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import cache

from merge_runner_analysis.data.reference_data import citation, printed_value, published
from merge_runner_analysis.data.study import Group, Study
from merge_runner_analysis.stats.group_scores import fits
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
    Kind,
    Row,
    Table,
    Value,
    row_of,
)
from merge_runner_analysis.tables.notes import sample_notes

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
RANDOM_INTERCEPT = "random intercept per pair"
KEYS = (
    Column("term", "term"),
    *GROUP_COLUMNS,
    Column("n", "n", "count", 0, "trials in the regression"),
    Column("b", "b", "number", 2, "coefficient"),
    Column("se", "SE", "number", 3, "standard error"),
)
P = Column("p", "p", "p", 3, "Wald test")


def who_first(study: Study) -> Table:
    """Table III: logistic regression of left-first on h (m) and dv (m/s)."""
    return Table(
        "who-first",
        (
            *KEYS,
            Column("z", "z", "number", 2, "b / SE"),
            P,
            _optional("firth_b", "Firth b", "Firth's penalised estimate", digits=2),
            _optional("firth_se", "SE", "its standard error"),
            _optional("firth_p", "LR p", "its likelihood-ratio test"),
        ),
        _rows(study, WHO_FIRST_TERMS, _who_first_row, _who_first_clustered),
        (TESTED_ELSEWHERE, *sample_notes(study, study.groups), *_mixed_notes(study, "S4")),
    )


def gap(study: Study) -> Table:
    """Table IV: linear regression of the gap (m) on |h|, |dv| and h*dv."""
    return Table(
        "gap",
        (
            *KEYS,
            Column("t", "t", "number", 2, "b / SE"),
            P,
            _optional("hc3_se", "HC3 SE", "HC3 standard error"),
            _optional("hc3_p", "HC3 p", "its t test"),
            _optional(
                "equivalence_p",
                "equiv. p",
                "two one-sided tests: relative velocity alone moves no gap by the margin",
            ),
            _optional(
                "velocity_p",
                "joint p",
                "F test of all terms with relative velocity, HC3 errors",
            ),
        ),
        _rows(study, GAP_TERMS, _gap_row, _gap_clustered),
        (
            "of all terms with relative velocity together: equiv. p, that the predicted gaps of "
            "any two played conditions that differ in relative velocity alone are less than "
            f"{GAP_MARGIN_M:g} m apart (two one-sided tests of each with HC3 errors, the largest "
            "p: a small one shows it); joint p, that none of them has an effect (F test)",
            TESTED_ELSEWHERE,
            *sample_notes(study, study.groups),
            *_mixed_notes(study, "S6"),
        ),
    )


def _optional(name: str, heading: str, meaning: str, digits: int = 3) -> Column:
    kind: Kind = "p" if name.endswith("_p") else "number"
    return Column(name, heading, kind, digits, meaning, optional=True)


def _rows(
    study: Study,
    terms: Iterable[str],
    row: Callable[[Group, str], Row],
    clustered: Callable[[Group], dict[str, tuple[str, Regression]]],
) -> list[Row]:
    return [
        one
        for term in terms
        for group in study.groups
        for one in (row(group, term), *_clustered_rows(group, term, clustered))
    ]


def _who_first_row(group: Group, term: str) -> Row:
    """The row of a term of who merged first: by maximum likelihood, and by Firth's fit."""
    # Wald's p fails where conditions nearly separate the outcomes, as those of humans do (Hauck and
    # Donner 1977); Firth's penalty (1993) keeps estimates finite there.
    fit = fits(group)
    return row_of(
        group,
        {
            "term": TERM_NAMES[term],
            "n": fit.logit.n,
            **_values(fit.logit, term),
            **_values(fit.firth, term, "firth_"),
        },
        _problems(fit.logit, fit.firth),
        outcomes_note(group),
        item=term,
        counts=WITH_MERGER,
    )


def _gap_row(group: Group, term: str) -> Row:
    """The row of a term of the gap: by least squares, and with HC3 errors.

    Before an import, the humans' row holds what the paper prints.
    """
    if not group.measured:
        return _published_gap(group, term)
    fit = fits(group)
    values: dict[str, Value] = {
        "term": TERM_NAMES[term],
        "n": fit.ols.n,
        **_values(fit.ols, term),
        **_values(fit.hc3, term, "hc3_"),
    }
    # I4 claims that these effects are absent. A large p is no evidence of that, so equivalence is
    # tested (Schuirmann 1987); HC3 errors (MacKinnon and White 1985) hold for unequal variances.
    if term == "abs_relative_velocity":
        values["equivalence_p"] = fit.hc3.equivalence_p
        values["velocity_p"] = fit.hc3.velocity_p
    return row_of(group, values, _problems(fit.ols, fit.hc3), item=term, counts=WITH_GAP)


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


def _problems(*found: Regression) -> str:
    """Why fits have no coefficients; empty where all have them."""
    return "; ".join(dict.fromkeys(fit.problem for fit in found if fit.problem))


def _clustered_rows(
    group: Group, term: str, clustered: Callable[[Group], dict[str, tuple[str, Regression]]]
) -> list[Row]:
    """The humans again, with errors clustered by pair; none before an import."""
    # Only humans drove in pairs: repeated trials of a pair are alike, which the pooled fit ignores.
    if group.setting or not group.measured:
        return []
    return [
        row_of(
            group,
            {
                "term": TERM_NAMES[term],
                "driver": f"{group.label}, {label}",
                "n": fit.n,
                **_values(fit, term),
            },
            fit.problem or fit.remark,
            item=f"{name}/{term}",
            counts=WITH_MERGER if clustered is _who_first_clustered else WITH_GAP,
        )
        for name, (label, fit) in clustered(group).items()
    ]


@cache
def _who_first_clustered(group: Group) -> dict[str, tuple[str, Regression]]:
    """The logit by pairs: its label and fit by the name of its rows; once for all terms."""
    fit = by_pairs(who_first_logit, group.trials, "merged_first")
    return {"clustered": ("errors by pair", fit)}


@cache
def _gap_clustered(group: Group) -> dict[str, tuple[str, Regression]]:
    """The same for our gap, and for the definition that the published mixed model uses."""
    mean100 = "gap_mean100_m"
    return {
        "clustered": ("errors by pair", by_pairs(gap_ols, group.trials, "gap_m")),
        "clustered-mean100": (
            "errors by pair, mean at 100 m",
            by_pairs(lambda trials: gap_ols(trials, mean100), group.trials, mean100),
        ),
    }


def _mixed_notes(study: Study, table: str) -> tuple[str, ...]:
    """A note with the published mixed model, for comparison with the human rows."""
    if study.human not in study.groups:
        return ()
    terms = published("human_mixed_models").query("table == @table")
    values = "; ".join(
        f"{TERM_NAMES[row.term]} {row.estimate:g} (SE {row.std_error:g})"
        for row in terms.itertuples()
    )
    return (
        f"published human mixed model ({RANDOM_INTERCEPT}, gap where the mean position reaches "
        f"100 m): {values}"
        if table == "S6"
        else f"published human mixed model ({RANDOM_INTERCEPT}): {values}",
    )


def _published_gap(group: Group, term: str) -> Row:
    """The humans' row of Table IV as the paper prints it."""
    printed = published("paper_gap").query("driver == 'human' and term == @term").iloc[0]
    return row_of(
        group,
        {
            "term": TERM_NAMES[term],
            "n": int(printed["n"]),
            "b": float(printed["b"]),
            "se": float(printed["se"]),
            "t": float(printed["t"]),
            "p": printed_value(printed["p"]),
        },
        f"published values, no human traces are imported ({citation('paper_gap')})",
        item=term,
    )
