"""Computations as pages show them: a result, a wait, or the reason why there is none."""

from __future__ import annotations

from typing import Any

from merge_runner.errors import StoreError
from merge_runner_analysis.cache import stamp_of
from merge_runner_analysis.tables.model import Table, from_text
from merge_runner_analysis.web.answers import Request
from merge_runner_analysis.web.computing import Job
from merge_runner_analysis.web.site import NotThere, Site

# Cached answers come within this time; a page asks again for others.
AT_ONCE_S = 0.3
FILE_WAIT_S = 300.0


def computed(site: Site, request: Request, wait_s: float = AT_ONCE_S) -> Job:
    """Ask for something, and wait for it for a moment; raises NotThere where no table holds it."""
    # An export waits for every answer: its pages are written once.
    job = site.computing.ask(request, stamp_of(site.db), None if site.is_still else wait_s)
    if job.content is not None and "absent" in job.content:
        raise NotThere(job.content["absent"])
    return job


def computed_table(
    site: Site, name: str, sweep: str = "", condition: str = ""
) -> tuple[Job, Table | None]:
    """Return the job of a table, of all trials or of a part, and the table once it is there."""
    job = computed(site, ("table", name, sweep, condition))
    return job, from_text(job.content["table"]) if job.content else None


def awaited(site: Site, request: Request) -> dict[str, Any]:
    """Return the answer of a computation in FILE_WAIT_S; raises NotThere and StoreError."""
    job = computed(site, request, FILE_WAIT_S)
    if job.content is None:
        raise StoreError(job.failure or "it is still being computed: ask again in a minute")
    return job.content
