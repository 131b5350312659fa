"""The study on one screen: its question, a row and a sentence on each driver, what to type next."""

from __future__ import annotations

from collections.abc import Mapping

from merge_runner_analysis.web.comparison import set_apart
from merge_runner_analysis.web.computed import computed_table
from merge_runner_analysis.web.computing import Job
from merge_runner_analysis.web.effect_rows import MIDDLE
from merge_runner_analysis.web.judged import by_condition, by_kind, humans_of, judged, noted
from merge_runner_analysis.web.people import HEADINGS, likeness_of, people_of
from merge_runner_analysis.web.question import Answer, answer_of
from merge_runner_analysis.web.runs import standing_of
from merge_runner_analysis.web.scope import Bar, descriptions_of, scope_of, unmarked
from merge_runner_analysis.web.site import Site, news_of
from merge_runner_analysis.wording import LANGUAGE_MODEL, headline

TABLES = ("effects", "levels")  # of what a study's factors change


def _question(site: Site, bar: Bar) -> tuple[list[Job], list[Job], Answer | None]:
    """The computations of what the study's factors change, if any, those awaited, the answer.

    A computation may end meanwhile: whether it is awaited is what its table was.
    """
    if len(bar.prompts) < 2 and not site.catalogue.factors():
        return [], [], None
    part = bar.scope.sweep, bar.scope.condition
    found = [computed_table(site, name, *part) for name in TABLES]
    jobs, tables = zip(*found, strict=True)
    return [*jobs], [job for job, table in found if table is None], answer_of(*tables)


def home_page(site: Site, asked: Mapping[str, str]) -> str:
    """The study; raises NotThere, and NothingNew where nothing is new since it was ``seen``."""
    standing = standing_of(site.catalogue)
    bar = scope_of(site, asked)
    scope = bar.scope
    drivers, values = judged(site, bar, asked)
    jobs, asking, question = _question(site, bar)
    shown = [
        one
        for one in drivers
        if one.prompt == scope.prompt and (not scope.drivers or unmarked(one.name) in scope.drivers)
    ]
    models = {
        one.name: {name: cell.values for name, cell in one.cells.items()}
        for one in shown
        if one.kind == LANGUAGE_MODEL and one.cells
    }
    kinds = by_kind(shown)
    apart = None
    if not jobs and len(models) == len(shown) == 2:  # two language models are the question
        job, is_awaited, apart = set_apart(site, shown[0], shown[1], scope)
        jobs, asking = [job], [job] * is_awaited
    older = [job.older for job in (values["computed"], *jobs)]
    now = standing, site.catalogue.state, site.catalogue.held, older
    seen = news_of(now, asked.get("seen", ""))
    conditions = by_condition(site, scope, shown)
    return site.render(
        "home.html",
        here="index",
        **values,
        likeness=[(one, likeness_of(one)) for of_kind in kinds.values() for one in of_kind],
        likeness_headings=HEADINGS,
        # People's gap is that of the situations in which the first driver finished.
        people=people_of(conditions, humans_of(values["table"], next(iter(shown), None))),
        part=scope.part,
        standing=standing,
        seen=seen,
        descriptions=descriptions_of(site),
        kinds=kinds,
        headline=headline(models, [one.kind for one in shown]),
        question=question,
        apart=apart,
        asking=asking,
        middle=MIDDLE,
        linked=True,
        titles=dict(bar.prompts),
        pair=[one.name for one in shown][:2],
        notes=noted(shown),
        conditions=conditions,
    )
