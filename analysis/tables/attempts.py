"""What became of the calls: retried, lost, unusable, or replaced by an older plan."""

from __future__ import annotations

from merge_runner.served_model import sql_of
from merge_runner.text_safety import quoted
from merge_runner_analysis.data.load import ANSWERED
from merge_runner_analysis.data.provenance import ANSWERS, Tally, tally
from merge_runner_analysis.data.study import Group, Study
from merge_runner_analysis.tables.model import GROUP_COLUMNS, Column, Row, Table, Value, row_of
from merge_runner_analysis.tables.notes import sample_notes

NO_CALLS = "no call: this driver asks no model, or its calls are not in the database"
FALLBACK = (
    "trials.trial_id IN (SELECT trial_id FROM decisions "
    "WHERE decisions.spec_hash = trials.spec_hash AND fallback)"
)


def attempts(study: Study) -> Table:
    """A row per driver and variant: trials, calls, attempts, and what went wrong with them."""
    found = {group.id: tally(study, group.stored) for group in study.played}
    # Only the reasons that occur get a column; those of ANSWERS have theirs even at zero.
    reasons = dict.fromkeys(
        reason for one in found.values() for reason in sorted(one.failures) if reason not in ANSWERS
    )
    return Table(
        "attempts",
        "What became of the calls",
        _columns(study, tuple(reasons)),
        [_row(group, found[group.id], tuple(reasons)) for group in study.played],
        (
            "a call is asked at one decision, in one or more attempts; retried: another attempt "
            "followed, of all attempts; lost: the call ended without an answer, and its trial "
            "failed, of all calls; refused, truncated, empty and invalid: of the answers; "
            "fallback: an older plan was driven, or none, of all decisions",
            "unknown: attempts that were under way when a run was killed, whose reply nobody saw; "
            "other model: answers of another model than the one asked for, by no declared alias",
            *sample_notes(study, study.played),
        ),
    )


def _columns(study: Study, reasons: tuple[str, ...]) -> list[Column]:
    headings = {"refusal": "refused"}
    parts = [
        _count("trials", "all trials, also those that failed", "true"),
        _count("failed", "trials that failed", "status = 'failed'"),
        _count("calls", "decisions at which a model was asked", _with("true")),
        _count("attempts", "HTTP attempts at these calls", _with("true")),
        *_rated("retried", "attempts that were followed by another", _with("fate = 'retried'")),
        *_rated("lost", "calls that ended without an answer", _with("fate = 'lost'")),
    ]
    for reason in ANSWERS:
        name = headings.get(reason, reason)
        parts += _rated(name, f"answers that are {name}, without a plan", _failed(reason))
    parts += [
        _count(reason, f"answers without a valid plan: {reason}", _failed(reason))
        for reason in reasons
    ]
    return [
        *GROUP_COLUMNS,
        *parts,
        *_rated(
            "invalid",
            "answers without a valid plan, for any reason",
            _with(f"fate IN {ANSWERED} AND failure IS NOT NULL"),
        ),
        *_rated("fallback", "decisions driven from an older plan, or from none", FALLBACK),
        _count("unknown", "attempts of unknown fate", _with("outcome = 'unknown'")),
        _count("other_model", "answers of another model", _other_model(study)),
    ]


def _count(name: str, meaning: str, counts: str) -> Column:
    return Column(name, name.replace("_", " "), "count", 0, meaning, counts)


def _rated(name: str, meaning: str, counts: str) -> tuple[Column, Column]:
    """A column of counts and a column of their shares."""
    return (
        _count(name, meaning, counts),
        Column(f"{name}_percent", "(%)", "percent", 2, f"share of {meaning}", counts),
    )


def _with(what: str) -> str:
    """The SQL predicate for trials that have an attempt for which ``what`` holds."""
    return (
        "trials.trial_id IN (SELECT trial_id FROM attempts "  # noqa: S608 # ours
        f"WHERE attempts.spec_hash = trials.spec_hash AND {what})"
    )


def _failed(reason: str) -> str:
    return _with(f"fate IN {ANSWERED} AND failure = {quoted(reason)}")


def _other_model(study: Study) -> str:
    return _with(f"fate IN {ANSWERED} AND {sql_of(sorted(study.calls.others))}")


def _row(group: Group, found: Tally, reasons: tuple[str, ...]) -> Row:
    values: dict[str, Value] = {
        "trials": found.trials,
        "failed": found.failed,
        "calls": found.calls,
        "attempts": found.attempts,
        **_share("retried", found.retried, found.attempts),
        # Each share has its own denominator: a call may take several attempts, and a lost call has
        # no answer that could be invalid.
        **_share("lost", found.lost, found.calls),
        **_share("refused", found.failures["refusal"], found.answers),
        **_share("truncated", found.failures["truncated"], found.answers),
        **_share("empty", found.failures["empty"], found.answers),
        **{reason: found.failures[reason] for reason in reasons},
        **_share("invalid", found.invalid, found.answers),
        **_share("fallback", found.fallbacks, found.decisions),
        "unknown": found.unknown,
        "other_model": found.others,
    }
    return row_of(group, values, _note(found))


def _share(name: str, count: int, of: int) -> dict[str, Value]:
    # No calls at all is not 0 %.
    return {name: count, f"{name}_percent": 100 * count / of if of else None}


def _note(found: Tally) -> str:
    if not found.calls:
        return NO_CALLS if found.decisions else f"{NO_CALLS}; no decision is stored"
    if not found.answers:
        return "no call was answered" + ("" if found.decisions else ", and no decision made")
    return ""
