"""The list of trials of an export, of which a script shows a page at a time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from analysis.explorer.catalogue import FACETS, FACTOR, PAGE, SEVERAL
from analysis.explorer.leaks import Leaks
from analysis.explorer.packing import packed
from analysis.explorer.pages.trial import embedded
from analysis.explorer.pictures import sparkline, speed_range
from analysis.explorer.reading import Row
from analysis.explorer.site import Site

# The list unpacks so many rows for each page that has one of them.
PACKED_ROWS = 500

Levels = dict[str, list[list[str]]]
"""By the name of a facet the values of every trial, in the order of the list."""


def listing_page(site: Site, rows: list[Row], behind: Mapping[str, Any]) -> str:
    """The list: its first page, and packed what a script needs for the others.

    ``behind`` are the trials behind the numbers of tables.
    """
    levels = _levels(site, rows)
    shown = {
        "sorts": {},
        "sort": "",
        "kept": {},
        "sparkline": sparkline,
        "scale": speed_range(rows),
        "leveled": any(row["levels"] for row in rows),
    }
    every = [site.render("_row.html", row=row, **shown) for row in rows]
    index = {
        "names": [row["trial_id"].lower() for row in rows],
        "levels": {name: _numbered(values) for name, values in levels.items()},
        **behind,
    }
    pack = partial(packed, leaks=Leaks(site.db), where=site.at.to("trials"))
    blocks = [pack(every[i : i + PACKED_ROWS]) for i in range(0, len(every), PACKED_ROWS)]
    return site.render(
        "listing.html",
        here="trials",
        facets={name: _counted(values) for name, values in levels.items()},
        rows=rows[:PAGE],
        trials=len(rows),
        listed=embedded({"index": pack(index), "rows": blocks, "block": PACKED_ROWS, "page": PAGE}),
        **shown,
    )


def _levels(site: Site, rows: Sequence[Row]) -> Levels:
    found: Levels = {
        name: [[row[name]] if row[name] else [] for row in rows]
        for name in FACETS
        if name not in SEVERAL
    }
    for name, table in SEVERAL.items():
        of_number: dict[int, list[str]] = {}
        for pair in site.catalogue.ask(f"SELECT number, {name} AS value FROM {table} ORDER BY ALL"):  # noqa: S608 # constants
            of_number.setdefault(pair["number"], []).append(pair["value"])
        found[name] = [of_number.get(row["number"], []) for row in rows]
    for factor in site.catalogue.factors():
        begin = f"{factor}="
        found[f"{FACTOR}{factor}"] = [
            [level.removeprefix(begin) for level in row["levels"] or [] if level.startswith(begin)]
            for row in rows
        ]
    return {name: found.pop(name) for name in FACETS} | found


def _counted(values: Sequence[Sequence[str]]) -> list[tuple[str, int]]:
    return sorted(Counter(value for own in values for value in own).items())


def _numbered(values: Sequence[Sequence[str]]) -> dict[str, Any]:
    """Each value once, and their numbers for every trial: one as itself, more as a list."""
    numbers = {value: i for i, (value, _) in enumerate(_counted(values))}
    of = [[numbers[value] for value in own] for own in values]
    return {"values": list(numbers), "of": [own[0] if len(own) == 1 else own for own in of]}
