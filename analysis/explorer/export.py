"""A study as a folder of pages, or trials as one page, that open without a server."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from fnmatch import fnmatchcase
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any

from analysis.explorer.assets import REPLAY, inlined
from analysis.explorer.catalogue import Filter
from analysis.explorer.display_text import visible
from analysis.explorer.exported_list import listing_page
from analysis.explorer.leaks import Leaks
from analysis.explorer.packing import packed
from analysis.explorer.packing_processes import AT_ONCE, Block, packing
from analysis.explorer.pages.ablations import ablations_page
from analysis.explorer.pages.comparing import At, offered
from analysis.explorer.pages.computed import computed
from analysis.explorer.pages.conditions import condition_page, views_of
from analysis.explorer.pages.home import groupings, home_page
from analysis.explorer.pages.notes import notes_csv, notes_page
from analysis.explorer.pages.sweep import sweep_page, sweeps_page
from analysis.explorer.pages.tables import (
    FIGURES,
    FILES,
    figure_requests,
    figures,
    table_files,
    table_page,
    tables_page,
)
from analysis.explorer.pages.trial import embedded
from analysis.explorer.pages.words import exported_words
from analysis.explorer.reading import Row
from analysis.explorer.site import Site
from analysis.explorer.sweeps import list_sweeps
from analysis.explorer.urls import EXPORTED, HOME, StaticLinks, bundle_name
from analysis.tables import TABLES
from merge_runner.errors import UsageError

# So many trials of a page are listed; of more one is searched.
FEW = 12
# A link that only a server can follow.
_LINK_TO_NOWHERE = re.compile(r'<a href="">(.*?)</a>', re.DOTALL)
# The names of an export's pages: those of an earlier one are deleted, and nothing else.
_OURS = re.compile(
    rf"(?:{'|'.join(EXPORTED)}|(?:condition|index|sweep|table|trials)-.*)\.html"
    rf"|table-.*\.(?:{'|'.join(FILES)})|(?:{'|'.join(FIGURES)})\.svg"
    r"|notes\.csv"
)
# Packed data are searched before they are packed: afterwards their letters may spell a path.
_PACKED = re.compile(
    r'<script type="application/json" id="(?:bundle|packed-list|said)">.*?</script>', re.DOTALL
)
# What the numbers of all tables are made of: it takes longest, and goes on while trials are packed.
CELLS = ("cells", *TABLES)


Watch = Callable[[Sequence[Any], str], Iterable[Any]]
"""Shows how far a loop has come: takes its items and a name, and returns the items."""
File = tuple[str, str]
"""A file of an export: its name and its text."""


def unwatched(things: Sequence[Any], _: str) -> Iterable[Any]:
    """Show nothing."""
    return things


def export_folder(
    db: Path, folder: Path, wanted: Sequence[str], watch: Watch = unwatched
) -> Iterator[Path]:
    """Write the list of trials and a page for each condition; yields the paths.

    ``wanted`` are names of trials, in which * stands for anything; none wants all, and the pages of
    the whole study. An earlier export in the folder goes. Nothing is written where a page holds a
    key or a path of this machine. Raises UsageError.
    """
    links = StaticLinks(["trials", "words", "notes"]) if wanted else StaticLinks()
    with (
        _opened(db, wanted, links) as (site, rows),
        _staged(folder, Leaks(db), _OURS) as (keep, paths),
    ):
        if not wanted:
            for request in (CELLS, *figure_requests()):
                site.computing.ask(request, site.catalogue.state())
        by_condition = sorted(rows, key=lambda row: row["condition"])  # stable: by name within it
        parts = {name: list(own) for name, own in groupby(by_condition, _condition)}
        with _bundles(site, parts, watch) as bundles:
            # While others pack, and compute.
            keep(_noted(site, rows))
            if not wanted:
                keep(_linked(_listed_pages(site, watch)))
            keep((bundle_name(name), text) for name, text in bundles)
        behind = {"cells": {}, "sets": []} if wanted else _behind(site, rows)
        links.behind = behind["cells"]
        listing = listing_page(site, rows, behind)
        keep([(site.at.to("trials"), listing)])
        if wanted:
            keep([(f"{HOME}.html", listing)])
        else:
            keep(_linked(_computed_pages(site, links, watch)))
    yield from paths


def export_page(
    db: Path, file: Path, wanted: Sequence[str], watch: Watch = unwatched
) -> Iterator[Path]:
    """Write one page with the wanted trials; yields its path. Raises UsageError."""
    links = StaticLinks(alone=file.name)
    with (
        _opened(db, wanted, links) as (site, rows),
        _staged(file.parent, Leaks(db)) as (keep, paths),
        _bundles(site, {"": rows}, watch) as bundles,
    ):
        keep((file.name, text) for _, text in bundles)
    yield from paths


def _condition(row: Row) -> str:
    condition: str = row["condition"]
    return condition


def page_of_trials(site: Site, rows: Sequence[Row], name: str) -> str:
    """One page with trials of a served site, for a file of that name; raises UsageError."""
    alone = Site(site.db, StaticLinks(alone=name), shared={"inline": inlined})
    alone.catalogue = site.catalogue
    with _bundles(alone, {"": rows}, unwatched) as bundles:
        ((_, page),) = bundles
    Leaks(site.db).refuse(name, [_PACKED.sub("", page)])
    return page


def _noted(site: Site, rows: Sequence[Row]) -> Iterator[File]:
    """What drivers said in these trials, and what readers noted of them."""
    pack = partial(packed, leaks=Leaks(site.db), where="words.html")
    yield site.at.to("words"), exported_words(site, rows, pack)
    trials = {(row["trial_id"], row["spec_hash"]) for row in rows}
    yield site.at.to("notes"), notes_page(site, trials)
    yield "notes.csv", notes_csv(site, trials)


def _linked(files: Iterable[File]) -> Iterator[File]:
    """Pages on which a link that only a server could follow is none."""
    for name, text in files:
        yield name, _LINK_TO_NOWHERE.sub(r"\1", text) if name.endswith(".html") else text


def _listed_pages(site: Site, watch: Watch) -> Iterator[File]:
    """The pages of the study for which nothing has to be computed."""
    at = site.at
    for entry in list_sweeps(site.catalogue):
        yield at.sweep(entry.sweep_id), sweep_page(site, entry.sweep_id)
    yield at.to("sweeps"), sweeps_page(site)
    yield at.to("glossary"), site.render("glossary.html", here="glossary")
    names = site.catalogue.ask("SELECT DISTINCT condition FROM listed ORDER BY ALL")
    for name in watch([row["condition"] for row in names], "conditions"):
        for by in views_of(site, name).values():
            yield at.condition(name, by=by), condition_page(site, name, {"by": by})


def _computed_pages(site: Site, links: StaticLinks, watch: Watch) -> Iterator[File]:
    """The study at a glance, and what else is computed of it."""
    at = site.at
    for by in groupings(site):
        yield at.to(HOME, by=by), home_page(site, {"by": by})
    for name in watch(list(TABLES), "tables"):
        yield at.table(name), table_page(site, name, {})
        yield from table_files(site, name)
    yield at.to("ablations"), ablations_page(site, {})
    links.figures = figures(site)
    for name, svg in links.figures.items():
        yield at.figure(name), svg
    yield at.to("tables"), tables_page(site)


@contextmanager
def _bundles(
    site: Site, parts: Mapping[str, Sequence[Row]], watch: Watch
) -> Iterator[Iterator[File]]:
    """Of each condition a page with all its trials, of which it shows one."""
    blocks = [
        (name, rows[first : first + AT_ONCE])
        for name, rows in parts.items()
        for first in range(0, len(rows), AT_ONCE)
    ]
    with packing(site, [rows for _, rows in blocks]) as packed_blocks:
        # Each step is a block that has been packed.
        done = ((name, next(packed_blocks)) for name, _ in watch(blocks, "packing trials"))
        yield (
            (name, _bundle_page(site, name, parts[name], [block for _, block in found]))
            for name, found in groupby(done, lambda one: one[0])
        )


def _bundle_page(site: Site, condition: str, rows: Sequence[Row], blocks: Sequence[Block]) -> str:
    name = f"Trials of {condition}" if condition else "Trials"
    bundle = {
        "listed": packed([_listed(row) for row in rows], Leaks(site.db), name),
        "offers": _offers(site, rows),
        "blocks": [block["shared"] for block in blocks],
        "trials": [
            [number, text] for number, block in enumerate(blocks) for text in block["trials"]
        ],
    }
    return site.render(
        "bundle.html",
        here="trials",
        name=name,
        rows=rows,
        few=FEW,
        bundle=embedded(bundle),
        scripts_within=("unpacked.js", *REPLAY, "value_tables.js", "bundle.js"),
    )


def _listed(row: Row) -> dict[str, str]:
    """What a page of trials has to know of each, and the ``words`` by which it is found."""
    words = (row[name] for name in ("trial_id", "model", "variant", "condition", "outcome"))
    return {
        "trial": row["trial_id"],
        "spec": row["spec_hash"],
        "name": visible(row["trial_id"]),
        "outcome": row["outcome"],
        "words": " ".join(filter(None, words)).lower(),
    }


def _offers(site: Site, rows: Sequence[Row]) -> list[dict[str, int]]:
    """What is offered beside each trial of a page, of what it holds: by kind, its place there."""
    conditions: dict[str, list[At]] = {}
    for row in rows:
        conditions.setdefault(row["condition"], []).append((row["trial_id"], row["spec_hash"]))
    found: dict[At, dict[str, At]] = {}
    for condition, mine in conditions.items():
        found |= offered(site, condition, mine)
    places = {(row["trial_id"], row["spec_hash"]): place for place, row in enumerate(rows)}
    return [
        {kind: places[other] for kind, other in found.get(at, {}).items() if other in places}
        for at in ((row["trial_id"], row["spec_hash"]) for row in rows)
    ]


def _behind(site: Site, rows: list[Row]) -> dict[str, Any]:
    """The trials behind the numbers of all tables: each number's set, and places in the list."""
    found = computed(site, CELLS, {})
    if found.result is None:
        return {"cells": {}, "sets": []}  # the pages of the tables say why there are none
    places = {(row["trial_id"], row["spec_hash"]): i for i, row in enumerate(rows)}
    # A sweep may have stored more since the list was made.
    sets = [
        [places[trial, spec] for trial, spec in one if (trial, spec) in places]
        for one in found.result.content["sets"]
    ]
    return {"cells": found.result.content["cells"], "sets": sets}


@contextmanager
def _opened(
    db: Path, wanted: Sequence[str], links: StaticLinks
) -> Iterator[tuple[Site, list[Row]]]:
    """A site of files and the wanted trials, by name; raises UsageError where there is none."""
    site = Site(db, links, shared={"inline": inlined})
    site.refresh()
    every = site.catalogue.every(Filter())
    rows = [
        row
        for row in every
        if not wanted or any(fnmatchcase(row["trial_id"], pattern) for pattern in wanted)
    ]
    if not rows:
        names = ", ".join(wanted) or "any name"
        raise UsageError(f"{db} holds no trial called {names}; `merge-runner view` lists them")
    try:
        yield site, rows
    finally:
        site.close()


@contextmanager
def _staged(
    folder: Path, leaks: Leaks, replaced: re.Pattern[str] | None = None
) -> Iterator[tuple[Callable[[Iterable[File]], None], list[Path]]]:
    """What keeps files beside their folder, and their paths there; in the end they are moved.

    Of others in the folder, those whose names are ``replaced`` go. Raises UsageError where a file
    holds a key or a path of this machine, or cannot be written: then the folder stays as it was.
    """
    paths: list[Path] = []
    there = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.is_dir())
    try:
        with tempfile.TemporaryDirectory(prefix=".merge-runner-", dir=there) as stage:

            def keep(files: Iterable[File]) -> None:
                for name, text in files:
                    leaks.refuse(name, [_PACKED.sub("", text)])
                    (Path(stage) / name).write_text(text, encoding="utf-8")
                    paths.append(folder / name)

            yield keep, paths
            folder.mkdir(parents=True, exist_ok=True)
            for path in folder.iterdir():
                if replaced and replaced.fullmatch(path.name):
                    path.unlink()
            for path in paths:
                (Path(stage) / path.name).replace(path)
    except OSError as exc:
        raise UsageError(f"{folder} cannot be written: {exc}") from exc
