"""What pages show of a computation: its result, that it takes a while, or why there is none."""

from __future__ import annotations

import time
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from merge_runner.errors import MergeRunnerError, StoreError
from merge_runner_analysis.explorer.computing import Request
from merge_runner_analysis.explorer.reading import stamp_of
from merge_runner_analysis.explorer.site import NotThere, Site
from merge_runner_analysis.tables.model import Table, from_text

# What is kept comes within this time; what takes longer is asked for again.
AT_ONCE_S = 0.3
FILE_WAIT_S = 300.0


@dataclass(frozen=True, slots=True)
class Computed:
    """The content of a result, or None with the seconds that it takes so far, or with a failure.

    It was begun ``at`` a local time; the database has changed since where it is ``older``.
    """

    content: dict[str, Any] | None
    failure: str = ""
    at: str = ""
    elapsed_s: float = 0.0
    older: bool = False


def computed(site: Site, request: Request, wait_s: float = AT_ONCE_S) -> Computed:
    """Ask for something, and wait for it for a moment; raises NotThere where no table holds it."""
    state = stamp_of(site.db)
    try:
        job = site.computing.ask(request, state, wait_s)
    except MergeRunnerError as exc:
        return Computed(None, str(exc))
    if job.content is not None and "absent" in job.content:
        raise NotThere(job.content["absent"])
    at = f"{datetime.fromtimestamp(job.at).astimezone():%Y-%m-%d %H:%M:%S %Z}"
    return Computed(job.content, "", at, time.time() - job.at, job.state != state)


def computed_table(
    site: Site, name: str, sweep: str = "", condition: str = ""
) -> tuple[Computed, Table | None]:
    """A table, of all trials or of a part of them, once it is computed."""
    found = computed(site, ("table", name, sweep, condition))
    return found, from_text(found.content["table"]) if found.content else None


def awaited(site: Site, request: Request) -> dict[str, Any]:
    """What a computation answers, however long that takes; raises NotThere and StoreError."""
    found = computed(site, request, FILE_WAIT_S)
    if found.content is None:
        raise StoreError(found.failure or "it is still being computed: ask again in a minute")
    return found.content
