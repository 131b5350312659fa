"""A sweep's outcome as text for a reader and as one JSON object for a program."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

from merge_runner.errors import ReplayMiss
from merge_runner.results.store import SweepFacts
from merge_runner.run.estimate import Estimate
from merge_runner.run.plan import Plan
from merge_runner.run.sweep import Options, Outcome

COLUMNS = ("trials", "left first", "right first", "collided", "timeout", "failed")
LEDGER = ("model", "variant", "fate", "outcome", "attempts")
FAILURES_SHOWN = 10
PRICED_ALIKE = "replies of stand-ins are priced as the model's; nobody charges for them"


@dataclass(frozen=True, slots=True)
class Summary:
    """A plan's outcome, how it ran, and what was expected of it where that was estimated."""

    plan: Plan
    outcome: Outcome
    options: Options
    expected: Estimate | None = None

    def as_dict(self) -> dict[str, Any]:
        """The summary as JSON values."""
        outcome, facts = self.outcome, self.outcome.facts
        return {
            "sweep_id": outcome.sweep_id,
            "name": self.plan.name,
            "model": self.plan.model,
            "driver": outcome.driver,
            "scripted": bool(facts.stand_ins) if facts else self.plan.scripted,
            "exit_code": outcome.exit_code,
            "messages": outcome.messages,
            "db": str(self.options.db),
            "trials": {
                "planned": outcome.trials,
                "stored_before": outcome.stored_before,
                "suspended": outcome.suspended,
                **(_statuses(facts) if facts else {}),
            },
            "calls": {"live": outcome.calls_live, "cached": outcome.calls_cached},
            "attempts": outcome.attempts,
            "cost_usd": round(outcome.cost_usd, 6),
            "calls_of_unknown_cost": outcome.calls_of_unknown_cost,
            "estimate": None if self.expected is None else asdict(self.expected),
            "sweep_cost_usd": round(outcome.spending.spent_usd, 6),
            "set_aside_usd": round(outcome.spending.reserved_usd, 6),
            "attempts_of_unknown_cost": outcome.spending.open_attempts,
            "overrun_usd": round(outcome.spending.overrun_usd, 6),
            "cache_cost_usd": round(outcome.cache_cost_usd, 6),
            "damaged_entries": outcome.damaged,
            "playing_s": round(outcome.playing_s, 3),
            "worst_stall_s": round(outcome.worst_stall_s, 3),
            "decisions": facts.decisions if facts else None,
            "invalid_decisions": facts.invalid if facts else None,
            "fallbacks": facts.fallbacks if facts else None,
            "model_mismatches": self.mismatches(),
            "ledger": [
                dict(zip(LEDGER, row, strict=True)) for row in (facts.ledger if facts else ())
            ],
            "failed": dict(facts.failed) if facts else {},
            "audit": None if outcome.audit is None else outcome.audit.as_dict(),
            "outcomes": [
                {"variant": variant, "condition": condition, **_named(counts)}
                for (variant, condition), counts in (_cells(facts) if facts else {}).items()
            ],
            "outcomes_without_fallbacks": _named(_total(facts, fallbacks=False)) if facts else {},
        }

    def lines(self) -> Iterator[str]:
        """The summary for a reader."""
        outcome, facts = self.outcome, self.outcome.facts
        if facts is not None:
            yield from self._table(facts)
            yield ""
            yield from self._failures(facts)
        yield from self._costs()
        for key in outcome.damaged:
            yield f"WARNING: a recorded reply was damaged, set aside and asked again: {key}"
        for pair, answers in self.mismatches().items():
            yield f"WARNING: another model answered than was asked for: {pair} ({answers} answers)"
        if facts is not None:
            yield from (_stand_in(*found) for found in facts.stand_ins)
            if outcome.cost_usd and facts.stand_ins:
                yield PRICED_ALIKE
            audit = outcome.audit
            if audit is not None:
                checked = ", ".join(f"{n} {what}" for what, n in audit.counts.items() if n)
                yield f"audited: {checked}: {len(audit.findings) or 'no'} findings"
                yield from (f"note: {text}" for text in (*audit.notes, *map(str, audit.sharings)))
            for trial_id, error in facts.failed[:FAILURES_SHOWN]:
                yield f"failed: {trial_id}: {error}"
            if len(facts.failed) > FAILURES_SHOWN:
                yield f"... and {len(facts.failed) - FAILURES_SHOWN} more, in the table trials"
            if facts.failed and outcome.exit_code != ReplayMiss.exit_code:
                yield "Run the same command again to play the failed trials anew."
        yield f"database: {self.options.db}"

    def _failures(self, facts: SweepFacts) -> Iterator[str]:
        """What went wrong on the way, and whether it may have changed the outcomes."""
        share = f" ({facts.invalid / facts.decisions:.1%})" if facts.invalid else ""
        yield (
            f"decisions: {facts.decisions}, {facts.invalid} invalid{share}, "
            f"{facts.fallbacks} fallbacks to an earlier plan"
        )
        cells: dict[tuple[str, str], Counter[str]] = {}
        for model, variant, fate, outcome, attempts in facts.ledger:
            if fate != "driven":
                why = f"{fate} after {outcome}"
                cells.setdefault((model, variant), Counter())[why] += attempts
        for (model, variant), counts in cells.items():
            named = ", ".join(f"{count} {what}" for what, count in counts.most_common())
            yield f"attempts without a plan, {model}, {variant}: {named}"
        if facts.fallbacks:
            for name, fallbacks in (("all trials", None), ("trials without fallbacks", False)):
                of_them = _named(_total(facts, fallbacks=fallbacks))
                yield f"outcomes of {name}: " + ", ".join(f"{n} {w}" for w, n in of_them.items())

    def _costs(self) -> Iterator[str]:
        outcome, spending = self.outcome, self.outcome.spending
        unknown = outcome.calls_of_unknown_cost
        yield (
            f"calls: {outcome.calls_live} live, {outcome.calls_cached} from recordings; "
            f"cost {outcome.cost_usd:.4f} USD"
            + (f" and {unknown} calls of unknown cost" if unknown else "")
        )
        if self.expected is not None:
            cost = self.expected.cost_usd
            yield (
                f"estimated before: {self.expected.calls} calls, "
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
                + f"; all replies in {self.options.cache}: {outcome.cache_cost_usd:.4f} USD"
            )
        if spending.overrun_usd:
            yield (
                f"WARNING: replies cost {spending.overrun_usd:.4f} USD more than their worst case "
                f"({spending.dearest}): the server does not keep to the output cap"
            )

    def mismatches(self) -> dict[str, int]:
        """Requested and served model, where another one answered, with how often."""
        others = self.outcome.facts.others if self.outcome.facts else ()
        return {f"{requested} -> {served}": answers for requested, served, answers in others}

    def _table(self, facts: SweepFacts) -> Iterator[str]:
        """Counts per condition, and per variant where there are several."""
        cells = _cells(facts)
        by_condition = _grouped(cells, 1)
        yield _row("condition", COLUMNS)
        for condition in self.plan.conditions:
            yield _row(condition, _named(by_condition.get(condition, Counter())).values())
        yield _row("all", _named(sum(cells.values(), Counter())).values())
        if len(self.plan.repetitions) > 1:
            by_variant = _grouped(cells, 0)
            yield ""
            yield _row("variant", COLUMNS)
            for variant in self.plan.repetitions:
                yield _row(variant, _named(by_variant.get(variant, Counter())).values())


def _stand_in(driver: str, model: str, provider: str, scripted: int, answers: int) -> str:
    """That a stand-in answered in a model's name, or was asked for as what it is."""
    if provider == "emulator":
        return f"The model `{model}` is a scripted stand-in, no language model."
    part = "" if scripted == answers else f" in {scripted} of {answers} answers"
    return f"{driver}: a scripted stand-in answered, not {model}{part}"


def _cells(facts: SweepFacts) -> dict[tuple[str, str], Counter[str]]:
    """(variant, condition) to counts of statuses and of first mergers."""
    cells: dict[tuple[str, str], Counter[str]] = {}
    for variant, condition, status, merged_first, _, trials in facts.outcomes:
        counts = cells.setdefault((variant, condition), Counter())
        counts["trials"] += trials
        counts[_ending(status, merged_first)] += trials
    return cells


def _total(facts: SweepFacts, *, fallbacks: bool | None) -> Counter[str]:
    """Counts over trials with or without fallbacks; None: over all."""
    counts: Counter[str] = Counter()
    for _, _, status, merged_first, fallen_back, trials in facts.outcomes:
        if fallbacks in (None, fallen_back):
            counts["trials"] += trials
            counts[_ending(status, merged_first)] += trials
    return counts


def _ending(status: str, merged_first: str | None) -> str:
    return f"{merged_first} first" if status == "finished" else status


def _grouped(cells: dict[tuple[str, str], Counter[str]], index: int) -> dict[str, Counter[str]]:
    grouped: dict[str, Counter[str]] = {}
    for key, counts in cells.items():
        grouped.setdefault(key[index], Counter()).update(counts)
    return grouped


def _named(counts: Counter[str]) -> dict[str, int]:
    return {column: counts[column] for column in COLUMNS}


def _statuses(facts: SweepFacts) -> dict[str, int]:
    counts: Counter[str] = Counter()
    for _, _, status, _, _, trials in facts.outcomes:
        counts[status] += trials
    return {status: counts[status] for status in ("finished", "collided", "timeout", "failed")}


def _row(name: str, values: object) -> str:
    # Widths that no count changes, so that two runs can be laid beside each other; rich fits them.
    assert hasattr(values, "__iter__")
    return f"{name:<10}" + "".join(f"{value:>12}" for value in values)
