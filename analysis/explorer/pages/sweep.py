"""All runs and what may cost trust in each, and the page of one, which follows it while it runs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from merge_runner_analysis.explorer.computing import Job
from merge_runner_analysis.explorer.pages.computed import computed
from merge_runner_analysis.explorer.scope import carried, scope_of
from merge_runner_analysis.explorer.site import NothingNew, NotThere, Site, news_of
from merge_runner_analysis.explorer.sweeps import (
    CAUSES,
    TRUST,
    Run,
    arms_of,
    duration,
    list_runs,
    numbers_of,
)
from merge_runner_analysis.explorer.views import prompt_text


def sweeps_page(site: Site, asked: Mapping[str, str]) -> str:
    """The runs of a scope; raises NotThere, and NothingNew where they are as they were ``seen``."""
    bar, part = scope_of(site, asked, any_prompt=True), carried(asked)
    runs = list_runs(site.catalogue)
    counted = numbers_of(site.catalogue, *bar.scope.where())
    if part:
        runs = [(run, said) for run, said in runs if counted[run.sweep_id]["trials"]]
    return site.render(
        "sweeps.html",
        here="sweeps",
        bar=bar,
        carried=part,
        runs=runs,
        counted=counted,
        trust=TRUST,
        audit=audit_of(site, [run for run, _ in runs]),
        duration=duration,
        seen=news_of((runs, site.catalogue.state()), asked.get("seen", "")),
    )


def sweep_page(site: Site, sweep_id: str, asked: Mapping[str, str]) -> str:
    """One run; raises NotThere, and NothingNew as ``seen``."""
    seen = asked.get("seen", "")
    runs = list_runs(site.catalogue)
    found = [(run, said) for run, said in runs if run.sweep_id == sweep_id]
    if not found:
        raise NotThere(f"the database holds no sweep {sweep_id}")
    run, assessment = found[0]
    if seen and run.state == "lost" and site.catalogue.held:
        raise NothingNew  # how it ended cannot be read yet
    return site.render(
        "sweep.html",
        here="sweeps",
        entry=run,
        assessment=assessment,
        arms=arms_of(site.catalogue, run),
        trust=TRUST,
        audit=audit_of(site, [run]),
        causes=site.catalogue.ask(CAUSES, sweep_id),
        prompt_text=prompt_text,
        duration=duration,
        seen=news_of((run, assessment, site.catalogue.state()), seen, run.state),
        # A screen reader says the sentence once a state, and not every time that a number changes.
        quiet=seen.startswith(f"{run.state}-"),
        heard=bool(seen),
    )


def audit_of(site: Site, runs: Iterable[Run]) -> Job | None:
    """What the audit notes of each run; None while one goes on, which ends with an audit."""
    if any(run.followed for run in runs):
        return None
    return computed(site, ("audit",))
