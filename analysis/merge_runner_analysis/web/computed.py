"""What pages show of a computation: its result, that it takes a while, or why there is none."""

from __future__ import annotations

from typing import Any

from merge_runner.errors import StoreError
from merge_runner_analysis.cache import stamp_of
from merge_runner_analysis.tables.model import Table, from_text
from merge_runner_analysis.web.answers import Request
from merge_runner_analysis.web.computing import Job
from merge_runner_analysis.web.site import NotThere, Site

# What is kept comes within this time; what takes longer is asked for again.
AT_ONCE_S = 0.3
FILE_WAIT_S = 300.0


def computed(site: Site, request: Request, wait_s: float = AT_ONCE_S) -> Job:
    """Ask for something, and wait for it for a moment; raises NotThere where no table holds it."""
    # What is written to files once waits for all of it.
    job = site.computing.ask(request, stamp_of(site.db), None if site.is_still else wait_s)
    if job.content is not None and "absent" in job.content:
        raise NotThere(job.content["absent"])
    return job


def computed_table(
    site: Site, name: str, sweep: str = "", condition: str = ""
) -> tuple[Job, Table | None]:
    """A table, of all trials or of a part of them, once it is computed."""
    found = computed(site, ("table", name, sweep, condition))
    return found, from_text(found.content["table"]) if found.content else None


def awaited(site: Site, request: Request) -> dict[str, Any]:
    """What a computation answers, however long that takes; raises NotThere and StoreError."""
    found = computed(site, request, FILE_WAIT_S)
    if found.content is None:
        raise StoreError(found.failure or "it is still being computed: ask again in a minute")
    return found.content
