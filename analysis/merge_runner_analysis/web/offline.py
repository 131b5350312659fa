"""One page with trials that opens without a server: all that it needs stands in it."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path
from urllib.parse import parse_qsl, unquote, urlsplit

from markupsafe import Markup

from merge_runner_analysis.web.leaks import refuse_leaks
from merge_runner_analysis.web.pages.trial import trial_pages
from merge_runner_analysis.web.reading import Row
from merge_runner_analysis.web.rendering import STYLE, inlined_texts, policy_of
from merge_runner_analysis.web.site import REPLAY, Site
from merge_runner_analysis.web.urls import Links, query_of

SCRIPTS = ["lists.js", "keys.js", *REPLAY, "single.js"]


def linked(page: str) -> str:
    """Return a page in which a link that leads nowhere is a text."""
    return page.replace(' href=""', "")


def site_of_a_page(db: Path, trials: Collection[tuple[str, str]]) -> Site:
    """Return a site for one page, which links to those trials alone that it holds: name, spec."""

    def leads(address: str) -> str:
        parts = urlsplit(address)
        trial, asked = unquote(parts.path.removeprefix("/trials/")), dict(parse_qsl(parts.query))
        is_there = (trial, asked.get("spec", "")) in trials
        return query_of({"trial": trial, **asked}) if is_there else ""

    inlined = inlined_texts([STYLE, *SCRIPTS])
    return Site(db, Links(leads), policy=policy_of(inlined), inlined=inlined)


def page_of_trials(site: Site, rows: Sequence[Row]) -> str:
    """Return one page with trials; raises UsageError."""
    template = "trial.html" if len(rows) == 1 else "_trial.html"
    pages = list(trial_pages(site, rows, template))
    page = pages[0]
    if len(rows) > 1:
        # Rendered by templates of ours.
        trials = zip(rows, map(Markup, pages), strict=True)
        page = site.render(
            "several.html", view="trials", trials=list(trials), scripts=[*REPLAY, "single.js"]
        )
    refuse_leaks(site.db, "the page", page)
    return linked(page)
