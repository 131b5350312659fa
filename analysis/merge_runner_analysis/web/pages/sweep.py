"""All runs and what may cost trust in each, and the page of one, which follows it while it runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from merge_runner_analysis.task import RULE, task_settings
from merge_runner_analysis.web.computing import Job
from merge_runner_analysis.web.listing import MISSING
from merge_runner_analysis.web.reading import Row
from merge_runner_analysis.web.runs import list_runs, numbers_of, origin_of, repeats
from merge_runner_analysis.web.scope import carried, scope_of
from merge_runner_analysis.web.site import NothingNew, NotThere, Site, news_of
from merge_runner_analysis.wording import PLAYED_RULES, RULES_MEAN

CAUSES = """
SELECT value AS cause, count(*) AS trials, sum(times)::BIGINT AS times
FROM several SEMI JOIN (FROM several WHERE facet = 'sweep' AND value = ?) USING (number)
WHERE facet = 'cause' GROUP BY ALL ORDER BY trials DESC, cause
"""


# Rates of events that may cost trust: ``count`` of ``of`` are columns of a run, and
# ``state`` filters the trials behind the count.
TRUST = [
    dict(zip(("name", "count", "of", "things", "meaning", "state"), rate, strict=True))
    for rate in (
        ("crashes", "collided", "ended", "ended trials",
         "the vehicles came closer than the collision rule allows", {"outcome": "collided"}),
        ("failed trials", "failed", "trials", "stored trials",
         "a call got no answer; the trial has no outcome and can be played anew",
         {"outcome": "failed"}),
        ("invalid replies", "invalid", "asked", "decisions asked",
         "the reply held no valid plan", {"validity": "fallbacks"}),
        ("fallbacks", "fallbacks", "asked", "decisions asked",
         "an older plan was driven on, or none", {"validity": "fallbacks"}),
        ("missing decisions", "no_decision", "asked", "decisions asked",
         "a valid plan without the tactical decision that was asked for", {"cause": MISSING}),
        ("failed requests (retried)", "faults", "attempts", "requests, counted in each trial",
         "no answer came; a request is sent again, or its trial fails", {}),
        ("wrong model", "others", "answers", "answers, counted in each trial",
         "it is neither the one asked for nor a declared alias of it", {}),
        ("reused replies", "shared", "replies", "replies, each counted once",
         "one reply decided in several trials: at these decisions they are one sample", {}),
    )
]  # fmt: skip

# Rates that the list of runs always shows; others appear where there is any such case.
ALWAYS = ("collided", "failed", "invalid", "faults")


def sweeps_page(site: Site, params: Mapping[str, str]) -> str:
    """Return the runs of a scope; raises NotThere, and NothingNew where they are as ``seen``."""
    bar, part = scope_of(site, params, any_prompt=True), carried(params)
    runs = list_runs(site.trial_index)
    counted = numbers_of(site.trial_index, bar.scope.filters)
    rare = counted[""] | {"fallbacks": 0}  # each follows an invalid reply
    return site.render(
        "sweeps.html",
        view="sweeps",
        bar=bar,
        carried=part,
        runs=[run for run in runs if not part or counted[run["sweep_id"]]["trials"]],
        counted=counted,
        audit=audit_of(site, runs),
        shown=[rate for rate in TRUST if str(rate["count"]) in ALWAYS or rare[str(rate["count"])]],
        seen=news_of((runs, site.trial_index.state), params.get("seen", "")),
    )


def sweep_page(site: Site, sweep_id: str, params: Mapping[str, str]) -> str:
    """Return the page of a run; raises NotThere, and NothingNew where it is as ``seen``."""
    seen = params.get("seen", "")
    matching = [run for run in list_runs(site.trial_index) if run["sweep_id"] == sweep_id]
    if not matching:
        raise NotThere(f"the database holds no run {sweep_id}")
    (run,) = matching
    state = run["state"]
    if seen and state == "lost" and site.trial_index.copies.is_locked:
        raise NothingNew  # how it ended cannot be read yet
    return site.render(
        "sweep.html",
        view="sweeps",
        entry=run,
        audit=audit_of(site, [run]),
        arms=site.trial_index.counts({"sweep": sweep_id}, "model", "variant"),
        trust=TRUST,
        repeats=repeats(run),
        origin=origin_of(run),
        task=", ".join(
            dict.fromkeys(
                _in_words(setting)
                for arm in run["config"].get("arms") or ()
                for setting in task_settings(arm.get("scenario") or {})
            )
        ),
        causes=site.trial_index.ask(CAUSES, sweep_id),
        seen=news_of((run, site.trial_index.state), seen, state),
        # A screen reader says the sentence once a state, and not every time that a number changes.
        quiet=seen.startswith(f"{state}-"),
        heard=bool(seen),
    )


def _in_words(setting: str) -> str:
    """Return a setting of the driving task, the rule of crashes with its meaning."""
    name, _, value = setting.partition(" = ")
    return f"crashes by {PLAYED_RULES[value]} ({RULES_MEAN[value]})" if name == RULE else setting


def audit_of(site: Site, runs: Sequence[Row]) -> Job | None:
    """Return the audit's notes on each run; None during a run, which ends with an audit."""
    return None if any(run["followed"] for run in runs) else site.computed(("audit",))
