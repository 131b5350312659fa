"""A study as a folder of pages, or trials as one page, that open without a server."""

from __future__ import annotations

import re
import shutil
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
from analysis.explorer.packing_processes import AT_ONCE, Block, packed_blocks
from analysis.explorer.pages.ablations import ablations_page
from analysis.explorer.pages.comparing import At, offered
from analysis.explorer.pages.computed import computed
from analysis.explorer.pages.conditions import condition_page, conditions_page, views_of
from analysis.explorer.pages.home import groupings, home_page
from analysis.explorer.pages.humans import humans_page
from analysis.explorer.pages.notes import notes_page
from analysis.explorer.pages.sweep import sweep_page, sweeps_page
from analysis.explorer.pages.tables import FILES, table_files, table_page, tables_page
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
    rf"(?:{'|'.join(EXPORTED)}|(?:condition|index|sweep|table|trials)-.*)\.html|table-.*\.(?:{'|'.join(FILES)})"
)
# Packed data are searched before they are packed: afterwards their letters may spell a path.
_PACKED = re.compile(
    r'<script type="application/json" id="(?:bundle|packed-list|said)">.*?</script>', re.DOTALL
)
# What the numbers of all tables are made of: it takes longest, and goes on while trials are packed.
CELLS = ("cells", *TABLES)


Watch = Callable[[Sequence[Any], str], Iterable[Any]]
"""Shows how far a loop has come: takes its items and a name, and returns the items."""


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
    with _opened(db, wanted, links) as (site, rows), _Staged(folder, Leaks(db), _OURS) as staged:
        if not wanted:
            site.computing.ask(CELLS, site.catalogue.state())
        by_condition = sorted(rows, key=lambda row: row["condition"])  # stable: by name within it
        parts = {name: list(own) for name, own in groupby(by_condition, _condition)}
        for condition, text in zip(parts, _bundles(site, parts, watch), strict=True):
            staged.write(bundle_name(condition), text)
        behind = {"cells": {}, "sets": []} if wanted else _behind(site, rows)
        links.behind = behind["cells"]
        listing = listing_page(site, rows, behind)
        pages = {
            site.at.to("words"): exported_words(
                site, rows, partial(packed, leaks=Leaks(db), where="words.html")
            ),
            site.at.to("notes"): notes_page(
                site, {(row["trial_id"], row["spec_hash"]) for row in rows}
            ),
        }
        if not wanted:
            pages |= {name: _LINK_TO_NOWHERE.sub(r"\1", text) for name, text in _study(site, watch)}
        pages[site.at.to("trials")] = listing
        pages.setdefault("index.html", listing)  # of some trials
        for name, text in pages.items():
            staged.write(name, text)
        staged.finish()
    yield from staged.paths


def export_page(
    db: Path, file: Path, wanted: Sequence[str], watch: Watch = unwatched
) -> Iterator[Path]:
    """Write one page with the wanted trials; yields its path. Raises UsageError."""
    links = StaticLinks(alone=file.name)
    with _opened(db, wanted, links) as (site, rows), _Staged(file.parent, Leaks(db)) as staged:
        for text in _bundles(site, {"": rows}, watch):
            staged.write(file.name, text)
        staged.finish()
    yield from staged.paths


def _condition(row: Row) -> str:
    condition: str = row["condition"]
    return condition


def page_of_trials(site: Site, rows: Sequence[Row], name: str) -> str:
    """One page with trials of a served site, for a file of that name; raises UsageError."""
    alone = Site(site.db, StaticLinks(alone=name), shared={"inline": inlined})
    alone.catalogue = site.catalogue
    (page,) = _bundles(alone, {"": rows}, unwatched)
    Leaks(site.db).refuse(name, [_PACKED.sub("", page)])
    return page


def _study(site: Site, watch: Watch) -> Iterator[tuple[str, str]]:
    """The pages of the whole study: at a glance, its sweeps, and what is computed of it."""
    at = site.at
    for by in groupings(site):
        yield at.to(HOME, by=by), home_page(site, {"by": by})
    for entry in list_sweeps(site.catalogue):
        yield at.sweep(entry.sweep_id), sweep_page(site, entry.sweep_id)
    yield at.to("sweeps"), sweeps_page(site)
    yield at.to("conditions"), conditions_page(site, {})
    for row in site.catalogue.ask("SELECT DISTINCT condition FROM listed ORDER BY ALL"):
        name = row["condition"]
        for by in views_of(site, name).values():
            yield at.condition(name, by=by), condition_page(site, name, {"by": by})
    yield at.to("glossary"), site.render("glossary.html", here="glossary")
    yield at.to("tables"), tables_page(site)
    for name in watch(list(TABLES), "tables"):
        yield at.table(name), table_page(site, name, {})
        yield from table_files(site, name)
    yield at.to("ablations"), ablations_page(site, {})
    yield at.to("humans"), humans_page(site, {})


def _bundles(site: Site, parts: Mapping[str, Sequence[Row]], watch: Watch) -> Iterator[str]:
    """Of each condition a page with all its trials, of which it shows one."""
    blocks = [
        (name, rows[first : first + AT_ONCE])
        for name, rows in parts.items()
        for first in range(0, len(rows), AT_ONCE)
    ]
    packing = packed_blocks(site, [rows for _, rows in blocks])
    # Each step is a block that has been packed.
    done = ((name, next(packing)) for name, _ in watch(blocks, "packing trials"))
    for name, found in groupby(done, lambda one: one[0]):
        yield _bundle_page(site, name, parts[name], [block for _, block in found])


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


class _Staged:
    """Pages that are written beside their folder, and moved there when all of them are good.

    Raises UsageError where a page holds a key or a path of this machine, or cannot be written.
    """

    def __init__(self, folder: Path, leaks: Leaks, replaced: re.Pattern[str] | None = None) -> None:
        """Of others in the folder, those whose names are ``replaced`` go."""
        self._folder = folder
        self._leaks = leaks
        self._replaced = replaced
        self._names: list[str] = []

    def __enter__(self) -> _Staged:
        there = next(
            path
            for path in (self._folder.absolute(), *self._folder.absolute().parents)
            if path.is_dir()
        )
        with self._writing():
            self._stage = Path(tempfile.mkdtemp(prefix=".merge-runner-", dir=there))
        return self

    def __exit__(self, *_: object) -> None:
        shutil.rmtree(self._stage, ignore_errors=True)

    def write(self, name: str, text: str) -> None:
        """Keep a page for the folder."""
        self._leaks.refuse(name, [_PACKED.sub("", text)])
        with self._writing():
            (self._stage / name).write_text(text, encoding="utf-8")
        self._names.append(name)

    def finish(self) -> None:
        """Put the pages where they belong."""
        with self._writing():
            self._folder.mkdir(parents=True, exist_ok=True)
            for path in self._folder.iterdir():
                if self._replaced and self._replaced.fullmatch(path.name):
                    path.unlink()
            for name in self._names:
                (self._stage / name).replace(self._folder / name)

    @property
    def paths(self) -> list[Path]:
        """The pages in their folder."""
        return [self._folder / name for name in self._names]

    @contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except OSError as exc:
            raise UsageError(f"{self._folder} cannot be written: {exc}") from exc
