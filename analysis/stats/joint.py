"""Whether a driver differs from the humans: one model of both, with the source in every term.

Who merged first is left ~ (h + dv) x source (logit), the gap is ~ (|h| + |dv| + h*dv) x source
(least squares); source is 1 for the driver and 0 for the humans. Since it stands in every term, the
likelihood falls apart into one factor of the humans and one of the driver: an interaction is the
driver's coefficient minus the humans' (see ``regressions.differences``). Where one of the two is
separated, it has no finite estimate, and there is none.

The driver's trials are independent: Fisher's information in the logit, HC3 errors for the gap. The
humans' come from pairs who differ (see ``regressions.by_pairs``); the sum has Satterthwaite's
degrees of freedom (1946).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

from merge_runner_analysis.data.reference_data import citation, published
from merge_runner_analysis.data.study import Group
from merge_runner_analysis.stats.group_scores import fits
from merge_runner_analysis.stats.intervals import Difference
from merge_runner_analysis.stats.regressions import (
    GAP_TERMS,
    MIN_PAIRS,
    WHO_FIRST_TERMS,
    Regression,
    by_pairs,
    differences,
    gap_ols,
    wald_term,
    who_first_logit,
)

WHO_FIRST = "who-first"
GAP = "gap"
NARROW = "trials are taken as independent, and the interval is too narrow"
NO_PAIRS = f"which pair drove is not published: {NARROW}"


@dataclass(frozen=True, slots=True)
class Interaction:
    """How far a term of ``outcome`` differs between a driver and the humans.

    That of ``intercept`` is the source itself. ``driver`` and ``human`` are the two coefficients,
    ``n`` and ``n_human`` their trials, and ``found`` the driver's minus the humans'. ``problem``
    says why there is none of these; ``remark`` what to know of them.
    """

    outcome: str
    term: str
    n: int
    n_human: int
    driver: float | None = None
    human: float | None = None
    found: Difference | None = None
    problem: str = ""
    remark: str = ""


@cache
def interactions(human: Group, group: Group) -> tuple[Interaction, ...]:
    """How a driver differs from the humans: in who merged first, then in the gap, by term."""
    return (
        *_by_term(WHO_FIRST, fits(group).logit, _human_who_first(human), "ML"),
        *_by_term(GAP, fits(group).hc3, _human_gap(human), "least squares"),
    )


def pairs_known(human: Group, outcome: str) -> int:
    """How many pairs of imported humans have the outcome; 0 where that of the published counts."""
    trials = human.outcomes if outcome == WHO_FIRST else human.finished
    return trials["pair"].nunique() if "pair" in trials else 0


def _by_term(outcome: str, driver: Regression, human: Regression, by: str) -> list[Interaction]:
    """An interaction with the source for each term, or why there is none."""
    found = differences(driver, human, by)
    problem = driver.problem or (f"humans: {human.problem}" if human.problem else "")
    steady = "neither the driver nor the humans vary: there is nothing to test"
    return [
        Interaction(outcome, term, driver.n, human.n, problem=problem or steady)
        if problem or term not in found
        else Interaction(
            outcome,
            term,
            driver.n,
            human.n,
            driver.terms[term].b,
            human.terms[term].b,
            found[term],
            remark=human.remark,
        )
        for term in (WHO_FIRST_TERMS if outcome == WHO_FIRST else GAP_TERMS)
    ]


@cache
def _human_who_first(human: Group) -> Regression:
    """The humans' logit; published outcomes know no pairs."""
    pairs = pairs_known(human, WHO_FIRST)
    if pairs >= MIN_PAIRS:
        return by_pairs(who_first_logit, human.outcomes, "merged_first")
    fit = fits(human).logit
    remark = f"{pairs} pairs are too few: {NARROW}" if pairs else NO_PAIRS
    return Regression(fit.n, fit.terms, fit.problem, remark=remark)


@cache
def _human_gap(human: Group) -> Regression:
    """The humans' regression of the gap, as published while there are not traces of three pairs."""
    if pairs_known(human, GAP) >= MIN_PAIRS:
        return by_pairs(gap_ols, human.trials, "gap_m")
    rows = published("paper_gap").query("driver == 'human'").set_index("term")
    n = int(rows["n"].iloc[0])
    freedom = n - len(GAP_TERMS)
    terms = {
        name: wald_term(float(rows["b"][name]), float(rows["se"][name]), freedom)
        for name in GAP_TERMS
    }
    remark = f"humans as published ({citation('paper_gap')}); {NO_PAIRS}"
    return Regression(n, terms, freedom=freedom, remark=remark)
