"""The pages of the explorer over HTTP, and as their floor the same pages as texts.

``reading_s`` is how long the trials are read before there is a page of them, in s. The others are
medians in ms, from a request of a keep-alive client to the end of the page: ``list_ms`` of the list
of trials, ``filtered_ms`` of its third page in one condition, sorted by gap, and ``trial_ms`` of
trials with a decision shown.

Of the first page: ``first_bytes_s`` from the start of the program to a page whose numbers are still
computed, ``computed_s`` until they are all there, and ``complete_s`` when the program is started
once more and the tables are finished. ``export_s`` is how long a folder of all pages takes.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from statistics import median

import httpx

from benchmarks.cases import Bench, Figures, figures_of, study_of
from benchmarks.processes import PROGRAM, PYTHON, run, serving
from merge_runner.results.store import query

ASKED, TIMEOUT_S, POLL_S = 20, 60.0, 0.2
LIST, FILTERED = "trials", "trials?condition=N_0_0&sort=gap&page=3"
# What a page has in the place of numbers that are not there yet.
PENDING = 'class="computing"'
# Trials from everywhere in the study that have the decision.
SHOWN = f"""
SELECT trial_id FROM decisions WHERE side = 'left' AND decision = 3
ORDER BY hash(trial_id) LIMIT {ASKED}
"""  # noqa: S608 # a constant


def explorer(trials: int) -> Callable[[Bench], Figures]:
    """The explorer of a study; of each kind of page the last is kept for the floor."""

    def measure(bench: Bench) -> Figures:
        db, kept = study_of(bench, trials), bench.fresh("pages")
        _, shown = query(db, SHOWN)
        asked = {
            "list": [LIST] * ASKED,
            "filtered": [FILTERED] * ASKED,
            "trial": [f"trials/{trial}?side=left&decision=3" for (trial,) in shown],
        }
        with _client([*PROGRAM, "view", "--db", str(db), "--port", "0"]) as client:
            figures = {"reading_s": _until_read(client)}
            for name, addresses in asked.items():
                figures[f"{name}_ms"], last = _ask(client, addresses)
                (kept / name).write_bytes(last)
        return figures

    return measure


def explorer_floor(bench: Bench) -> Figures:
    """The pages of the last ``explorer`` as texts, from the same kind of server."""
    kept = bench.folder / "pages"
    with _client([PYTHON, "-m", "benchmarks.pages", str(kept)]) as client:
        return {
            f"{name}_ms": _ask(client, [name] * ASKED)[0] for name in ("list", "filtered", "trial")
        }


def first_page(trials: int) -> Callable[[Bench], Figures]:
    """The first page of a study nobody looked at before, and of the same one looked at again."""

    def measure(bench: Bench) -> Figures:
        db = study_of(bench, trials, anew=True)
        first_bytes_s, computed_s = _until_complete(db)
        again_s, complete_s = _until_complete(db)
        return {
            "first_bytes_s": first_bytes_s,
            "computed_s": computed_s,
            "again_s": again_s,
            "complete_s": complete_s,
        }

    return measure


def export(trials: int) -> Callable[[Bench], Figures]:
    """All pages of a study as files, whose tables are finished."""

    def measure(bench: Bench) -> Figures:
        db, folder = study_of(bench, trials), bench.fresh("export") / "pages"
        run([*PROGRAM, "tables", "--db", str(db)])
        ran = run([*PROGRAM, "view", "--db", str(db), "--export", str(folder)])
        return {**figures_of(ran, calls=0), "files": sum(1 for _ in folder.rglob("*.html"))}

    return measure


def _until_complete(db: Path) -> tuple[float, float]:
    """From the start of the program, in s: to a first page, and to one with all its numbers."""
    began = time.perf_counter()
    with _client([*PROGRAM, "view", "--db", str(db), "--port", "0"]) as client:
        reply = client.get("").raise_for_status()
        first_bytes_s = time.perf_counter() - began
        while "refresh" in reply.headers or PENDING in reply.text:
            time.sleep(POLL_S)
            reply = client.get("").raise_for_status()
        return first_bytes_s, time.perf_counter() - began


@contextmanager
def _client(server: Sequence[str]) -> Iterator[httpx.Client]:
    """A client of a server that is there until the end of this."""
    with serving(server) as address, httpx.Client(base_url=address, timeout=TIMEOUT_S) as client:
        yield client


def _until_read(client: httpx.Client) -> float:
    """Return the time in s until a page no longer refreshes itself."""
    began = time.perf_counter()
    while "refresh" in client.get("trials").raise_for_status().headers:
        time.sleep(POLL_S)
    return time.perf_counter() - began


def _ask(client: httpx.Client, addresses: list[str]) -> tuple[float, bytes]:
    """Ask for one after another: the median in ms, and the last page."""
    taken_ms = []
    for address in addresses:
        began = time.perf_counter()
        page = client.get(address).raise_for_status()
        taken_ms.append(1000 * (time.perf_counter() - began))
    return median(taken_ms), page.content
