"""A study as a folder of pages, or trials as one page, that open without a server."""

from __future__ import annotations

import base64
import json
import os
import re
import tempfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path
from typing import Any

from analysis.explorer.assets import inlined
from analysis.explorer.catalogue import FACETS, FACTOR, SEVERAL, Filter
from analysis.explorer.details import read_decisions, read_trial
from analysis.explorer.pages.ablations import ablations_page
from analysis.explorer.pages.computed import computed
from analysis.explorer.pages.humans import humans_page
from analysis.explorer.pages.notes import notes_page
from analysis.explorer.pages.sweep import sweep_page, sweeps_page
from analysis.explorer.pages.tables import table_page, tables_page
from analysis.explorer.pages.trial import alternatives, embedded, rendered, shown
from analysis.explorer.pages.words import exported_words
from analysis.explorer.pictures import sparkline, speed_range
from analysis.explorer.reading import Row
from analysis.explorer.site import Site
from analysis.explorer.sweeps import list_sweeps
from analysis.explorer.urls import EXPORTED, StaticLinks, bundle_name
from analysis.tables import TABLES
from merge_runner.errors import UsageError
from merge_runner.paths import PROJECT

PLAIN = ("keys.js",)
LISTING = ("keys.js", "unpacked.js", "listing.js")
BUNDLE = ("keys.js", "unpacked.js", "vendor/uplot-1.6.32.min.js", "replay.js", "bundle.js")
# A link that only a server can follow.
_LINK_TO_NOWHERE = re.compile(r'<a href="">(.*?)</a>', re.DOTALL)
# What looks like a key, wherever it is from; the values of this machine's keys are looked for too.
_KEYS = re.compile(
    r"\b(?:sk-[A-Za-z0-9_-]{16,}|AIza[A-Za-z0-9_-]{30,}|Bearer [A-Za-z0-9._-]{16,}"
    r"|gh[opsu]_[A-Za-z0-9]{30,}|github_pat_[A-Za-z0-9_]{30,}|hf_[A-Za-z0-9]{30,}"
    r"|xox[abp]-[A-Za-z0-9-]{16,}|A[KS]IA[A-Z0-9]{16})"
)
_SECRET_NAMES = ("_KEY", "_TOKEN", "_SECRET", "_PASSWORD")
# A folder in anybody's home.
_HOMES = re.compile(r"(?<![\w.])(?:/home|/Users|[A-Z]:\\+Users)[/\\]+[\w.-]+[/\\]")
SHORTEST_SECRET = 8
# The names of an export's pages: those of an earlier one are deleted, and nothing else.
_OURS = re.compile(rf"(?:index|{'|'.join(EXPORTED)}|(?:sweep|table|trials)-.*)\.html")
# Packed data are searched before they are packed: afterwards their letters may spell a path.
_PACKED = re.compile(
    r'<script type="application/json" id="(?:bundle|cells|said)">.*?</script>', re.DOTALL
)


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
    with _opened(db, wanted, links) as (site, rows):
        behind = {"cells": {}, "sets": []} if wanted else _behind(site, rows)
        links.behind = behind["cells"]
        pages = {site.at.to("trials"): _listing(site, rows, behind)}
        pages[site.at.to("words")] = exported_words(site, rows, partial(_searched, site))
        shown = {(row["trial_id"], row["spec_hash"]) for row in rows}
        pages[site.at.to("notes")] = notes_page(site, shown)
        for condition in sorted({row["condition"] for row in rows}):
            mine = [row for row in rows if row["condition"] == condition]
            title = f"Trials of {condition}"
            pages[bundle_name(condition)] = bundle_page(site, mine, title, watch)
        if not wanted:
            pages |= {name: _LINK_TO_NOWHERE.sub(r"\1", text) for name, text in _study(site, watch)}
        pages["index.html"] = _index(pages)
        _refuse_secrets_of(site, pages)
    yield from _written(folder, pages, _OURS)


def export_page(
    db: Path, file: Path, wanted: Sequence[str], watch: Watch = unwatched
) -> Iterator[Path]:
    """Write one page with the wanted trials; yields its path. Raises UsageError."""
    with _opened(db, wanted, StaticLinks(alone=file.name)) as (site, rows):
        pages = {file.name: bundle_page(site, rows, "Trials", watch)}
        _refuse_secrets_of(site, pages)
    yield from _written(file.parent, pages)


def _study(site: Site, watch: Watch) -> Iterator[tuple[str, str]]:
    """The pages of the whole study: its sweeps, the newest first, and what is computed of it."""
    at = site.at
    for entry in list_sweeps(site.catalogue):
        yield at.sweep(entry.sweep_id), sweep_page(site, entry.sweep_id)
    yield at.to("sweeps"), sweeps_page(site)
    yield at.to("tables"), tables_page(site)
    for name in watch(list(TABLES), "Tables"):
        yield at.table(name), table_page(site, name, {})
    yield at.to("ablations"), ablations_page(site, {})
    yield at.to("humans"), humans_page(site, {})


def _index(pages: Mapping[str, str]) -> str:
    """The page to begin at: the newest sweep, or the trials."""
    return next((text for name, text in pages.items() if name.startswith("sweep-")), "") or next(
        iter(pages.values())
    )


def bundle_page(site: Site, rows: Sequence[Row], name: str, watch: Watch) -> str:
    """A page with several trials, of which it shows one."""
    trials = {site.at.data(row): _packed(_trial(site, row, rows)) for row in watch(rows, name)}
    return site.render(
        "bundle.html",
        here="trials",
        name=name,
        rows=rows,
        bundle=embedded(trials),
        inlined=inlined(BUNDLE),
    )


def _trial(site: Site, row: Row, beside: Sequence[Row]) -> dict[str, object]:
    """What the page needs of one trial."""
    trial = read_trial(site.db, row["trial_id"], row["spec_hash"])
    found = read_decisions(site.db, row["trial_id"], row["spec_hash"])
    values = shown(row, trial)
    there = {(other["trial_id"], other["spec_hash"]) for other in beside}
    others = {
        kind: [other for other in kin if (other["trial_id"], other["spec_hash"]) in there]
        for kind, kin in alternatives(site, row).items()
    }
    html = site.render("_trial.html", here="trials", **values, alternatives=others, panel="")
    panels = {
        f"{side}/{number}": rendered(site, row, trial, decision)
        for (side, number), decision in found.items()
    }
    _refuse_secrets(site, row["trial_id"], [html, *panels.values(), values["data"] or ""])
    data = json.loads(values["data"]) if values["data"] else None
    return {"html": _LINK_TO_NOWHERE.sub(r"\1", html), "panels": panels, "data": data}


def _behind(site: Site, rows: list[Row]) -> dict[str, Any]:
    """The trials behind the numbers of all tables: each number's set, and places in the list."""
    found = computed(site, ("cells", *TABLES), {})
    if found.result is None:
        return {"cells": {}, "sets": []}  # the pages of the tables say why there are none
    places = {(row["trial_id"], row["spec_hash"]): i for i, row in enumerate(rows)}
    # A sweep may have stored more since the list was made.
    sets = [
        [places[trial, spec] for trial, spec in one if (trial, spec) in places]
        for one in found.result.content["sets"]
    ]
    return {"cells": found.result.content["cells"], "sets": sets}


def _listing(site: Site, rows: list[Row], behind: Mapping[str, Any]) -> str:
    """The list of trials, whose script filters them by what stands beside each."""
    of_row = [{name: [row[name]] for name in FACETS if name in row} for row in rows]
    for name, table in SEVERAL.items():
        pairs = site.catalogue.ask(f"SELECT number, {name} AS value FROM {table} ORDER BY ALL")  # noqa: S608 # constants
        values: dict[int, list[str]] = {}
        for pair in pairs:
            values.setdefault(pair["number"], []).append(pair["value"])
        for row, of in zip(rows, of_row, strict=True):
            of[name] = values.get(row["number"], [])
    facets = {
        name: sorted(Counter(v for of in of_row for v in of[name] if v is not None).items())
        for name in FACETS
    }
    for row, of in zip(rows, of_row, strict=True):
        of["levels"] = row["levels"] or []
    counts = Counter(level for of in of_row for level in of["levels"])
    for (factor, level), count in sorted((tuple(n.split("=", 1)), k) for n, k in counts.items()):
        facets.setdefault(f"{FACTOR}{factor}", []).append((level, count))
    return site.render(
        "listing.html",
        here="trials",
        facets=facets,
        rows=[row | {"facets": of} for row, of in zip(rows, of_row, strict=True)],
        sorts={},
        sort="",
        kept={},
        sparkline=sparkline,
        scale=speed_range(rows),
        cells=embedded(_packed(behind)),
        inlined=inlined(LISTING),
    )


@contextmanager
def _opened(
    db: Path, wanted: Sequence[str], links: StaticLinks
) -> Iterator[tuple[Site, list[Row]]]:
    """A site of files and the wanted trials, by name; raises UsageError where there is none."""
    site = Site(db, links, shared={"inlined": inlined(PLAIN)})
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


def _packed(value: object) -> str:
    text = json.dumps(value, separators=(",", ":"), ensure_ascii=False)
    return base64.b64encode(zlib.compress(text.encode(errors="replace"), 9)).decode()


def _searched(site: Site, value: object) -> str:
    """Packed words, after a look for secrets."""
    _refuse_secrets(site, "words.html", [json.dumps(value, ensure_ascii=False)])
    return _packed(value)


def _written(
    folder: Path, pages: Mapping[str, str], replaced: re.Pattern[str] | None = None
) -> Iterator[Path]:
    """Write pages; of others in the folder, those whose names are ``replaced`` go."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for path in folder.iterdir():
            if replaced and replaced.fullmatch(path.name) and path.name not in pages:
                path.unlink()
        for name, text in pages.items():
            (folder / name).write_text(text, encoding="utf-8")
            yield folder / name
    except OSError as exc:
        raise UsageError(f"{folder} cannot be written: {exc}") from exc


def _refuse_secrets_of(site: Site, pages: Mapping[str, str]) -> None:
    for name, text in pages.items():
        _refuse_secrets(site, name, [_PACKED.sub("", text)])


def _refuse_secrets(site: Site, where: str, texts: Sequence[str]) -> None:
    """Raises UsageError where a text holds a key, or a path of this machine."""
    folders = (Path.home(), Path.cwd(), site.db.resolve().parent, PROJECT, tempfile.gettempdir())
    paths = {str(folder) for folder in folders} - {"/"}  # in a container the home may be "/"
    secrets = {
        value: name
        for name, value in os.environ.items()
        if name.endswith(_SECRET_NAMES) and len(value) >= SHORTEST_SECRET
    }
    for text in texts:
        for value, name in secrets.items():
            if value in text:
                raise UsageError(f"nothing was written: {where} holds the value of {name}")
        if found := _KEYS.search(text):
            raise UsageError(
                f"nothing was written: {where} holds what looks like a key: {found[0][:6]}..."
            )
        named = [path for path in sorted(paths) if f"{path}/" in text]
        named += [found[0] for found in _HOMES.finditer(text)]
        if named:
            raise UsageError(f"nothing was written: {where} names the path {named[0]}")
