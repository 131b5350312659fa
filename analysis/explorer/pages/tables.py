"""The tables of the analysis, as in the report; every number leads to the trials behind it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from analysis.explorer.links import Links
from analysis.explorer.pages.computed import computed
from analysis.explorer.site import NotThere, Site
from analysis.tables import TABLES
from analysis.tables.formats import notes_of, shown_columns, shown_value
from analysis.tables.model import Table, from_text

# What stands in each, for the list of them: their titles are known once they are made.
ABOUT = {
    "who-first": "Table III: who merges first, by headway and relative velocity",
    "gap": "Table IV: the gap, by headway and relative velocity",
    "indicators": "Table V: the indicators I1 to I5, the score and the measures",
    "ablation-qualitative": "Table VI: the indicators of every driver and variant",
    "ablation-quantitative": "Table VII: collisions, gap, RMSE and joint rate of these",
    "contrasts": "every variant against its baseline, every baseline against the humans",
    "velocity-profiles": "the numbers behind I5, and how much plans are revised",
    "conflict-resolution": "when the conflict is resolved, by condition",
    "criticality": "times to merge and to collision, the hardest acceleration",
    "speed-windows": "RMSE and joint rate over other windows",
    "robustness": "outcomes under other collision rules",
    "attempts": "what became of the calls",
    "fallbacks": "the measures with and without trials that had a fallback",
}


def tables_page(site: Site) -> str:
    """The list of all tables."""
    return site.render("tables.html", here="tables", about=ABOUT)


def table_page(site: Site, name: str, asked: Mapping[str, str], *, patient: bool = False) -> str:
    """One table; raises NotThere."""
    if name not in TABLES:
        raise NotThere(f"there is no table {name}; there are {', '.join(TABLES)}")
    found = computed(site, ("tables", name), asked, patient=patient)
    shown = None
    if found.result is not None:
        shown = table_view(from_text(found.result.content["tables"][0]), site.at)
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


def table_view(table: Table, at: Links) -> dict[str, Any]:
    """A table as its template needs it: headings, cells with addresses, notes.

    The texts that lead a row are its headers.
    """
    columns = shown_columns(table)
    leading = next((i for i, c in enumerate(columns) if c.kind != "text"), len(columns))
    return {
        "name": table.name,
        "heading": table.heading,
        "columns": [
            {"heading": c.heading, "meaning": c.meaning, "text": c.kind == "text"} for c in columns
        ],
        "rows": [
            {
                "id": row.id,
                "cells": [
                    {
                        "text": shown_value(column, row.values.get(column.name)),
                        "left": column.kind == "text",
                        "header": i < leading,
                        "link": None
                        if column.kind == "text" or row.values.get(column.name) is None
                        else at.cell(table.name, row.id, column.name),
                        "label": f"{column.heading} of {row.id}",
                    }
                    for i, column in enumerate(columns)
                ],
            }
            for row in table.rows
        ],
        "notes": notes_of(table),
    }
