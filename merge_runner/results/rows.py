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
_usage = attrgetter(*(field.name for field in fields(Usage)))
_SURROGATE = re.compile(r"\\u[dD][89a-fA-F]|[\ud800-\udfff]")


def rows_of(record: TrialRecord) -> dict[str, list[Row]]:
    """All rows of a trial, by table."""
    spec, condition = record.spec, CONDITIONS[record.spec.condition]
    key = (spec.trial_id, spec.spec_hash)
    trial = (
        *(*key, spec.pair, spec.source),
        *(spec.model_left, spec.model_right, spec.variant, spec.condition),
        *(condition.projected_headway_m, condition.relative_velocity_mps),
        *(spec.repetition, spec.sample_set, record.status, record.merged_first),
        *(record.end_time_s, record.error, record.scripted),
    )
    return {
        "trials": [trial],
        "trial_factors": list(factor_rows(spec)),
        "states": [(*key, *_state(row)) for row in record.states],
        "decisions": list(_decision_rows(record)),
        "calls": list(_call_rows(record)),
    }


def factor_rows(spec: TrialSpec) -> Iterator[Row]:
    """Rows of ``trial_factors``."""
    return ((spec.trial_id, spec.spec_hash, *level) for level in spec.factors)


def _decision_rows(record: TrialRecord) -> Iterator[Row]:
    for row in record.decisions:
        decision, prompt = row.decision, row.decision.prompt
        yield (
            *(record.spec.trial_id, record.spec.spec_hash, row.number, row.time_s, row.side),
            *(decision.valid, decision.failure, decision.tactical, decision.rationale),
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
    of_itself = (told.other_seen, told.own_position_m, told.own_speed_mps)
    if not told.other_seen:
        return (*of_itself, None, None, None, None)
    of_the_other = (told.relative_distance_m, told.other_speed_mps, told.other_acceleration_mps2)
    return (*of_itself, *of_the_other, list(told.other_speeds_mps))


def _call_rows(record: TrialRecord) -> Iterator[Row]:
    """Rows of ``calls``: every attempt of every call, including failed calls."""
    key = (record.spec.trial_id, record.spec.spec_hash)
    calls: list[tuple[Side, int, ChatReply | FailedCall]] = [
        (row.side, row.number, row.decision.reply) for row in record.decisions if row.decision.reply
    ]
    calls += [(call.side, call.number, call) for call in record.failed_calls]
    for side, number, call in calls:
        for attempt in call.attempts:
            cached = attempt.number <= call.earlier
            yield call_row(*key, side, number, call.request, attempt, cached=cached)


def call_row(
    trial_id: str,
    spec_hash: str,
    side: Side,
    decision: int,
    request: ChatRequest,
    attempt: Attempt,
    *,
    cached: bool,
) -> Row:
    """The row of an attempt at a decision's call."""
    return (
        *(request.key, trial_id, spec_hash, side, decision, attempt.number),
        *(request.provider, request.model, attempt.model_served, attempt.http_status),
        *(attempt.outcome, cached),
        attempt.started_at and datetime.fromisoformat(attempt.started_at).replace(tzinfo=None),
        attempt.latency_s,
        *_usage(attempt.usage),
        *(attempt.cost_usd, attempt.finish_reason, request.body, _as_json(attempt)),
        *(attempt.error, is_scripted(request, attempt), attempt.batch_id),
    )


def _as_json(attempt: Attempt) -> str | None:
    """A reply that is not JSON, such as a proxy's HTML page, becomes a JSON string.

    So does one that the database would refuse: with half of a surrogate pair, or nested deeper than
    any honest reply. An answer was read as JSON already.
    """
    text = attempt.reply
    # Most texts have nothing that needs a search for half a pair.
    plain = text is None or (text.isascii() and "\\u" not in text)
    if text is None or (attempt.answered and (plain or not _SURROGATE.search(text))):
        return text
    try:
        json.dumps(json.loads(text), ensure_ascii=False).encode()
    except (ValueError, RecursionError):
        return json.dumps(text.encode(errors="replace").decode())
    return text
