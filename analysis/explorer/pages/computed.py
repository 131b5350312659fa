"""What pages show of a computation: its result, that it takes a while, or why there is none."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime

from merge_runner.errors import MergeRunnerError
from merge_runner_analysis.explorer.analysis_process import Request, Result, Waiting
from merge_runner_analysis.explorer.site import NotThere, Site
from merge_runner_analysis.explorer.urls import query_of, seconds

# What is kept comes within this time; what takes longer is asked for again.
AT_ONCE_S = 0.3
# CPU time of a first table in a new process, with its imports: 4 s of 110 trials, and of 11,000
# between 6 s (who merged first) and 10 s (the contrasts).
FIRST_TABLE_S, TRIALS_A_SECOND = 4.0, 2_000


@dataclass(frozen=True, slots=True)
class Computed:
    """A result, or None with the seconds that it takes so far, or with a failure.

    ``listed`` is how many trials the database holds now, and ``older`` whether they are others than
    those counted. ``again`` is the query of this page with everything computed anew.
    """

    result: Result | None
    failure: str
    elapsed_s: float
    listed: int
    older: bool
    again: str
    here: str

    @property
    def usual_s(self) -> float:
        """How long a first result may take where nothing was read ahead."""
        return FIRST_TABLE_S + self.listed / TRIALS_A_SECOND

    @property
    def clock(self) -> str:
        """When the result was made, in local time with its zone."""
        assert self.result is not None
        return f"{datetime.fromtimestamp(self.result.at).astimezone():%Y-%m-%d %H:%M:%S %Z}"


def computed(
    site: Site,
    request: Request,
    asked: Mapping[str, str],
    *,
    wait_s: float = AT_ONCE_S,
) -> Computed:
    """Ask for something, and wait for it for a moment; raises NotThere where no table holds it."""
    state = site.catalogue.state()
    since, failure = seconds(asked.get("since", "")), ""
    found: Result | Waiting | None = None
    try:
        found = site.computing.ask(request, state, since=since, wait_s=wait_s)
    except MergeRunnerError as exc:
        failure = str(exc)
    result = found if isinstance(found, Result) else None
    if result is not None and "absent" in result.content:
        raise NotThere(result.content["absent"])
    # Later than this one by the smallest step that an address shows.
    later = {"since": f"{result.at + 0.001:.3f}"} if result else {}
    return Computed(
        result=result,
        failure=failure,
        elapsed_s=found.elapsed_s if isinstance(found, Waiting) else 0.0,
        listed=state[0],
        older=result is not None and result.state != state,
        again=query_of({**asked, **later}),
        here=query_of(asked),
    )
