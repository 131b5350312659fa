"""The study on one screen: its question, a row and a sentence on each driver, what to type next."""

from __future__ import annotations

from collections.abc import Mapping

from merge_runner_analysis.web.comparison import compared
from merge_runner_analysis.web.computing import Job
from merge_runner_analysis.web.effect_rows import MIDDLE
from merge_runner_analysis.web.judged import Driver, by_condition, by_kind, humans_of, judged, noted
from merge_runner_analysis.web.names import PLAYED, names_mean, short_names
from merge_runner_analysis.web.people import HEADINGS, likeness_of, people_of, tally
from merge_runner_analysis.web.question import Answer, answer_of
from merge_runner_analysis.web.runs import standing_of
from merge_runner_analysis.web.scope import Bar, descriptions_of, scope_of, unmarked
from merge_runner_analysis.web.site import Site, news_of
from merge_runner_analysis.wording import LANGUAGE_MODEL, MEASURES, MOCK, headline

TABLES = ("effects", "levels")  # of what a study's factors change


def _question(site: Site, bar: Bar) -> tuple[list[Job], list[Job], Answer | None]:
    """Return the jobs of the tables on factors, if any, those to wait for, and the answer.

    A job without a table is waited for, even if it ends meanwhile.
    """
    if len(bar.prompts) < 2 and not site.catalogue.factors():
        return [], [], None
    part = bar.scope.sweep, bar.scope.condition
    computed = [site.table(name, *part) for name in TABLES]
    jobs, tables = zip(*computed, strict=True)
    return [*jobs], [job for job, table in computed if table is None], answer_of(*tables)


def _is_tested(driver: Driver, measure: str) -> bool:
    return measure in driver.cells and driver.cells[measure].values.get("p_holm") is not None


def home_page(site: Site, asked: Mapping[str, str]) -> str:
    """Return the study's page; raises NotThere, and NothingNew where it is as ``seen``."""
    standing = standing_of(site.catalogue)
    bar = scope_of(site, asked)
    scope = bar.scope
    drivers, values = judged(site, bar, asked)
    jobs, asking, question = _question(site, bar)
    shown = [
        driver
        for driver in drivers
        if driver.prompt == scope.prompt
        and (not scope.drivers or unmarked(driver.name) in scope.drivers)
    ]
    short = short_names([driver.name for driver in shown])
    models = {
        short[driver.name]: {name: cell.values for name, cell in driver.cells.items()}
        for driver in shown
        if driver.kind == LANGUAGE_MODEL and driver.cells
    }
    kinds = by_kind(shown)
    apart = None
    kinds_shown = {driver.kind for driver in shown}
    # Two language models, or two mock models in a rehearsal, are the question.
    if not jobs and len(shown) == 2 and kinds_shown in ({LANGUAGE_MODEL}, {MOCK}):
        job, is_awaited, apart = compared(site, shown[0], shown[1], scope)
        jobs, asking = [job], [job] * is_awaited
    older = [job.older for job in (values["computed"], *jobs)]
    now = standing, site.catalogue.state, site.catalogue.copies.is_locked, older
    seen = news_of(now, asked.get("seen", ""))
    conditions = by_condition(site, scope, shown)
    return site.render(
        "home.html",
        view="index",
        **values,
        likeness=[
            (driver, likeness_of(driver)) for of_kind in kinds.values() for driver in of_kind
        ],
        likeness_headings=HEADINGS,
        more_compared=[
            measure.label
            for name, measure in MEASURES.items()
            if name not in HEADINGS and any(_is_tested(driver, name) for driver in shown)
        ],
        short=short,
        names_mean=names_mean(site.catalogue.ask(PLAYED), [driver.name for driver in shown]),
        # People's gap is that of the situations in which the first driver finished.
        people=people_of(conditions, humans_of(values["table"], next(iter(shown), None))),
        part=scope.part,
        standing=standing,
        seen=seen,
        descriptions=descriptions_of(site),
        kinds=kinds,
        headline=(tally(shown) * (not models and len(shown) > 1), *headline(models, kinds_shown)),
        is_rehearsal=kinds_shown == {MOCK},
        question=question,
        apart=apart,
        asking=asking,
        middle=MIDDLE,
        linked=True,
        titles=dict(bar.prompts),
        pair=[driver.name for driver in shown][:2],
        notes=noted(shown),
        conditions=conditions,
    )
