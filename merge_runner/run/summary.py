"""Plays a plan, and sums up what came of it: as one JSON object, and as text for a reader."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import asdict, replace
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any, get_args

from merge_runner.drivers.registry import EMULATOR
from merge_runner.errors import ReplayMiss
from merge_runner.llm.cache import ResponseCache
from merge_runner.paths import SHIPPED_RECORDINGS
from merge_runner.records import Status
from merge_runner.results.query_output import as_table
from merge_runner.results.recording import recorded_part
from merge_runner.results.store import SweepFacts
from merge_runner.run.estimate import Estimate
from merge_runner.run.plan import Options, Plan
from merge_runner.run.progress import first_of
from merge_runner.run.sweep import Outcome, open_sweep

COLUMNS = ("trials", "left first", "right first", "collided", "timeout", "failed")
SHOWN = 10


async def play(
    plan: Plan,
    options: Options,
    *,
    whole: bool,
    say: Callable[[str], None],
    agree: Callable[[Estimate], None],
) -> tuple[dict[str, Any], str]:
    """Play what is not stored yet of a plan; return the summary as JSON values and as text.

    A replay without a recording, or replies of the models in the cache, is of the recording that
    ships with the program; one that is not ``whole`` plays what its recordings hold. ``agree`` gets
    an estimate before money is spent, and raises where it is not to be. Raises UsageError.
    """
    if options.replay:
        shipped = SHIPPED_RECORDINGS / f"{plan.model}-{plan.study.name}.parquet"
        # A user's own replies are never mixed with those of somebody else.
        if not options.recordings and shipped.is_file() and not _has_replies(options.cache, plan):
            options = replace(options, recordings=(shipped,))
            say(f"The replies are from the recording that ships with merge-runner: {shipped}")
        part = plan if whole else _recorded(plan, options.recordings)
        if part.trials < plan.trials:
            say(f"note: the recording holds {part.trials} of the plan's {plan.trials} trials")
        plan = part
    expected = None
    async with open_sweep(plan, options, say=say) as sweep:
        is_free = all(entry.price == "free" for entry in plan.entries.values())
        if sweep.todo and not (options.replay or is_free):
            expected = await sweep.estimate()
            agree(expected)
        outcome = await sweep.run()
    summary = as_dict(outcome, options, expected)
    return summary, "\n".join(as_lines(outcome, summary))


def _has_replies(folder: Path, plan: Plan) -> bool:
    """Whether a cache holds replies of the plan's models, or any that cannot be read."""
    if not (folder / "cache.db").is_file():
        return False
    ids = {entry.id for entry in plan.entries.values()}
    damaged: list[str] = []
    with closing(ResponseCache(folder, read_only=True)) as cache:
        models = (entry.request.model for entry in cache.entries(damaged))
        return not ids.isdisjoint(models) or bool(damaged)


def _recorded(plan: Plan, recordings: Sequence[Path]) -> Plan:
    """The part of a plan that recordings of the same sweep hold; all of it if they do not say.

    A sweep's recording holds its first situations, too.
    """
    names = {plan.study.name, plan.name}
    held = recorded_part(recordings, names, plan.model, plan.sample_set)
    if held is None:
        return plan
    arms = tuple(
        replace(arm, repetitions=min(arm.repetitions, held.repetitions[arm.variant]))
        for arm in plan.arms
        if held.repetitions.get(arm.variant) and (not held.arms or arm.label in held.arms)
    )
    conditions = tuple(one for one in plan.conditions if one in held.conditions)
    part = plan.model_copy(update={"arms": arms, "conditions": conditions})
    return part if part.trials else plan


def as_dict(outcome: Outcome, options: Options, expected: Estimate | None) -> dict[str, Any]:
    """The summary as JSON values; ``expected`` is the estimate made before the run, if any.

    The last ones, from ``decisions`` on, are there where anything is stored.
    """
    plan, facts, meter, spending = outcome.plan, outcome.facts, outcome.meter, outcome.spending
    summary: dict[str, Any] = {
        "sweep_id": outcome.sweep_id,
        "name": plan.name,
        "model": plan.model,
        "driver": plan.driver,
        "scripted": bool(facts.stand_ins) if facts else plan.scripted,
        "exit_code": outcome.exit_code,
        "messages": outcome.messages,
        "db": str(options.db),
        "trials": {
            "planned": plan.trials,
            "stored_before": outcome.stored_before,
            "suspended": outcome.suspended,
        },
        "calls": {"live": meter.calls_live, "cached": meter.calls_cached},
        "attempts": meter.outcomes,
        "cost_usd": round(meter.cost_usd, 6),
        "calls_of_unknown_cost": meter.cost_unknown,
        "estimate": None if expected is None else asdict(expected),
        "sweep_cost_usd": round(spending.spent_usd, 6),
        "set_aside_usd": round(spending.reserved_usd, 6),
        "attempts_of_unknown_cost": spending.open_attempts,
        "damaged_entries": meter.damaged,
        "open_batches": outcome.batches,
        "playing_s": round(outcome.playing_s, 3),
        "worst_stall_s": round(outcome.worst_stall_s, 3),
        "audit": None if outcome.audit is None else outcome.audit.as_dict(),
    }
    if facts is not None:
        statuses = Counter(dict.fromkeys(get_args(Status), 0))
        for _, status, _, number in facts.outcomes:
            statuses[status] += number
        summary["trials"] |= statuses
        summary |= {
            "decisions": facts.decisions,
            "invalid_decisions": facts.invalid,
            "fallbacks": facts.fallbacks,
            "model_mismatches": {f"{asked} -> {served}": n for asked, served, n in facts.others},
            "failed": dict(facts.failed),
            "outcomes_by_level": [*_tallies(plan, facts)],
            "first_looks": facts.first_looks,
        }
    return summary


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


def as_lines(outcome: Outcome, summary: dict[str, Any]) -> Iterator[str]:
    """The summary for a reader; ``summary`` is the same by ``as_dict``."""
    facts = outcome.facts
    if facts is not None:
        yield from _results(outcome.plan, facts, summary)
    yield from _costs(outcome, summary)
    yield from (f"open batch: {text}" for text in outcome.batches)
    for key in outcome.meter.damaged:
        yield f"WARNING: a recorded reply was damaged, set aside and asked again: {key}"
    if facts is not None:
        yield from _faults(outcome, facts, summary)
        yield f"database: {summary['db']}"


def _results(plan: Plan, facts: SweepFacts, summary: dict[str, Any]) -> Iterator[str]:
    """How the trials ended, or what drivers do first."""
    if facts.first_looks:
        yield as_table(facts.first_looks)
    for factor, group in groupby(summary["outcomes_by_level"], key=itemgetter("factor")):
        levels = [{factor: row["level"], **{name: row[name] for name in COLUMNS}} for row in group]
        if len(levels) > 1 and not plan.seat:
            yield as_table(levels)
    share = f" ({facts.invalid / facts.decisions:.1%})" if facts.invalid else ""
    yield (
        f"decisions: {facts.decisions}, {facts.invalid} invalid{share}, "
        f"{facts.fallbacks} fallbacks to an earlier plan"
    )


def _costs(outcome: Outcome, summary: dict[str, Any]) -> Iterator[str]:
    meter, spending = outcome.meter, outcome.spending
    unknown = f" and {meter.cost_unknown} calls of unknown cost" if meter.cost_unknown else ""
    yield (
        f"calls: {meter.calls_live} live, {meter.calls_cached} from recordings; "
        f"cost {meter.cost_usd:.4f} USD{unknown}"
    )
    if (expected := summary["estimate"]) is not None:
        usd = _about((expected["batch"] or expected)["cost_usd"])
        yield f"estimated before: {expected['calls']} calls, {usd}"
    if spending.committed_usd:
        yield (
            f"this sweep over all its runs: {spending.spent_usd:.4f} USD, and "
            f"{spending.reserved_usd:.4f} set aside (`merge-runner ledger` says why)"
        )
    if spending.overrun_usd:
        yield (
            f"WARNING: replies cost {spending.overrun_usd:.4f} USD more than their worst case "
            f"({spending.dearest}): the server does not keep to the output cap"
        )


def _faults(outcome: Outcome, facts: SweepFacts, summary: dict[str, Any]) -> Iterator[str]:
    """Who answered in whose place, what the audit says, and which trials failed."""
    for pair, answers in summary["model_mismatches"].items():
        yield (f"WARNING: another model answered than was asked for: {pair} ({answers} answers)")
    for driver, model, provider, _, _ in facts.stand_ins:
        if provider == EMULATOR:
            yield f"The model `{model}` is a scripted stand-in, no language model."
        else:
            yield f"{driver}: a scripted stand-in answered, not {model}"
    for name, entry in outcome.plan.entries.items():
        if entry.note and entry.provider != EMULATOR:
            yield f"{name}: {entry.note}"
    if (audit := outcome.audit) is not None:
        checked = ", ".join(f"{n} {what}" for what, n in audit.counts.items() if n)
        yield f"audited: {checked}: {len(audit.findings) or 'no'} findings"
        notes = [f"note: {each}" for each in audit.notes]
        yield from first_of(notes, "more notes: `merge-runner audit`", SHOWN)
    failed = [f"failed: {trial_id}: {error}" for trial_id, error in facts.failed]
    yield from first_of(failed, "more, in the table trials", SHOWN)
    if failed and outcome.exit_code != ReplayMiss.exit_code:
        yield "Run the same command again to play the failed trials anew."


def _about(cost_usd: float | None) -> str:
    return "an unknown price" if cost_usd is None else f"about {cost_usd:.2f} USD"


def estimate_lines(expected: Estimate) -> Iterator[str]:
    """What a run will take, for a reader."""
    measured = ", as measured before" if expected.measured else ""
    singly = ", asked singly" if expected.batch is not None else ""
    tokens = f"about {expected.input_tokens} in, {expected.output_tokens} out{measured}"
    yield f"driver  {expected.driver}"
    yield f"trials  {expected.trials} that have not ended yet"
    yield f"calls   about {expected.calls} that are not recorded yet"
    yield f"tokens  {tokens}"
    yield f"cost    {_about(expected.cost_usd)}{singly}"
    yield f"time    about {expected.minutes} minutes{singly}"
    if (batch := expected.batch) is not None:
        yield (
            f"batch   {_about(batch.cost_usd)} in about {batch.rounds} rounds, at most "
            f"{batch.most_rounds}; a round takes as long as its slowest batch: minutes, an hour, "
            "a day at most"
        )
