"""A sweep's outcome as text for a reader and as one JSON object for a program."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict
from itertools import groupby
from operator import itemgetter
from typing import Any, get_args

from merge_runner.audit.findings import Audit
from merge_runner.drivers.registry import EMULATOR
from merge_runner.errors import ReplayMiss
from merge_runner.records import Status
from merge_runner.results.store import SweepFacts
from merge_runner.run.estimate import Estimate
from merge_runner.run.plan import Options, Plan
from merge_runner.run.sweep import Outcome
from merge_runner.study.crossing import PROMPT

Groups = defaultdict[Any, dict[str, int]]
COLUMNS = ("trials", "left first", "right first", "collided", "timeout", "failed")
LEDGER = ("model", "variant", "fate", "outcome", "attempts")
ASKED = ("side", "own dv", "asked", "invalid", "M", "action")
FAILURES_SHOWN = NOTES_SHOWN = 10
PRICED_ALIKE = "replies of stand-ins are priced as the model's; nobody charges for them"


def as_dict(outcome: Outcome, options: Options, expected: Estimate | None) -> dict[str, Any]:
    """The summary as JSON values; ``expected`` is the estimate made before the run, if any."""
    plan, facts, meter, spending = outcome.plan, outcome.facts, outcome.meter, outcome.spending
    return {
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
            **(_statuses(facts) if facts else {}),
        },
        "calls": {"live": meter.calls_live, "cached": meter.calls_cached},
        "attempts": meter.outcomes,
        "cost_usd": round(meter.cost_usd, 6),
        "calls_of_unknown_cost": meter.cost_unknown,
        "estimate": None if expected is None else asdict(expected),
        "sweep_cost_usd": round(spending.spent_usd, 6),
        "set_aside_usd": round(spending.reserved_usd, 6),
        "attempts_of_unknown_cost": spending.open_attempts,
        "overrun_usd": round(spending.overrun_usd, 6),
        "cache_cost_usd": round(outcome.cache_cost_usd, 6),
        "damaged_entries": meter.damaged,
        "open_batches": outcome.batches,
        "playing_s": round(outcome.playing_s, 3),
        "worst_stall_s": round(outcome.worst_stall_s, 3),
        "decisions": facts.decisions if facts else None,
        "invalid_decisions": facts.invalid if facts else None,
        "fallbacks": facts.fallbacks if facts else None,
        "model_mismatches": _mismatches(facts),
        "ledger": [dict(zip(LEDGER, row, strict=True)) for row in (facts.ledger if facts else ())],
        "failed": dict(facts.failed) if facts else {},
        "audit": None if outcome.audit is None else outcome.audit.as_dict(),
        "outcomes": [
            {"variant": variant, "condition": condition, **counts}
            for (variant, condition), counts in (
                _counts(facts, lambda variant, condition, _: (variant, condition)) if facts else {}
            ).items()
        ],
        "outcomes_by_level": [
            {"factor": factor, "level": level, **counts}
            for (factor, level), counts in (_by_level(facts) if facts else {}).items()
        ],
        "outcomes_without_fallbacks": _by_fallback(facts)[False] if facts else {},
        **({"first_looks": facts.first_looks if facts else []} if plan.seat else {}),
    }


def as_lines(outcome: Outcome, options: Options, expected: Estimate | None) -> Iterator[str]:
    """The summary for a reader; see ``as_dict``."""
    facts = outcome.facts
    if facts is not None:
        yield from _asked(facts) if outcome.plan.seat else _table(outcome.plan, facts)
        yield ""
        yield from _failures(facts)
    yield from _costs(outcome, options, expected)
    yield from (f"open batch: {text}" for text in outcome.batches)
    for key in outcome.meter.damaged:
        yield f"WARNING: a recorded reply was damaged, set aside and asked again: {key}"
    for pair, answers in _mismatches(facts).items():
        yield f"WARNING: another model answered than was asked for: {pair} ({answers} answers)"
    if facts is not None:
        yield from _who_answered(outcome, facts)
        if outcome.audit is not None:
            yield from _audited(outcome.audit)
        yield from _failed(outcome, facts)
    if outcome.sweep_id:
        yield f"database: {options.db}"


def _failures(facts: SweepFacts) -> Iterator[str]:
    """What went wrong on the way, and whether it may have changed the outcomes."""
    share = f" ({facts.invalid / facts.decisions:.1%})" if facts.invalid else ""
    yield (
        f"decisions: {facts.decisions}, {facts.invalid} invalid{share}, "
        f"{facts.fallbacks} fallbacks to an earlier plan"
    )
    without_plan: defaultdict[tuple[str, str], Counter[str]] = defaultdict(Counter)
    for model, variant, fate, outcome, attempts in facts.ledger:
        if fate != "driven":
            without_plan[model, variant][f"{fate} after {outcome}"] += attempts
    for (model, variant), counts in without_plan.items():
        named = ", ".join(f"{count} {what}" for what, count in counts.most_common())
        yield f"attempts without a plan, {model}, {variant}: {named}"
    if facts.fallbacks:
        outcomes = _counts(facts, lambda *_: "all trials")
        outcomes["trials without fallbacks"] = _by_fallback(facts)[False]
        for name, tally in outcomes.items():
            yield f"outcomes of {name}: " + ", ".join(f"{n} {what}" for what, n in tally.items())


def _costs(outcome: Outcome, options: Options, expected: Estimate | None) -> Iterator[str]:
    meter, spending = outcome.meter, outcome.spending
    unknown = meter.cost_unknown
    yield (
        f"calls: {meter.calls_live} live, {meter.calls_cached} from recordings; "
        f"cost {meter.cost_usd:.4f} USD"
        + (f" and {unknown} calls of unknown cost" if unknown else "")
    )
    if expected is not None:
        cost = (expected.batch or expected).cost_usd
        yield (
            f"estimated before: {expected.calls} calls, "
            + ("an unknown price" if cost is None else f"{cost:.2f} USD")
        )
    if spending.committed_usd:
        open_ones = spending.open_attempts
        yield (
            f"this sweep over all its runs: {spending.spent_usd:.4f} USD"
            + (
                f", and {spending.reserved_usd:.4f} set aside for {open_ones} attempts of "
                "unknown cost (`merge-runner ledger` says why)"
                if open_ones
                else ""
            )
            + f"; all sweeps on {options.cache}: {outcome.cache_cost_usd:.4f} USD"
        )
    if spending.overrun_usd:
        yield (
            f"WARNING: replies cost {spending.overrun_usd:.4f} USD more than their worst case "
            f"({spending.dearest}): the server does not keep to the output cap"
        )


def _mismatches(facts: SweepFacts | None) -> dict[str, int]:
    """Requested and served model where these differ, and how often they did."""
    others = facts.others if facts else ()
    return {f"{requested} -> {served}": answers for requested, served, answers in others}


def _table(plan: Plan, facts: SweepFacts) -> Iterator[str]:
    """Counts per condition, and per variant, model and level of a factor where these vary."""
    conditions = _counts(facts, lambda _, condition, __: condition)
    variants = _counts(facts, lambda variant, *_: variant)
    by_level = _by_level(facts)
    yield from _section("condition", {name: conditions[name] for name in plan.conditions})
    yield _row("all", _counts(facts, lambda *_: "all")["all"].values())
    if len(plan.repetitions) > 1:
        yield ""
        yield from _section("variant", {name: variants[name] for name in plan.repetitions})
    levels = {"model": [arm.model_level for arm in plan.arms]}
    for factor, level in (item for arm in plan.arms for item in arm.factors.items()):
        levels.setdefault(factor, []).append(level)
    for factor, each in levels.items():
        if factor != PROMPT and len({*each}) > 1:
            yield ""
            yield from _section(factor, {level: by_level[factor, level] for level in each})


def _section(title: str, groups: dict[str, dict[str, int]]) -> Iterator[str]:
    width = max(map(len, (title, *groups))) + 1
    yield _row(title, COLUMNS, width)
    for name, counts in groups.items():
        yield _row(name, counts.values(), width)


def _asked(facts: SweepFacts) -> Iterator[str]:
    """What was done first, as a table for each driver and prompt, for each of the two that met."""
    looks = facts.first_looks
    models = {(look["driver"], look["model"]) for look in looks}
    met = Counter(driver for driver, _ in models)
    for (driver, variant, model), rows in groupby(
        looks, key=itemgetter("driver", "variant", "model")
    ):
        who = f"{model} of {driver}" if met[driver] > 1 else driver
        yield f"{who}/{variant}: share of M, first action in m/s^2, by own relative velocity"
        yield _row(ASKED[0], ASKED[1:])
        for row in rows:
            merging, action_mps2 = row["share_m"], row["first_action_mps2"]
            cells = [
                f"{row['relative_velocity_mps']:+g} m/s",
                row["asked"],
                row["invalid"],
                "-" if merging is None else f"{merging:.0%}",
                "-" if action_mps2 is None else f"{action_mps2:+.3f}",
            ]
            yield _row(row["side"], cells)


def _who_answered(outcome: Outcome, facts: SweepFacts) -> Iterator[str]:
    """Stand-ins, and what the registry notes of models."""
    for driver, model, provider, scripted, answers in facts.stand_ins:
        if provider == EMULATOR:
            yield f"The model `{model}` is a scripted stand-in, no language model."
        else:
            part = "" if scripted == answers else f" in {scripted} of {answers} answers"
            yield f"{driver}: a scripted stand-in answered, not {model}{part}"
    if outcome.meter.cost_usd and facts.stand_ins:
        yield PRICED_ALIKE
    for name, entry in outcome.plan.entries.items():
        if entry.note and entry.provider != EMULATOR:
            yield f"{name}: {entry.note}"


def _audited(audit: Audit) -> Iterator[str]:
    checked = ", ".join(f"{n} {what}" for what, n in audit.counts.items() if n)
    yield f"audited: {checked}: {len(audit.findings) or 'no'} findings"
    told = audit.notes
    yield from (f"note: {text}" for text in told[:NOTES_SHOWN])
    if len(told) > NOTES_SHOWN:
        yield f"... and {len(told) - NOTES_SHOWN} more notes: `merge-runner audit`"


def _failed(outcome: Outcome, facts: SweepFacts) -> Iterator[str]:
    for trial_id, error in facts.failed[:FAILURES_SHOWN]:
        yield f"failed: {trial_id}: {error}"
    if len(facts.failed) > FAILURES_SHOWN:
        yield f"... and {len(facts.failed) - FAILURES_SHOWN} more, in the table trials"
    if facts.failed and outcome.exit_code != ReplayMiss.exit_code:
        yield "Run the same command again to play the failed trials anew."


def _counts(facts: SweepFacts, group: Callable[[str, str, bool], object]) -> Groups:
    """Counts of trials by COLUMNS, for each group by variant, condition, and had a fallback."""
    groups: Groups = defaultdict(lambda: dict.fromkeys(COLUMNS, 0))
    for variant, condition, status, merged_first, fell_back, trials in facts.outcomes:
        _count(groups[group(variant, condition, fell_back)], status, merged_first, trials)
    return groups


def _by_level(facts: SweepFacts) -> Groups:
    """The same for each level of each factor."""
    groups: Groups = defaultdict(lambda: dict.fromkeys(COLUMNS, 0))
    for factor, level, status, merged_first, trials in facts.levels:
        _count(groups[factor, level], status, merged_first, trials)
    return groups


def _by_fallback(facts: SweepFacts) -> Groups:
    return _counts(facts, lambda _, __, fell_back: fell_back)


def _count(counts: dict[str, int], status: str, merged_first: str | None, trials: int) -> None:
    counts["trials"] += trials
    if (column := f"{merged_first} first" if status == "finished" else status) in COLUMNS:
        counts[column] += trials


def _statuses(facts: SweepFacts) -> dict[str, int]:
    counts: Counter[str] = Counter()
    for _, _, status, _, _, trials in facts.outcomes:
        counts[status] += trials
    return {status: counts[status] for status in get_args(Status)}


def _row(name: str, values: Iterable[object], width: int = 10) -> str:
    # The widths do not depend on the counts, so that two runs can be compared side by side; rich
    # would fit them to the content.
    first, *others = values
    return f"{name:<{max(width, 10)}}{first:>9}" + "".join(f"{value:>12}" for value in others)
