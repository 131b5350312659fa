"""Has trials packed for an export: a few at once by this process, many by two others."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from functools import partial
from queue import SimpleQueue
from typing import Any

from analysis.explorer.child import Child, Ended, NoAnswer
from analysis.explorer.packing import pack_trials
from analysis.explorer.reading import Row
from analysis.explorer.site import Site
from analysis.explorer.urls import StaticLinks
from merge_runner.errors import UsageError

# A process reads so many trials at once, in some 50 MB, and the queries for them take as long as
# for a tenth of them.
AT_ONCE = 250
PROCESSES = 2
# Of so many trials: what takes longer, or more, is an error.
LONGEST_S, MOST_BYTES = 3600.0, 2**30

Block = dict[str, Any]


@contextmanager
def packing(site: Site, blocks: Sequence[Sequence[Row]]) -> Iterator[Iterator[Block]]:
    """Have each block of trials packed, in their order; many are begun before one is asked for.

    Raises UsageError.
    """
    others = site.catalogue.others
    if len(blocks) < PROCESSES:
        yield (pack_trials(site, block, others) for block in blocks)
        return
    requests = [{"rows": block, "others": sorted(others)} for block in blocks]
    free: SimpleQueue[Child] = SimpleQueue()
    with ExitStack() as stack:
        pool = ThreadPoolExecutor(PROCESSES)
        stack.callback(pool.shutdown, cancel_futures=True)
        for _ in range(PROCESSES):
            child = _worker(site)
            stack.callback(child.close)  # before the threads that wait for it
            free.put(child)
        yield pool.map(partial(_ask, free), requests)


def _worker(site: Site) -> Child:
    assert isinstance(site.at, StaticLinks)
    links = {"pages": list(site.at.pages), "alone": site.at.alone}
    try:
        child = Child("analysis.explorer.packing_worker", str(site.db), json.dumps(links))
    except NoAnswer as exc:
        raise UsageError(str(exc)) from exc
    child.give_study()
    return child


def _ask(free: SimpleQueue[Child], request: object) -> Block:
    """Have a free process pack trials; one that ended fails at once."""
    child = free.get()
    try:
        _, body = child.ask(request, seconds=LONGEST_S, most_bytes=MOST_BYTES)
    except NoAnswer as exc:
        raise UsageError(str(exc)) from exc
    except Ended as exc:
        raise UsageError(f"nothing was written: trials could not be packed ({exc})") from exc
    finally:
        free.put(child)
    found: Block = json.loads(body)
    return found
