"""What pages show of a computation: its result, that it takes a while, or why there is none."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from merge_runner.errors import MergeRunnerError, StoreError
from merge_runner_analysis.explorer.computing import Request
from merge_runner_analysis.explorer.reading import stamp_of
from merge_runner_analysis.explorer.site import NotThere, Site
from merge_runner_analysis.explorer.urls import query_of
from merge_runner_analysis.tables.model import Table, from_text

# What is kept comes within this time; what takes longer is asked for again.
AT_ONCE_S = 0.3
FILE_WAIT_S = 300.0


@dataclass(frozen=True, slots=True)
class Computed:
    """The content of a result, or None with the seconds that it takes so far, or with a failure.

    It is ``older`` where the database has changed since; ``at`` is when it was begun, in s since
    1970, ``here`` the query of this page, and ``again`` that with everything computed anew.
    """

    content: dict[str, Any] | None
    failure: str
    at: float
    older: bool
    again: str
    here: str

    @property
    def elapsed_s(self) -> float:
        """How long it takes so far."""
        return time.time() - self.at

    @property
    def clock(self) -> str:
        """When the result was made, in local time with its zone."""
        return f"{datetime.fromtimestamp(self.at).astimezone():%Y-%m-%d %H:%M:%S %Z}"


def computed(
    site: Site, request: Request, asked: Mapping[str, str], *, wait_s: float = AT_ONCE_S
) -> Computed:
    """Ask for something, and wait for it for a moment; raises NotThere where no table holds it."""
    state, job, failure = stamp_of(site.db), None, ""
    try:
        job = site.computing.ask(request, state, anew="anew" in asked, wait_s=wait_s)
    except MergeRunnerError as exc:
        failure = str(exc)
    content = job.content if job else None
    if content is not None and "absent" in content:
        raise NotThere(content["absent"])
    here = {name: value for name, value in asked.items() if name != "anew"}
    return Computed(
        content=content,
        failure=failure,
        at=job.at if job else time.time(),
        older=job is not None and job.state != state,
        again=query_of({**here, "anew": 1}),
        here=query_of(here),
    )


def computed_table(
    site: Site, name: str, asked: Mapping[str, str], sweep: str = "", condition: str = ""
) -> tuple[Computed, Table | None]:
    """A table, of all trials or of a part of them, once it is computed."""
    found = computed(site, ("table", name, sweep, condition), asked)
    return found, from_text(found.content["table"]) if found.content else None


def awaited(site: Site, request: Request, asked: Mapping[str, str]) -> dict[str, Any]:
    """What a computation answers, however long that takes; raises NotThere and StoreError."""
    found = computed(site, request, asked, wait_s=FILE_WAIT_S)
    if found.content is None:
        raise StoreError(found.failure or "it is still being computed: ask again in a minute")
    return found.content
