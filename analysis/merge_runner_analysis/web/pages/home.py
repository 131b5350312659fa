"""The study on one screen: its question, a row and a sentence on each driver, what to type next."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from merge_runner.drivers.registry import EMULATOR
from merge_runner_analysis.headlines import headline
from merge_runner_analysis.web.comparison import Comparison, compared
from merge_runner_analysis.web.computing import Job
from merge_runner_analysis.web.judged import Driver, by_condition, by_kind, humans_of, judged, noted
from merge_runner_analysis.web.names import PLAYED, names_mean, opponents_text, short_names
from merge_runner_analysis.web.next_steps import is_found, is_rehearsal, next_steps
from merge_runner_analysis.web.people import (
    UNPOSED,
    could_see,
    counted,
    equal_trials,
    gap_weights,
    likeness_of,
    other_differences,
    people_of,
    repeated,
    verdict_rules,
)
from merge_runner_analysis.web.question import Answer, answer_of
from merge_runner_analysis.web.runs import standing_of, words_here
from merge_runner_analysis.web.scope import Bar, Scope, descriptions_of, scope_of, unmarked
from merge_runner_analysis.web.site import Site, news_of
from merge_runner_analysis.wording import HEADINGS, LANGUAGE_MODEL, MOCK, PROGRAM

FACTOR_TABLES = ("effects", "levels")  # of a study's factors
# Kinds of drivers whose identical trials count once.
ONCE = {
    PROGRAM: "Identical trials of a program count once.",
    MOCK: "Trials of a mock model that differ only in words it does not read count once.",
}
DRAWN = "who goes first is drawn by lot, with people's odds"  # the emulator
Jobs = list[Job]


def _question(site: Site, bar: Bar) -> tuple[Jobs, Jobs, Answer | None]:
    """Return the jobs of the factor tables, those still without a table, and the answer."""
    if len(bar.prompts) < 2 and not site.trial_index.factors():
        return [], [], None
    part = bar.scope.sweep, bar.scope.condition
    computed = [site.table(name, *part) for name in FACTOR_TABLES]
    jobs, tables = zip(*computed, strict=True)
    return [*jobs], [job for job, table in computed if table is None], answer_of(*tables)


def _rivals(
    site: Site, drivers: Sequence[Driver], scope: Scope
) -> tuple[Jobs, Jobs, Comparison | None]:
    """Return jobs as ``_question`` does, and the comparison of two models of one kind.

    They are language models or, in a rehearsal, mock models.
    """
    kinds = {driver.kind for driver in drivers}
    if len(drivers) != 2 or kinds not in ({LANGUAGE_MODEL}, {MOCK}):
        return [], [], None
    job, is_awaited, apart = compared(site, drivers[0], drivers[1], scope)
    return [job], [job] * is_awaited, apart


def _beside_people(
    drivers: Sequence[Driver],
    short: Mapping[str, str],
    human: Mapping[str, Any],
    conditions: Mapping[str, Any],
) -> dict[str, Any]:
    verdicts = {
        short[driver.name]: {name: cell.values for name, cell in driver.cells.items()}
        or {"": {"kind": driver.kind}}
        for driver in drivers
    }
    people = people_of(conditions, human)
    unposed = {name: note for name, note in UNPOSED.items() if name not in people}
    gap = human["cells"].get("gap")
    is_undecided = any(of.cells["collisions"].values.get("undecided") for of in drivers if of.cells)
    # The table of likeness has the bounds of undecided crashes, and the page explains them.
    headings = {n: text for n, text in HEADINGS.items() if n != "collisions" or not is_undecided}
    return {
        "headline": headline(verdicts),
        "likeness": [
            (
                driver,
                likeness_of(driver),
                filter(
                    None,
                    (
                        DRAWN * (EMULATOR in driver.name and "+" not in driver.name),
                        counted(driver, conditions),
                        other_differences(driver),
                    ),
                ),
            )
            for kind in by_kind(drivers).values()
            for driver in kind
        ],
        "verdict_rules": verdict_rules(drivers, gap.values if gap else {}),
        "gap_weights": gap_weights(drivers, short),
        "repeats": any(repeated(of, conditions)[0] for of in drivers if of.cells),
        "count_once": [text for kind, text in ONCE.items() if by_kind(drivers)[kind]],
        "equal_trials": equal_trials(drivers, short),
        "is_undecided": is_undecided,
        "notes": noted(drivers, headings, unposed),
        "likeness_headings": HEADINGS,
        "people": people,
        "could_see": could_see(drivers, short),
    }


def home_page(site: Site, params: Mapping[str, str]) -> str:
    """Return the study's page; raises NotThere, or NothingNew if it is still as ``seen`` says."""
    standing = standing_of(site.trial_index)
    bar = scope_of(site, params)
    scope = bar.scope
    drivers, values = judged(site, bar, params)
    shown = [
        driver
        for driver in drivers
        if driver.prompt == scope.prompt
        and (not scope.drivers or unmarked(driver.name) in scope.drivers)
    ]
    jobs, asking, question = _question(site, bar)
    apart = None
    if not jobs:
        jobs, asking, apart = _rivals(site, shown, scope)
    older = [job.older for job in (values["computed"], *jobs)]
    now = standing, site.trial_index.state, site.trial_index.copies.is_locked, older
    seen = news_of(now, params.get("seen", ""))
    conditions = by_condition(site, scope, shown, order=params.get("order", ""))
    names = [driver.name for driver in shown]
    short = short_names(names)
    # The people's values are those in the first driver's conditions.
    human = humans_of(values["table"], next(iter(shown), None))
    typed = standing[0]["config"].get("typed") if standing else None
    sweep = words_here(typed or ("sweep", "STUDY"), site.db)
    study = (standing[0]["config"].get("study") or {}).get("text", "") if standing else ""
    return site.render(
        "home.html",
        view="index",
        **values,
        **_beside_people(shown, short, human, conditions),
        short=short,
        names_mean=names_mean(site.trial_index.ask(PLAYED), names),
        opponents=opponents_text(names),
        part=scope.part,
        standing=standing,
        seen=seen,
        descriptions=descriptions_of(site),
        is_rehearsal=is_rehearsal(shown),
        question=question,
        apart=apart,
        steps=next_steps(site.program, sweep, study, shown, short, conditions, question or apart),
        found=is_found(shown, question or apart),
        prompted=any(driver.facts and driver.facts["asked"] for driver in shown),
        asking=asking,
        linked=True,
        titles=dict(bar.prompts),
        pair=names if len(names) == 2 else (),
        conditions=conditions,
    )
