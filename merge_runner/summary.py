"""A sweep's outcome as text for a reader and as one JSON object for a program."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from merge_runner.errors import ReplayMiss
from merge_runner.plan import Plan
from merge_runner.store import SweepFacts
from merge_runner.sweep import Outcome

COLUMNS = ("trials", "left first", "right first", "collided", "timeout", "failed")
FAILURES_SHOWN = 10


@dataclass(frozen=True, slots=True)
class Summary:
    """A plan's outcome and where it is stored."""

    plan: Plan
    outcome: Outcome
    db: Path

    def as_dict(self) -> dict[str, Any]:
        """The summary as JSON values."""
        outcome, facts = self.outcome, self.outcome.facts
        return {
            "sweep_id": outcome.sweep_id,
            "name": self.plan.name,
            "model": self.plan.model,
            "scripted": self.plan.scripted,
            "exit_code": outcome.exit_code,
            "messages": outcome.messages,
            "db": str(self.db),
            "trials": {
                "planned": outcome.trials,
                "stored_before": outcome.stored_before,
                **(_statuses(facts) if facts else {}),
            },
            "calls": {"live": outcome.calls_live, "cached": outcome.calls_cached},
            "attempts": outcome.attempts,
            "cost_usd": round(outcome.cost_usd, 6),
            "calls_of_unknown_cost": outcome.calls_of_unknown_cost,
            "decisions": facts.decisions if facts else None,
            "invalid_decisions": facts.invalid if facts else None,
            "fallbacks": facts.fallbacks if facts else None,
            "model_mismatches": self.mismatches(),
            "failed": dict(facts.failed) if facts else {},
            "outcomes": [
                {"variant": variant, "condition": condition, **_named(counts)}
                for (variant, condition), counts in (_cells(facts) if facts else {}).items()
            ],
        }

    def lines(self) -> Iterator[str]:
        """The summary for a reader."""
        outcome, facts = self.outcome, self.outcome.facts
        if facts is not None:
            yield from self._table(facts)
            yield ""
            yield (
                f"decisions: {facts.decisions}, {facts.invalid} invalid, "
                f"{facts.fallbacks} fallbacks to an earlier plan"
            )
        unknown = outcome.calls_of_unknown_cost
        yield (
            f"calls: {outcome.calls_live} live, {outcome.calls_cached} from recordings; "
            f"cost {outcome.cost_usd:.4f} USD"
            + (f" and {unknown} calls of unknown cost" if unknown else "")
        )
        for pair, answers in self.mismatches().items():
            yield f"WARNING: another model answered than was asked for: {pair} ({answers} answers)"
        if self.plan.scripted:
            yield "The model `emulator` is a scripted stand-in, no language model."
        if facts is not None:
            for trial_id, error in facts.failed[:FAILURES_SHOWN]:
                yield f"failed: {trial_id}: {error}"
            if len(facts.failed) > FAILURES_SHOWN:
                yield f"... and {len(facts.failed) - FAILURES_SHOWN} more, in the table trials"
            if facts.failed and outcome.exit_code != ReplayMiss.exit_code:
                yield "Run the same command again to play the failed trials anew."
        yield f"database: {self.db}"

    def mismatches(self) -> dict[str, int]:
        """Requested and served model, where the latter is neither the id nor an alias."""
        accepted = {entry.id: {entry.id, *entry.aliases} for entry in self.plan.entries.values()}
        return {
            f"{requested} -> {served}": answers
            for requested, served, answers in (
                self.outcome.facts.served if self.outcome.facts else ()
            )
            if served is not None and served not in accepted.get(requested, {requested})
        }

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


def _cells(facts: SweepFacts) -> dict[tuple[str, str], Counter[str]]:
    """(variant, condition) to counts of statuses and of first mergers."""
    cells: dict[tuple[str, str], Counter[str]] = {}
    for variant, condition, status, merged_first, trials in facts.outcomes:
        counts = cells.setdefault((variant, condition), Counter())
        counts["trials"] += trials
        if status == "finished":
            counts[f"{merged_first} first"] += trials
        else:
            counts[status] += trials
    return cells


def _grouped(cells: dict[tuple[str, str], Counter[str]], index: int) -> dict[str, Counter[str]]:
    grouped: dict[str, Counter[str]] = {}
    for key, counts in cells.items():
        grouped.setdefault(key[index], Counter()).update(counts)
    return grouped


def _named(counts: Counter[str]) -> dict[str, int]:
    return {column: counts[column] for column in COLUMNS}


def _statuses(facts: SweepFacts) -> dict[str, int]:
    counts: Counter[str] = Counter()
    for _, _, status, _, trials in facts.outcomes:
        counts[status] += trials
    return {status: counts[status] for status in ("finished", "collided", "timeout", "failed")}


def _row(name: str, values: object) -> str:
    assert hasattr(values, "__iter__")
    return f"{name:<10}" + "".join(f"{value:>12}" for value in values)
