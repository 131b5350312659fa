"""Pages that open without a server: a study's in a folder, crawled, and one page with trials."""

from __future__ import annotations

import asyncio
import os
import re
import shutil
import tempfile
from collections import deque
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager
from fnmatch import fnmatchcase
from functools import cache, lru_cache
from html import escape
from itertools import chain, count
from pathlib import Path, PurePosixPath
from urllib.parse import parse_qsl, unquote, urlsplit

import httpx
from markupsafe import Markup

from merge_runner.errors import UsageError
from merge_runner.paths import check_kind
from merge_runner_analysis.cache import stamp_of
from merge_runner_analysis.figures import FIGURES
from merge_runner_analysis.tables import TABLES
from merge_runner_analysis.web.app import LOOPBACK, explorer
from merge_runner_analysis.web.computing import processes
from merge_runner_analysis.web.leaks import check_leaks
from merge_runner_analysis.web.listing import FACTOR
from merge_runner_analysis.web.pages.trial import READ_AT_ONCE, trial_pages
from merge_runner_analysis.web.reading import Row
from merge_runner_analysis.web.rendering import STYLE, inlined_texts, policy_of
from merge_runner_analysis.web.site import REPLAY, SCOPE, Site
from merge_runner_analysis.web.trial_index import FACETS
from merge_runner_analysis.web.urls import Links, query_of

MOST = 1_000  # trials of drivers; of humans there are at most 990
# The pages of an export by the first part of their path, and what their addresses ask for. They
# are of all trials, so that a link within a scope leads to the page without it.
FOLLOWED: dict[str, Collection[str]] = {
    **dict.fromkeys(
        ("", "sweeps", "conditions", "tables", "figures", "prompts", "notes", "glossary", "cite"),
        (),
    ),
    "drivers": ("variant",),
    "trials": ("spec", "page", *FACETS),
    "discordant": ("model", "variant"),
}
OF_TRIALS = ("trials", "glossary")
MOST_HELPERS = 4
LAST = ("/tables", "/figures")  # figures take long to draw: meanwhile all other pages are saved
MOMENT = ("side", "decision")  # the script of a trial's page reads these
POLICY = (
    "default-src 'none'; script-src 'self' file:; style-src 'self' file:; "
    "img-src 'self' file: data:; base-uri 'none'; form-action 'none'"
)
HTML = b"<!doctype html"
OURS = f'{HTML.decode()}>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'.encode()
INDEX, FILES = "index.html", "files"
SCRIPTS = ["lists.js", "keys.js", *REPLAY, "single.js"]  # of one page
MARK = "\0"  # stands before and after the address of a page until its file is known
_ODD = re.compile(r"[^A-Za-z0-9_.]+")
LONGEST_NAME = 120


def export_folder(
    db: Path,
    folder: Path,
    patterns: Sequence[str] = (),
    progress: Callable[[int], object] = lambda _: None,
) -> Path:
    """Write the pages of a study into a folder; returns the first of them.

    ``patterns`` are names of trials, with * as a wildcard, that limit the list and the pages.
    ``progress`` gets the number of written pages. An earlier export in the folder goes. Raises
    UsageError; then, as where a page holds a key or a path of this machine, the folder stays as it
    was.
    """
    index, files = folder / INDEX, folder / FILES
    if folder.is_file():
        raise UsageError(f"{folder} is a file: name a folder")
    check_kind(index, OURS, "exported study")
    if files.exists() and not index.exists():
        raise UsageError(f"{files} is there, and is no exported study's: name another folder")
    begin, heads = ("/trials", OF_TRIALS) if patterns else ("/", tuple(FOLLOWED))
    site = Site(db, _links(heads), policy=POLICY)
    with _opened(site, patterns) as rows, _staged(folder) as stage:
        if patterns:
            site.trial_index.keep([row["number"] for row in rows])
        else:
            # All that pages wait for; what takes long comes last.
            figures = (("figure", name, "svg") for name in FIGURES)
            for request in (*(("table", name, "", "") for name in TABLES), ("audit",), *figures):
                site.computing.ask(request, stamp_of(db))
        try:
            asyncio.run(_save_all(_Crawl(site, begin, stage, progress), rows, heads))
        except BrokenProcessPool:
            raise UsageError("nothing was written: a process that helped was ended") from None
    return index


def export_page(db: Path, file: Path, patterns: Sequence[str]) -> Path:
    """Write one page with the trials of these names; returns its path. Raises UsageError."""
    check_kind(file, HTML, "page of HTML")
    shown: set[tuple[str, str]] = set()

    def leads(address: str) -> str:
        """Return the address of a trial that the page holds; empty for all others."""
        parts = urlsplit(address)
        trial, params = unquote(parts.path.removeprefix("/trials/")), dict(parse_qsl(parts.query))
        is_there = (trial, params.get("spec", "")) in shown
        return query_of({"trial": trial, **params}) if is_there else ""

    inlined = inlined_texts([STYLE, *SCRIPTS])
    site = Site(db, Links(leads), policy=policy_of(inlined), inlined=inlined)
    with _opened(site, patterns) as rows, _staged(file.parent) as stage:
        shown.update((row["trial_id"], row["spec_hash"]) for row in rows)
        if len(rows) == 1:
            (page,) = trial_pages(site, rows)
        else:  # rendered by templates of ours
            trials = list(
                zip(rows, map(Markup, trial_pages(site, rows, "_trial.html")), strict=True)
            )
            scripts = [*REPLAY, "single.js"]
            page = site.render("several.html", view="trials", trials=trials, scripts=scripts)
        check_leaks(db, "the page", page)
        (stage / file.name).write_text(_linked(page), encoding="utf-8")
    return file


def _linked(page: str) -> str:
    """Return a page in which a link that leads nowhere is a text."""
    return page.replace(' href=""', "")


class _Crawl:
    """Pages that are saved in ``stage``: ``begin``, all of trials, and those to which links lead.

    ``files`` has the file of each page by its address, empty for none; ``waiting`` are not saved.
    """

    def __init__(
        self, site: Site, begin: str, stage: Path, progress: Callable[[int], object]
    ) -> None:
        self.site, self.stage, self.progress = site, stage, progress
        self.begin, self.files, self.waiting = begin, {begin: INDEX}, [begin]
        self._names, self._done = {INDEX}, count(1)
        transport = httpx.ASGITransport(explorer(site), raise_app_exceptions=False)
        plain = {"accept-encoding": "identity"}
        url = f"http://{LOOPBACK}"
        self.client = httpx.AsyncClient(transport=transport, base_url=url, headers=plain)

    def add(self, page: str) -> str:
        """Return the file of a page that has none yet."""
        self.files[page] = name = _name_of(page, self._names)
        self._names.add(name.lower())
        return name

    async def save(self, page: str, text: str) -> None:
        """Save a page with links to the files of others; raise UsageError for a leak."""
        check_leaks(self.site.db, self.files[page], text)
        root = "" if page == self.begin else "../"
        parts = text.split(MARK)
        for place in range(1, len(parts), 2):
            file = await self._file_of(parts[place])
            parts[place] = escape(root + file) if file else ""
        path = self.stage / self.files[page]
        path.parent.mkdir(exist_ok=True)
        path.write_text(_linked("".join(parts)), encoding="utf-8")
        self.progress(next(self._done))

    async def _file_of(self, page: str) -> str:
        if page in self.files:
            return self.files[page]
        name = self.add(page)
        if name.endswith(".html"):
            self.waiting.append(page)
            return name
        # A style, a script, a table; a figure that cannot be drawn has no file.
        file = await self.client.get(page)
        if file.is_error:
            self.files[page] = ""
        else:
            check_leaks(self.site.db, name, file.text)
            (self.stage / name).parent.mkdir(parents=True, exist_ok=True)
            (self.stage / name).write_bytes(file.content)
        return self.files[page]


async def _save_all(crawl: _Crawl, rows: Sequence[Row], heads: tuple[str, ...]) -> None:
    """Save the pages of a crawl; helper processes render those of trials."""
    waiting = crawl.waiting
    for row in rows:
        crawl.add(Links().trial(row))
    helpers = processes(min(os.cpu_count() or 1, MOST_HELPERS))
    with ExitStack() as ends:
        ends.callback(helpers.shutdown, cancel_futures=True)
        # Most pages are of trials, and most of the time they are what is waited for.
        rendering = deque(
            helpers.submit(_trial_pages, crawl.site.db, heads, rows[first : first + READ_AT_ONCE])
            for first in range(0, len(rows), READ_AT_ONCE)
        )
        while waiting or rendering:
            if rendering and (rendering[0].done() or not waiting):
                for page, text in (await asyncio.wrap_future(rendering.popleft())).items():
                    await crawl.save(page, text)
            else:
                page = min(waiting, key=lambda page: page.startswith(LAST))
                waiting.remove(page)
                await crawl.save(page, await _served(crawl.client, page))


async def _served(client: httpx.AsyncClient, address: str) -> str:
    """Return a page, also one that says what is not there; raises UsageError."""
    reply = await client.get(address)
    if reply.is_error and reply.status_code != httpx.codes.NOT_FOUND:
        raise UsageError(
            f"nothing was written: {address} answers {reply.status_code}; `merge-runner view` "
            "shows why"
        )
    return reply.text


def _links(heads: tuple[str, ...]) -> Links:
    """Return links to the pages of an export, between marks: the crawl puts a file for each."""

    def leads(address: str) -> str:
        page, moment = _page_of(address, heads)
        # Markup, so that the marks stay; no page holds this character otherwise.
        return Markup(f"{MARK}{page}{MARK}") + moment if page else ""  # noqa: S704

    return Links(leads)


@lru_cache(1)
def _still(db: Path, heads: tuple[str, ...]) -> Site:
    site = Site(db, _links(heads), policy=POLICY, is_still=True)
    site.trial_index.refresh()
    site.trial_index.ask("SET threads = 1")  # there are several of these
    return site


def _trial_pages(db: Path, heads: tuple[str, ...], rows: Sequence[Row]) -> dict[str, str]:
    return dict(zip(map(Links().trial, rows), trial_pages(_still(db, heads), rows), strict=True))


@cache  # pages link to each other
def _page_of(address: str, heads: tuple[str, ...]) -> tuple[str, str]:
    """Split an address into a page and the moment it shows; two empty texts for other pages."""
    parts = urlsplit(address)
    head = parts.path.removeprefix("/").partition("/")[0]
    if head == "static":
        return address, ""
    if head not in heads:
        return "", ""
    known, params = FOLLOWED[head], dict(parse_qsl(parts.query))
    moment = query_of({name: params.pop(name) for name in MOMENT if name in params})
    # In one order, whatever the page that links to it says first.
    kept = {n: params[n] for n in sorted(params) if n in known or n.startswith(FACTOR)}
    if parts.path.endswith(".png") or params.keys() - kept.keys() - {*SCOPE}:
        return "", ""
    return parts.path + query_of(kept), moment


def _name_of(page: str, taken: Collection[str]) -> str:
    """Return a name for the file of a page that no other one has, whatever the page is called."""
    parts = urlsplit(page)
    path = PurePosixPath(unquote(parts.path))
    if page.startswith("/static/"):
        return f"{FILES}{path}"
    suffix = path.suffix if page.startswith(("/tables/", "/figures/")) else ""
    values = [part for pair in parse_qsl(parts.query) if pair[0] != "spec" for part in pair]
    words = "-".join([str(path).removesuffix(suffix), *values])
    name = f"{FILES}/{_ODD.sub('-', words).strip('-')[:LONGEST_NAME]}"
    named = (f"{name}{end}{suffix or '.html'}" for end in chain([""], map("-{}".format, count(2))))
    return next(file for file in named if file.lower() not in taken)


@contextmanager
def _opened(site: Site, patterns: Sequence[str]) -> Iterator[list[Row]]:
    """Give the trials of these names; raises UsageError for none or too many."""
    db = site.db
    site.refresh()
    site.is_still = True  # so that all pages are of the same trials
    rows = [
        row
        for row in site.trial_index.every({})
        if not patterns or any(fnmatchcase(row["trial_id"], pattern) for pattern in patterns)
    ]
    if not rows:
        names = ", ".join(patterns) or "any name"
        raise UsageError(f"{db} holds no trial called {names}; `merge-runner view` lists them")
    if (number := sum(row["source"] != "human" for row in rows)) > MOST:
        raise UsageError(
            f"these are {number:,} trials, and pages without a server are for {MOST:,}: choose "
            f"some with --trials, or send {db.name} and open it with `merge-runner view --db "
            f"{db.name}`"
        )
    try:
        yield rows
    finally:
        site.computing.close()


@contextmanager
def _staged(folder: Path) -> Iterator[Path]:
    """Yield a temporary folder; its files move to this one at the end. Raises UsageError."""
    parent = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.is_dir())
    try:
        with tempfile.TemporaryDirectory(prefix=".merge-runner-", dir=parent) as stage:
            yield Path(stage)
            folder.mkdir(parents=True, exist_ok=True)
            for path in Path(stage).iterdir():
                earlier = folder / path.name
                if path.is_dir() and earlier.is_dir():
                    shutil.rmtree(earlier)
                path.replace(earlier)
    except OSError as exc:
        raise UsageError(f"{folder} cannot be written: {exc}") from exc
