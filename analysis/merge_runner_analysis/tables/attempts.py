"""Outcomes of the calls: retried, lost, unusable, or replaced by an older plan."""

from __future__ import annotations

from collections import Counter

from merge_runner.records import NO_DECISION
from merge_runner_analysis.provenance import tally
from merge_runner_analysis.study import StudyResults
from merge_runner_analysis.tables.model import GROUP_COLUMNS, STORED, Column, Table, row_of

# Failures with a share of the answers beside their number; the others are malformed answers, and
# have a column where they occur.
FAILURES = {"refused": "refusal", "truncated": "truncated", "empty": "empty"}
# Denominator of each share: a call may take several attempts, and a lost call has no answer that
# could be invalid.
OF = {"retried": "attempts", "lost": "calls", "fallback": "decisions"}
MEANINGS = {
    "trials": "all trials, also those that failed",
    "failed": "trials that failed",
    "calls": "decisions at which a model was asked",
    "attempts": "HTTP attempts at these calls",
    "retried": "attempts that were followed by another",
    "lost": "calls that ended without an answer",
    **{name: f"answers that are {name}, without a plan" for name in FAILURES},
    "invalid": "answers without a valid plan, for any reason",
    NO_DECISION: "answers with a valid plan, and without the tactical decision asked for",
    "fallback": "decisions driven from an older plan, or from none",
    "unknown": "attempts of unknown fate",
    "other_model": "answers of another model",
}
SHARES = {"retried", "lost", *FAILURES, "invalid", NO_DECISION, "fallback"}


def attempts(study: StudyResults) -> Table:
    """Return a row per driver and variant: trials, calls, attempts, and failures."""
    tallies = {group: tally(study, group.stored) for group in study.played}
    known = {"answers", "decisions", *MEANINGS, *FAILURES.values()}
    reasons = dict.fromkeys(name for of in tallies.values() for name in sorted({*of} - known))
    names = [*MEANINGS]
    if not any(of[NO_DECISION] for of in tallies.values()):
        names.remove(NO_DECISION)
    names[names.index("invalid") : names.index("invalid")] = reasons
    columns = [column for name in names for column in _columns(name)]
    return Table(
        "attempts",
        (*GROUP_COLUMNS, *columns),
        [
            row_of(group, _values(columns, counts), _note(counts), rests_on=STORED)
            for group, counts in tallies.items()
        ],
        (
            "a call is asked at one decision, in one or more attempts; retried is of all attempts, "
            "lost of the calls, fallback of all decisions, any other share of the answers; "
            "unknown: attempts that were under way when a run was killed",
        ),
    )


def _columns(name: str) -> list[Column]:
    meaning = MEANINGS.get(name, f"answers without a valid plan: {name}")
    counts = "" if name == "trials" else FAILURES.get(name, name)
    count = Column(name, name.replace("_", " "), "count", meaning, counts)
    share = Column(f"{name}_percent", "(%)", "percent", f"share of {meaning}", counts)
    return [count, share] if name in SHARES else [count]


def _values(columns: list[Column], counts: Counter[str]) -> dict[str, int | float | None]:
    values: dict[str, int | float | None] = {}
    for column in columns:
        name = column.name.removesuffix("_percent")
        count, of = counts[FAILURES.get(name, name)], counts[OF.get(name, "answers")]
        # No calls at all is not 0 %.
        values[column.name] = count if column.kind == "count" else 100 * count / of if of else None
    return values


def _note(counts: Counter[str]) -> str:
    if counts["answers"]:
        return ""
    note = "no call: this driver asks no model, or its calls are not in the database"
    if counts["calls"]:
        note = "no call was answered"
    return note if counts["decisions"] else f"{note}; no decision is stored"
