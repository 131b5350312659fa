"""Tables III and IV: who merged first, and the gap at the merge point."""

from __future__ import annotations

from functools import cache

from analysis.data.reference_data import citation, published
from analysis.data.study import Group, Study
from analysis.stats.group_scores import fits
from analysis.stats.indicators import GAP_MARGIN_M, LARGEST_VELOCITY_MPS, equivalence_p
from analysis.stats.measures import outcomes_note
from analysis.stats.mixed import gap_mixed, who_first_mixed
from analysis.stats.regressions import GAP_TERMS, WHO_FIRST_TERMS, Regression
from analysis.tables.model import Column, Row, Table, Value
from analysis.tables.notes import sample_notes

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
    "table differences tests it"
)
# Of Table III: the columns that rest on who merged first.
EVERY = ("n", "b", "se", "z", "p", "firth_b", "firth_se", "firth_p")
RANDOM_INTERCEPT = "random intercept per pair"


def who_first(study: Study) -> Table:
    """Table III: logistic regression of left-first on h (m) and dv (m/s)."""
    rows = []
    for term in WHO_FIRST_TERMS:
        for group in study.baselines:
            fit = fits(group)
            rows.append(
                Row(
                    f"{group.id}/{term}",
                    (group.id,),
                    {
                        "term": TERM_NAMES[term],
                        "driver": group.label,
                        "n": fit.logit.n,
                        **_wald(fit.logit, term, "z"),
                        **_firth(fit.firth, term),
                    },
                    "; ".join(filter(None, (problems(fit.logit, fit.firth), outcomes_note(group)))),
                    published=EVERY,
                )
            )
            rows += _mixed_rows(group, term, "z")
    return Table(
        "who-first",
        "Logistic regression of which driver merged first (1: left)",
        (
            *_key_columns(WITH_MERGER),
            *_wald_columns("z", WITH_MERGER),
            Column(
                "firth_b", "Firth b", "number", 2, "Firth's penalised estimate", WITH_MERGER, True
            ),
            Column("firth_se", "SE", "number", 3, "its standard error", WITH_MERGER, True),
            Column("firth_p", "LR p", "p", 3, "its likelihood-ratio test", WITH_MERGER, True),
        ),
        rows,
        (
            TESTED_ELSEWHERE,
            *sample_notes(study, study.baselines),
            *_mixed_notes(study, "S4"),
        ),
        "Table III",
    )


def gap(study: Study) -> Table:
    """Table IV: linear regression of the gap (m) on |h|, |dv| and h*dv."""
    rows = []
    for term in GAP_TERMS:
        for group in study.baselines:
            if not group.measured:
                rows.append(published_gap(group, term))
                continue
            fit = fits(group)
            rows.append(
                Row(
                    f"{group.id}/{term}",
                    (group.id,),
                    {
                        "term": TERM_NAMES[term],
                        "driver": group.label,
                        "n": fit.ols.n,
                        **_wald(fit.ols, term, "t"),
                        **_hc3(fit.hc3, term),
                    },
                    problems(fit.ols, fit.hc3),
                )
            )
            rows += _mixed_rows(group, term, "t")
    return Table(
        "gap",
        "Linear regression of the gap at the merge point (m, net of the vehicle length)",
        (
            *_key_columns(WITH_GAP),
            *_wald_columns("t", WITH_GAP),
            Column("hc3_se", "HC3 SE", "number", 3, "HC3 standard error", WITH_GAP, True),
            Column("hc3_p", "HC3 p", "p", 3, "its t test", WITH_GAP, True),
            Column(
                "equivalence_p",
                "equiv. p",
                "p",
                3,
                "two one-sided tests: the effect of the largest dv stays within the margin",
                WITH_GAP,
                True,
            ),
        ),
        rows,
        (
            f"equiv. p: |effect| of {LARGEST_VELOCITY_MPS} m/s below {GAP_MARGIN_M:g} m, two "
            "one-sided tests with HC3 errors; a small p shows that the effect is smaller",
            TESTED_ELSEWHERE,
            *sample_notes(study, study.baselines),
            *_mixed_notes(study, "S6"),
        ),
        "Table IV",
    )


def _key_columns(counts: str) -> tuple[Column, ...]:
    return (
        Column("term", "term"),
        Column("driver", "driver"),
        Column("n", "n", "count", 0, "trials in the regression", counts),
    )


def _wald_columns(statistic: str, counts: str) -> tuple[Column, ...]:
    return (
        Column("b", "b", "number", 2, "coefficient", counts),
        Column("se", "SE", "number", 3, "standard error", counts),
        Column(statistic, statistic, "number", 2, "b / SE", counts),
        Column("p", "p", "p", 3, "Wald test", counts),
    )


def _wald(fit: Regression, term: str, statistic: str) -> dict[str, Value]:
    found = fit.terms.get(term)
    if found is None:
        return {}
    return {"b": found.b, "se": found.se, statistic: found.statistic, "p": found.p}


def _firth(fit: Regression, term: str) -> dict[str, Value]:
    found = fit.terms.get(term)
    return {"firth_b": found.b, "firth_se": found.se, "firth_p": found.p} if found else {}


def _hc3(fit: Regression, term: str) -> dict[str, Value]:
    found = fit.terms.get(term)
    if found is None:
        return {}
    values: dict[str, Value] = {"hc3_se": found.se, "hc3_p": found.p}
    if term == "abs_relative_velocity":
        values["equivalence_p"] = float(equivalence_p(found.b, found.se, fit.freedom))
    return values


def problems(*found: Regression) -> str:
    """What keeps any of the fits from having terms, empty where nothing does."""
    return "; ".join(dict.fromkeys(fit.problem for fit in found if fit.problem))


def _mixed_rows(group: Group, term: str, statistic: str) -> list[Row]:
    """The humans again, with a random intercept per pair; after an import alone."""
    if group.setting or not group.measured:
        return []
    return [
        Row(
            f"{group.id}/{model}/{term}",
            (group.id,),
            {
                "term": TERM_NAMES[term],
                "driver": f"{group.label}, {label}",
                "n": fit.n,
                **_wald(fit, term, statistic),
            },
            fit.problem or fit.remark,
        )
        for model, label, fit in _mixed(group, "who-first" if statistic == "z" else "gap")
    ]


@cache
def _mixed(group: Group, name: str) -> list[tuple[str, str, Regression]]:
    """Name, label and fit of the mixed models; the published gap is that at mean 100 m."""
    if name == "who-first":
        return [("mixed", RANDOM_INTERCEPT, who_first_mixed(group.trials))]
    return [
        ("mixed", RANDOM_INTERCEPT, gap_mixed(group.trials)),
        (
            "mixed-mean100",
            f"{RANDOM_INTERCEPT}, mean at 100 m",
            gap_mixed(group.trials, "gap_mean100_m"),
        ),
    ]


def _published_p(text: str) -> Value:
    """A printed p-value; ``<0.001`` stays a text."""
    return text if text.startswith("<") else float(text)


def _mixed_notes(study: Study, table: str) -> tuple[str, ...]:
    """The published mixed model, to compare the human rows with."""
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


def published_gap(group: Group, term: str) -> Row:
    """The humans' row of Table IV as the paper prints it."""
    values = published("paper_gap").query("driver == 'human' and term == @term").iloc[0]
    return Row(
        f"{group.id}/{term}",
        (group.id,),
        {
            "term": TERM_NAMES[term],
            "driver": group.label,
            "n": int(values["n"]),
            "b": float(values["b"]),
            "se": float(values["se"]),
            "t": float(values["t"]),
            "p": _published_p(str(values["p"])),
        },
        f"published values, no human traces are imported ({citation('paper_gap')})",
        printed=("n", "b", "se", "t", "p"),
    )
