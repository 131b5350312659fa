"""The summary of a sweep: as JSON values, and as lines for a reader."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from io import StringIO
from typing import TYPE_CHECKING, Any, get_args

from merge_runner.audit.checks import Audit
from merge_runner.drivers.registry import EMULATOR
from merge_runner.llm.ledger import APART
from merge_runner.paths import DEFAULT_CACHE, DEFAULT_DB, command_at
from merge_runner.records import ReplayMiss
from merge_runner.results.export import write_table
from merge_runner.text_safety import first_of
from merge_runner.trial_records import Status

if TYPE_CHECKING:
    from merge_runner.run.estimate import Estimate
    from merge_runner.run.plan import Plan
    from merge_runner.run.progress import Progress

UNREAD_WORDS = (
    "The emulator reads no words: plant an effect to rehearse (docs/run-a-study.md#text-factors)"
)


def underpriced(tier: str) -> str:
    """Return the warning about replies whose service tier has no price in the registry."""
    return (
        f"replies are of the service tier {tier!r}, which is billed at about twice the price that "
        "is counted, and the cap knows nothing of that: leave that tier out, or give the model "
        f"a price with tiers = {{ {tier} = 2.0 }}"
    )


def as_dict(
    progress: Progress,
    sweep_id: str,
    expected: Estimate | None,
    checked: tuple[dict[str, Any], Audit] | None,
) -> dict[str, Any]:
    """Return the summary as JSON values; ``expected`` is the estimate before the run, if any.

    ``checked`` are the facts of the database and their audit; without them the values from
    ``decisions`` on are left out.
    """
    session = progress.session
    plan, options = session.plan, session.options
    playing_s = ((progress.ended_at or progress.began_at) - progress.began_at).total_seconds()
    summary: dict[str, Any] = {
        "sweep_id": sweep_id,
        "exit_code": session.exit_code,
        "messages": session.messages,
        "name": plan.name,
        "run_name": options.name,
        "model": plan.model,
        "driver": plan.driver,
        "scripted": plan.scripted,
        "db": str(options.db),
        "cache": str(options.cache),
        "trials": {
            "planned": plan.trials,
            "stored_before": len(session.stored),
            "suspended": progress.outcome_counts["suspended"],
        },
        **_counts(progress),
        "estimate": None if expected is None else asdict(expected),
        "playing_s": round(playing_s, 3),
        "worst_stall_s": round(progress.worst_stall_s, 3),
        "audit": None,
    }
    if checked is not None:
        facts, audit = checked
        outcomes = dict.fromkeys(get_args(Status), 0) | dict(facts["outcomes"])
        summary |= _stored(plan, facts)
        summary |= {"trials": summary["trials"] | outcomes, "audit": audit.as_dict()}
    return summary


def _counts(progress: Progress) -> dict[str, Any]:
    meter, ledger = progress.meter(), progress.session.ledger
    spending, cap = ledger.spending, ledger.cap
    return {
        "calls": {"live": meter.calls_live, "cached": meter.calls_cached},
        "calls_shared": meter.calls_shared,
        "calls_recorded": meter.calls_recorded,
        "attempts": meter.outcomes,
        "cost_usd": round(meter.cost_usd, 6),
        "calls_of_unknown_cost": meter.cost_unknown,
        "sweep_cost_usd": round(spending.spent_usd, 6),
        "set_aside_usd": round(spending.reserved_usd, 6),
        "attempts_of_unknown_cost": spending.open_attempts,
        "cap_usd": cap.usd if cap else None,
        "cap_source": cap.source if cap else None,
        "over_the_worst_case_usd": round(spending.overrun_usd, 6),
        "dearest": spending.largest_overruns,
        "underpriced": meter.underpriced,
        "damaged_entries": meter.damaged,
        "open_batches": progress.batches(),
    }


def _stored(plan: Plan, facts: dict[str, Any]) -> dict[str, Any]:
    """Return the facts of the database, levels in the order of the plan."""
    shown = {"condition": [*plan.conditions, "all"], **plan.levels}
    order = [(factor, level) for factor, levels in shown.items() for level in levels]
    by_level = {(row["factor"], row["level"]): row for row in facts["levels"]}
    return {
        "scripted": bool(facts["stand_ins"]),
        "decisions": facts["decisions"],
        "invalid_decisions": facts["invalid"],
        "fallbacks": facts["fallbacks"],
        "no_decision": facts["no_decision"],
        "model_mismatches": {
            f"{requested} -> {served}": n for requested, served, n in facts["others"]
        },
        "stand_ins": [row[:3] for row in facts["stand_ins"]],
        "same_prompts": [variants for (variants,) in facts["same_prompts"]],
        "failed": dict(facts["failed"]),
        "outcomes_by_level": [by_level[place] for place in order if place in by_level],
        "first_looks": facts["first_looks"],
    }


def as_lines(summary: dict[str, Any]) -> Iterator[str]:
    """Yield the lines of a summary by ``as_dict``."""
    is_stored = summary["audit"] is not None
    if summary["run_name"]:
        yield f"run: {summary['run_name']}"
    if is_stored:
        yield from _results(summary)
    yield from _costs(summary)
    yield from (f"open batch: {text}" for text in summary["open_batches"])
    for key in summary["damaged_entries"]:
        yield f"WARNING: a recorded reply was damaged, quarantined and asked again: {key}"
    if is_stored:
        yield from _faults(summary)


def _results(summary: dict[str, Any]) -> Iterator[str]:
    if looks := summary["first_looks"]:
        yield as_table(looks)
    else:
        yield _outcomes(summary)
    decisions, invalid = summary["decisions"], summary["invalid_decisions"]
    share = f" ({invalid / decisions:.1%})" if invalid else ""
    missing = summary["no_decision"]
    yield (
        f"decisions: {decisions}, {invalid} invalid{share}, {summary['fallbacks']} fallbacks"
        + (f", {missing} without the tactical decision asked for" if missing else "")
    )


def _outcomes(summary: dict[str, Any]) -> str:
    rows = {(row["factor"], row["level"]): row for row in summary["outcomes_by_level"]}
    whole = dict(rows.get(("condition", "all"), {"trials": 0}))
    trials, planned = whole.pop("trials"), summary["trials"]["planned"]
    of = f" of {planned}" if trials < planned else ""
    stored = summary["trials"]["stored_before"]
    before = f", {stored} of them stored before this run" if stored else ""
    outcome_counts = [
        f"{number} {outcome}"
        for outcome, number in whole.items()
        if isinstance(number, int) and number
    ]
    outcomes = f" ({', '.join(outcome_counts)})" if outcome_counts else ""
    return f"trials: {trials}{of}{outcomes}{before}"


def calls_text(live: int, cached: int, shared: int, from_recordings: int) -> str:
    """Return the numbers of ``live`` calls, and of ``cached`` ones, which sent no request.

    ``shared`` of the cached ones have a reply of this run, ``from_recordings`` have one of a
    recording that the user named.
    """
    parts = {
        "from recordings": from_recordings,
        "from the cache": cached - shared - from_recordings,
        "shared with another trial": shared,
    }
    had = [f"{number} {how}" for how, number in parts.items() if number]
    return ", ".join([f"{live} asked"] * bool(live or not had) + had)


def _costs(summary: dict[str, Any]) -> Iterator[str]:
    number = summary["calls_of_unknown_cost"]
    unknown = f" and {number} calls of unknown cost" if number else ""
    made = (*summary["calls"].values(), summary["calls_shared"], summary["calls_recorded"])
    calls = calls_text(*made)
    spent_usd, reserved_usd = summary["sweep_cost_usd"], summary["set_aside_usd"]
    apart = bool(reserved_usd) or round(spent_usd, 4) != round(summary["cost_usd"], 4)
    alone = " in this run" if apart else ""
    text = f"calls: {calls}; cost {summary['cost_usd']:.4f} USD{alone}{unknown}"
    if (expected := summary["estimate"]) is not None:
        from merge_runner.run.estimate import usd_text

        text += f"; estimated before: {expected['calls']} calls, {usd_text(expected['cost_usd'])}"
    if (cap_usd := summary["cap_usd"]) is not None:
        text += f"; cap: {cap_usd:g} USD ({summary['cap_source']})"
    yield text
    if apart:
        ledger = command_at("merge-runner ledger", "--cache", summary["cache"], DEFAULT_CACHE)
        why = f", and {reserved_usd:.4f} reserved (`{ledger}` says why)"
        yield f"this sweep over all its runs: {spent_usd:.4f} USD{why if reserved_usd else ''}"
        yield APART
    if over_usd := summary["over_the_worst_case_usd"]:
        yield (
            f"WARNING: replies cost {over_usd:.4f} USD more than their worst case "
            f"({summary['dearest']}): the server does not keep to the output cap"
        )
    for tier, answers in summary["underpriced"].items():
        yield f"WARNING: {answers} {underpriced(tier)}"


def _faults(summary: dict[str, Any]) -> Iterator[str]:
    """Yield the models that answered for others, the audit, and the failed trials."""
    for pair, answers in summary["model_mismatches"].items():
        yield f"WARNING: another model answered than was asked for: {pair} ({answers} replies)"
    for driver, model, provider in summary["stand_ins"]:
        if provider == EMULATOR:
            yield f"The model `{model}` is a mock model, no language model."
        else:
            yield f"{driver}: a mock model answered, not {model}"
    if same := summary["same_prompts"]:
        prompts = "; ".join(map(", ".join, same))
        yield f"the same trials with these prompts: {prompts}. {UNREAD_WORDS}"
    audit = summary["audit"]
    audit_it = command_at("merge-runner audit", "--db", summary["db"], DEFAULT_DB)
    findings = f"{len(audit['findings'])} findings, which `{audit_it}` lists"
    checked = findings if audit["findings"] else "no problems"
    yield f"checked: {checked}; database: {summary['db']}"
    notes = [f"note: {note}" for note in audit["notes"]]
    yield from first_of(notes, f"more notes: `{audit_it}`")
    failed = [f"failed: {trial_id}: {error}" for trial_id, error in summary["failed"].items()]
    yield from first_of(failed, "more, in the table trials")
    if failed and summary["exit_code"] != ReplayMiss.exit_code:
        yield "Run the same command again to play the failed trials anew."


def as_table(rows: Sequence[dict[str, Any]]) -> str:
    """Return a table of a few rows, numbers shortened; empty without a row."""
    text = StringIO()
    if rows:
        cells = ([f"{v:g}" if isinstance(v, float) else v for v in r.values()] for r in rows)
        write_table([*rows[0]], map(tuple, cells), text)
    return text.getvalue()
