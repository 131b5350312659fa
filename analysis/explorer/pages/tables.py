"""The tables of the analysis, as in the report; every number leads to the trials behind it."""

from __future__ import annotations

from collections.abc import Mapping

from analysis.explorer.pages.computed import computed
from analysis.explorer.site import NotThere, Site
from analysis.tables import TABLES
from analysis.tables.formats import table_view
from analysis.tables.model import from_text

# What each shows, for the list: their own titles are known only when they are made.
ABOUT = {
    "who-first": "Table III: who merges first, by headway and relative velocity",
    "gap": "Table IV: the gap, by headway and relative velocity",
    "indicators": "Table V: the indicators I1 to I5, the score and the measures",
    "ablation-qualitative": "Table VI: the indicators of every driver and variant",
    "ablation-quantitative": "Table VII: the measures of every driver and variant",
    "contrasts": "every variant against its baseline, every baseline against the humans",
    "factors": "each level of a study's factors, models and prompts, pooled over the others",
    "differences": "who merges first and the gap, against the humans in one model of both",
    "who-first-variants": "Table III for every prompt variant, and what differs from the baseline",
    "gap-variants": "Table IV for every prompt variant, and what differs from the baseline",
    "velocity-profiles": "the numbers behind I5, and how much plans are revised",
    "conflict-resolution": "when the conflict is resolved, by condition",
    "criticality": "times to merge and to collision, the hardest acceleration",
    "speed-windows": "RMSE and joint rate over other windows",
    "gap-definitions": "the gap and its regression by three definitions of the gap",
    "robustness": "outcomes under other collision rules",
    "attempts": "what became of the calls",
    "fallbacks": "the measures with and without trials that had a fallback",
    "first-action": "the first action of every driver, by own relative velocity, beside humans",
    "first-action-faults": "what in the first actions differs from the humans",
    "words": "what follows a tactical word, and what the first word follows",
    "first-look-surface": "first situations that were only asked, and what headway is worth",
}


def tables_page(site: Site) -> str:
    """The list of all tables."""
    return site.render("tables.html", here="tables", about=ABOUT)


def table_page(site: Site, name: str, asked: Mapping[str, str]) -> str:
    """One table; raises NotThere."""
    if name not in TABLES:
        raise NotThere(f"there is no table {name}; there are {', '.join(TABLES)}")
    found = computed(site, ("tables", name), asked)
    shown = None
    if found.result is not None:
        shown = table_view(
            from_text(found.result.content["tables"][0]),
            lambda table, row, column: site.at.cell(table.name, row.id, column.name),
        )
    names = list(TABLES)
    at = names.index(name)
    return site.render(
        "table.html",
        here="tables",
        name=name,
        about=ABOUT[name],
        computed=found,
        table=shown,
        before=names[at - 1] if at else None,
        after=names[at + 1] if at + 1 < len(names) else None,
    )
