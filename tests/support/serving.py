"""The explorer in the tests' own process, what a page says, and a program that holds a database."""

import os
import re
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from html import unescape
from html.parser import HTMLParser
from pathlib import Path

import uvicorn
from starlette.testclient import TestClient

from merge_runner.errors import UsageError
from merge_runner_analysis.web.answers import answer
from merge_runner_analysis.web.app import explorer, listen
from merge_runner_analysis.web.computing import Computing
from merge_runner_analysis.web.export import export_folder
from merge_runner_analysis.web.site import Site
from tests.support.gate import HANGS_S

HOST = "127.0.0.1:8700"
INLINE = {
    *("a", "abbr", "b", "code", "del", "i", "ins"),
    *("kbd", "mark", "q", "small", "span", "strong"),
}


def in_process(db, compute=answer):
    """A computation in a thread of this process."""
    return Computing(db, compute, partial(ThreadPoolExecutor, 1), look_up=lambda *_: None)


def never(db, request):
    """A computation that never comes to anything."""
    raise UsageError("not now")


class Awaited(Computing):
    """Has a page wait for what is computed, so that it need not be asked again and again."""

    def ask(self, request, state, wait_s=0.0):
        return super().ask(request, state, HANGS_S)


def client_of(db: Path, computing: Computing | None = None, **options) -> TestClient:
    """A client without a server, which has the ``site`` and awaits its numbers."""
    site = Site(db, **options)
    site.computing = computing or Awaited(db, start=partial(ThreadPoolExecutor, 1))
    client = TestClient(explorer(site), base_url=f"http://{HOST}", raise_server_exceptions=False)
    client.site = site
    return client


def words_of(html: str) -> str:
    """What a piece of a page says, without tags."""
    return " ".join(unescape(re.sub(r"<[^>]*>", " ", html)).split())


def listed(html: str) -> int:
    """How many trials a list says there are."""
    return int(re.search(r"<strong>([\d,]+)</strong> trials", html)[1])


class Page(HTMLParser):
    """What a page says, titles of pictures too, and its links: addresses with their words."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.said: list[str] = []
        self.links: list[tuple[str, str]] = []
        self.inline: list[tuple[str, str]] = []
        self._link: str | None = None
        self._script = False
        self.feed(html)
        self.text = " ".join("".join(self.said).split())

    def handle_starttag(self, tag, attrs):
        self._script = tag in {"script", "style"}
        self._link = dict(attrs).get("href") if tag == "a" else self._link
        if tag == "small":
            self.said.append(" ")
        if self._link is not None and tag == "a":
            self.links.append((self._link, ""))
        for name, value in attrs:
            if name in {"aria-label", "title"}:
                self.said.append(f" {value} ")
            if name == "style" or name.startswith("on"):
                self.inline.append((tag, name))

    def handle_endtag(self, tag):
        self._script = False
        self._link = None if tag == "a" else self._link
        self.said.append("" if tag in INLINE else " ")

    def handle_data(self, data):
        if self._script:
            return
        self.said.append(data)
        if self._link is not None:
            address, words = self.links[-1]
            self.links[-1] = address, " ".join(f"{words}{data}".split())

    def to(self, start: str) -> list[tuple[str, str]]:
        """The links to addresses that begin so."""
        return [link for link in self.links if link[0].startswith(start)]


@contextmanager
def served(db: Path, port: int = 0):
    """The explorer of a database in a thread of its own; gives its address."""
    listener = listen(port)
    host = f"127.0.0.1:{listener.getsockname()[1]}"
    server = uvicorn.Server(uvicorn.Config(explorer(Site(db)), log_level="warning", ws="none"))
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
    thread.start()
    try:
        while not server.started:
            time.sleep(0.01)
        yield f"http://{host}"
    finally:
        server.should_exit = True
        thread.join()


@contextmanager
def held(db: Path):
    """Another program holds the database, and has changed something."""
    holding = (
        "import duckdb, sys; c = duckdb.connect(sys.argv[1]); print('held', flush=True);"
        "sys.stdin.read()"
    )
    holder = subprocess.Popen(
        [sys.executable, "-c", holding, str(db)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert holder.stdout.readline() == b"held\n"
    os.utime(db)
    try:
        yield
    finally:
        holder.communicate()


def in_a_thread(function, *arguments):
    """Where a browser is there, the tests' own thread has an event loop."""
    with ThreadPoolExecutor(1) as thread:
        return thread.submit(function, *arguments).result()


def export(db, folder, wanted=()):
    """Export a study or some trials; gives the folder of all pages but the first."""
    assert in_a_thread(export_folder, db, folder, wanted) == folder / "index.html"
    return folder / "files"
