"""A trial's record as rows of the tables, in the order of their columns (schema.sql)."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterator
from dataclasses import fields
from datetime import datetime
from operator import attrgetter
from typing import Any

from merge_runner.records import (
    Attempt,
    ChatReply,
    ChatRequest,
    FailedCall,
    Observation,
    Side,
    StateRow,
    TrialRecord,
    TrialSpec,
    Usage,
    is_scripted,
)
from merge_runner.scenarios.merge.conditions import CONDITIONS

Row = tuple[Any, ...]
# Fields that are columns side by side; dataclasses.astuple would copy each value.
_state = attrgetter(*(field.name for field in fields(StateRow)))
_spec = attrgetter(
    "trial_id", "spec_hash", "pair", "source", "model_left", "model_right", "variant", "condition"
)
_end = attrgetter("status", "merged_first", "end_time_s", "error", "scripted")
_decision = attrgetter("valid", "failure", "tactical", "rationale")
_told_of_itself = attrgetter("other_seen", "own_position_m", "own_speed_mps")
_told_of_the_other = attrgetter("relative_distance_m", "other_speed_mps", "other_acceleration_mps2")
_usage = attrgetter(*(field.name for field in fields(Usage)))
_SURROGATE = re.compile(r"\\u[dD][89a-fA-F]|[\ud800-\udfff]")


def rows_of(record: TrialRecord) -> dict[str, list[Row]]:
    """All rows of a trial, by table."""
    return {
        "trials": [trial_row(record)],
        "trial_factors": list(factor_rows(record.spec)),
        "states": list(state_rows(record)),
        "decisions": list(decision_rows(record)),
        "calls": list(call_rows(record)),
    }


def trial_row(record: TrialRecord) -> Row:
    """The row of ``trials``."""
    spec, condition = record.spec, CONDITIONS[record.spec.condition]
    numbers = (condition.projected_headway_m, condition.relative_velocity_mps)
    return (*_spec(spec), *numbers, spec.repetition, spec.sample_set, *_end(record))


def factor_rows(spec: TrialSpec) -> Iterator[Row]:
    """Rows of ``trial_factors``."""
    return ((spec.trial_id, spec.spec_hash, *level) for level in spec.factors)


def state_rows(record: TrialRecord) -> Iterator[Row]:
    """Rows of ``states``."""
    key = (record.spec.trial_id, record.spec.spec_hash)
    return ((*key, *_state(row)) for row in record.states)


def decision_rows(record: TrialRecord) -> Iterator[Row]:
    """Rows of ``decisions``."""
    key = (record.spec.trial_id, record.spec.spec_hash)
    for row in record.decisions:
        decision = row.decision
        prompt = decision.prompt
        yield (
            *key,
            row.number,
            row.time_s,
            row.side,
            *_decision(decision),
            None if decision.plan is None else list(decision.plan),
            list(decision.applied),
            decision.fallback,
            prompt,
            None if prompt is None else hashlib.sha256(prompt.encode()).hexdigest(),
            None if decision.reply is None else decision.reply.request.key,
            *_told(row.told),
        )


def _told(told: Observation | None) -> Row:
    """What a driver was told, of the other vehicle only where it was seen; NULLs: the truth."""
    if told is None:
        return (None,) * 7
    if not told.other_seen:
        return (*_told_of_itself(told), None, None, None, None)
    return (*_told_of_itself(told), *_told_of_the_other(told), list(told.other_speeds_mps))


def call_rows(record: TrialRecord) -> Iterator[Row]:
    """Rows of ``calls``: every attempt of every call, including failed calls."""
    key = (record.spec.trial_id, record.spec.spec_hash)
    calls: list[tuple[Side, int, ChatReply | FailedCall]] = [
        (row.side, row.number, row.decision.reply) for row in record.decisions if row.decision.reply
    ]
    calls += [(failed.side, failed.number, failed) for failed in record.failed_calls]
    for side, number, call in calls:
        for attempt in call.attempts:
            cached = attempt.number <= call.earlier
            yield call_row(*key, side, number, call.request, attempt, cached=cached)


def call_row(
    trial_id: str,
    spec_hash: str,
    side: str,
    decision: int,
    request: ChatRequest,
    attempt: Attempt,
    *,
    cached: bool,
) -> Row:
    """The row of an attempt at a decision's call."""
    return (
        request.key,
        trial_id,
        spec_hash,
        side,
        decision,
        attempt.number,
        request.provider,
        request.model,
        attempt.model_served,
        attempt.http_status,
        attempt.outcome,
        cached,
        attempt.started_at and datetime.fromisoformat(attempt.started_at).replace(tzinfo=None),
        attempt.latency_s,
        *_usage(attempt.usage),
        attempt.cost_usd,
        attempt.finish_reason,
        request.body,
        _as_json(attempt),
        attempt.error,
        is_scripted(request, attempt),
        attempt.batch_id,
    )


def _as_json(attempt: Attempt) -> str | None:
    """A reply that is not JSON, such as a proxy's HTML page, becomes a JSON string.

    So does one that the database would refuse: with half of a surrogate pair, or nested deeper than
    any honest reply. An answer was read as JSON already.
    """
    text = attempt.reply
    if text is None or (attempt.answered and not _has_half_a_pair(text)):
        return text
    try:
        json.dumps(json.loads(text), ensure_ascii=False).encode()
    except (ValueError, RecursionError):
        return json.dumps(text.encode(errors="replace").decode())
    return text


def _has_half_a_pair(text: str) -> bool:
    """Whether half of a surrogate pair may be in a text; most have nothing that needs a search."""
    return not (text.isascii() and "\\u" not in text) and bool(_SURROGATE.search(text))
