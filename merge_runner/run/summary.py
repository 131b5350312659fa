"""What came of a sweep: as one JSON object, and as text for a reader."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from io import StringIO
from itertools import groupby
from operator import itemgetter
from typing import Any, get_args

from merge_runner.audit.checks import Audit
from merge_runner.drivers.registry import EMULATOR
from merge_runner.errors import ReplayMiss
from merge_runner.llm.client import Meter
from merge_runner.records import Status
from merge_runner.results.export import write_table
from merge_runner.results.store import SweepFacts
from merge_runner.run.estimate import Estimate
from merge_runner.run.plan import Options, Plan
from merge_runner.run.progress import Progress, first_of

COLUMNS = ("trials", "left first", "right first", "collided", "timeout", "failed")
SHOWN = 10


def as_dict(
    options: Options,
    progress: Progress,
    expected: Estimate | None,
    checked: tuple[SweepFacts, Audit] | None,
    **told: object,
) -> dict[str, Any]:
    """The summary as JSON values; ``expected`` is the estimate made before the run, if any.

    ``checked`` is what the database holds of the sweep. From ``decisions`` on, values are there
    where anything is stored. ``told`` goes into it.
    """
    plan, spending, meter = progress.plan, progress.ledger.spending, Meter()
    for each in progress.runner.meters.values():
        meter.add(each)
    playing_s = ((progress.ended_at or progress.began_at) - progress.began_at).total_seconds()
    summary: dict[str, Any] = {
        **told,
        "name": plan.name,
        "model": plan.model,
        "driver": plan.driver,
        "scripted": plan.scripted,
        "db": str(options.db),
        "trials": {
            "planned": plan.trials,
            "stored_before": progress.stored,
            "suspended": progress.outcome_counts["suspended"],
        },
        "calls": {"live": meter.calls_live, "cached": meter.calls_cached},
        "attempts": meter.outcomes,
        "cost_usd": round(meter.cost_usd, 6),
        "calls_of_unknown_cost": meter.cost_unknown,
        "estimate": None if expected is None else asdict(expected),
        "sweep_cost_usd": round(spending.spent_usd, 6),
        "set_aside_usd": round(spending.reserved_usd, 6),
        "attempts_of_unknown_cost": spending.open_attempts,
        "over_the_worst_case_usd": round(spending.overrun_usd, 6),
        "dearest": spending.dearest,
        "damaged_entries": meter.damaged,
        "open_batches": progress.batches(),
        "playing_s": round(playing_s, 3),
        "worst_stall_s": round(progress.worst_stall_s, 3),
        "audit": None,
    }
    if checked is None:
        return summary
    facts, audit = checked
    statuses = Counter(dict.fromkeys(get_args(Status), 0))
    for _, status, _, number in facts.outcomes:
        statuses[status] += number
    summary["trials"] |= statuses
    notes = {n: e.note for n, e in plan.entries.items() if e.note and e.provider != EMULATOR}
    return summary | {
        "scripted": bool(facts.stand_ins),
        "audit": audit.as_dict(),
        "decisions": facts.decisions,
        "invalid_decisions": facts.invalid,
        "fallbacks": facts.fallbacks,
        "model_mismatches": {f"{asked} -> {served}": n for asked, served, n in facts.others},
        "stand_ins": [row[:3] for row in facts.stand_ins],
        "notes": notes,
        "failed": dict(facts.failed),
        "outcomes_by_level": [*_tallies(plan, facts)],
        "first_looks": facts.first_looks,
    }


def _tallies(plan: Plan, facts: SweepFacts) -> Iterator[dict[str, Any]]:
    """Counts of trials by COLUMNS, for each condition, all, and each level of each factor."""
    shown = {"condition": [*plan.conditions, "all"], **plan.levels}
    tallies = {(name, level): Counter[str]() for name in shown for level in shown[name]}
    rows = [
        ("condition", level, status, merged_first, trials)
        for condition, status, merged_first, trials in facts.outcomes
        for level in (condition, "all")
    ]
    for factor, level, status, merged_first, trials in [*rows, *facts.levels]:
        outcome = f"{merged_first} first" if status == "finished" else status
        tally = tallies.setdefault((factor, level), Counter())
        tally.update({"trials": trials, outcome: trials})
    for (factor, level), tally in tallies.items():
        if tally["trials"]:
            yield {"factor": factor, "level": level, **{name: tally[name] for name in COLUMNS}}


def as_lines(summary: dict[str, Any]) -> Iterator[str]:
    """The summary by ``as_dict`` for a reader."""
    is_stored = summary["audit"] is not None
    if is_stored:
        yield from _results(summary)
    yield from _costs(summary)
    yield from (f"open batch: {text}" for text in summary["open_batches"])
    for key in summary["damaged_entries"]:
        yield f"WARNING: a recorded reply was damaged, set aside and asked again: {key}"
    if is_stored:
        yield from _faults(summary)
        yield f"database: {summary['db']}"


def _results(summary: dict[str, Any]) -> Iterator[str]:
    """How the trials ended, or what drivers do first."""
    if looks := summary["first_looks"]:
        yield as_table(looks)
    for factor, group in groupby(summary["outcomes_by_level"], key=itemgetter("factor")):
        levels = [{factor: row["level"], **{name: row[name] for name in COLUMNS}} for row in group]
        if len(levels) > 1 and not looks:
            yield as_table(levels)
    decisions, invalid = summary["decisions"], summary["invalid_decisions"]
    share = f" ({invalid / decisions:.1%})" if invalid else ""
    yield (
        f"decisions: {decisions}, {invalid} invalid{share}, "
        f"{summary['fallbacks']} fallbacks to an earlier plan"
    )


def _costs(summary: dict[str, Any]) -> Iterator[str]:
    number = summary["calls_of_unknown_cost"]
    unknown = f" and {number} calls of unknown cost" if number else ""
    yield (
        f"calls: {summary['calls']['live']} live, {summary['calls']['cached']} from recordings; "
        f"cost {summary['cost_usd']:.4f} USD{unknown}"
    )
    if (expected := summary["estimate"]) is not None:
        usd = _about(expected["cost_usd"])
        yield f"estimated before: {expected['calls']} calls, {usd}"
    spent_usd, aside_usd = summary["sweep_cost_usd"], summary["set_aside_usd"]
    if spent_usd + aside_usd:
        yield (
            f"this sweep over all its runs: {spent_usd:.4f} USD, and {aside_usd:.4f} set aside "
            "(`merge-runner ledger` says why)"
        )
    if over_usd := summary["over_the_worst_case_usd"]:
        yield (
            f"WARNING: replies cost {over_usd:.4f} USD more than their worst case "
            f"({summary['dearest']}): the server does not keep to the output cap"
        )


def _faults(summary: dict[str, Any]) -> Iterator[str]:
    """Who answered in whose place, what the audit says, and which trials failed."""
    for pair, answers in summary["model_mismatches"].items():
        yield f"WARNING: another model answered than was asked for: {pair} ({answers} answers)"
    for driver, model, provider in summary["stand_ins"]:
        if provider == EMULATOR:
            yield f"The model `{model}` is a scripted stand-in, no language model."
        else:
            yield f"{driver}: a scripted stand-in answered, not {model}"
    yield from (f"{name}: {note}" for name, note in summary["notes"].items())
    audit = summary["audit"]
    checked = ", ".join(f"{n} {what}" for what, n in audit["counts"].items() if n)
    yield f"audited: {checked}: {len(audit['findings']) or 'no'} findings"
    notes = [f"note: {each}" for each in audit["notes"]]
    yield from first_of(notes, "more notes: `merge-runner audit`", SHOWN)
    failed = [f"failed: {trial_id}: {error}" for trial_id, error in summary["failed"].items()]
    yield from first_of(failed, "more, in the table trials", SHOWN)
    if failed and summary["exit_code"] != ReplayMiss.exit_code:
        yield "Run the same command again to play the failed trials anew."


def as_table(rows: Sequence[dict[str, Any]]) -> str:
    """The table of a few rows, numbers shortened; empty without a row."""
    text = StringIO()
    if rows:
        cells = ([f"{v:g}" if isinstance(v, float) else v for v in r.values()] for r in rows)
        write_table([*rows[0]], map(tuple, cells), text)
    return text.getvalue()


def _about(cost_usd: float | None) -> str:
    return "an unknown price" if cost_usd is None else f"about {cost_usd:.2f} USD"


def estimate_lines(expected: Estimate) -> Iterator[str]:
    """What a run will take, for a reader."""
    measured = ", as measured before" if expected.measured else ""
    tokens = f"about {expected.input_tokens} in, {expected.output_tokens} out{measured}"
    yield f"driver  {expected.driver}"
    yield f"trials  {expected.trials} that have not ended yet"
    yield f"calls   about {expected.calls} that are not recorded yet"
    yield f"tokens  {tokens}"
    if not expected.rounds:
        yield f"cost    {_about(expected.cost_usd)}"
        yield f"time    about {expected.minutes} minutes"
        return
    singly = f"{_about(expected.singly_usd)} and {expected.minutes} minutes if asked singly"
    yield f"cost    {_about(expected.cost_usd)} in batches; {singly}"
    yield (
        f"time    about {expected.rounds} rounds; each takes as long as its slowest batch: "
        "minutes, an hour, a day at most"
    )
