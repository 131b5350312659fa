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
    ChatRequest,
    Observation,
    StateRow,
    TrialRecord,
    TrialSpec,
    is_scripted,
)
from merge_runner.scenarios.merge.conditions import CONDITIONS

Row = tuple[Any, ...]
# The fields of a state are its columns; dataclasses.astuple would copy each value.
_state = attrgetter(*(field.name for field in fields(StateRow)))
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
    spec = record.spec
    condition = CONDITIONS[spec.condition]
    return (
        spec.trial_id,
        spec.spec_hash,
        spec.pair,
        spec.source,
        spec.model_left,
        spec.model_right,
        spec.variant,
        spec.condition,
        condition.projected_headway_m,
        condition.relative_velocity_mps,
        spec.repetition,
        spec.sample_set,
        record.status,
        record.merged_first,
        record.end_time_s,
        record.error,
        record.scripted,
    )


def factor_rows(spec: TrialSpec) -> Iterator[Row]:
    """Rows of ``trial_factors``."""
    for factor, value in spec.factors:
        yield spec.trial_id, spec.spec_hash, factor, value


def state_rows(record: TrialRecord) -> Iterator[Row]:
    """Rows of ``states``."""
    key = (record.spec.trial_id, record.spec.spec_hash)
    for row in record.states:
        yield (*key, *_state(row))


def decision_rows(record: TrialRecord) -> Iterator[Row]:
    """Rows of ``decisions``."""
    for row in record.decisions:
        decision = row.decision
        prompt = decision.prompt
        yield (
            record.spec.trial_id,
            record.spec.spec_hash,
            row.number,
            row.time_s,
            row.side,
            decision.valid,
            decision.failure,
            decision.tactical,
            decision.rationale,
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
    own = (told.other_seen, told.own_position_m, told.own_speed_mps)
    if not told.other_seen:
        return (*own, None, None, None, None)
    return (
        *own,
        told.relative_distance_m,
        told.other_speed_mps,
        told.other_acceleration_mps2,
        list(told.other_speeds_mps),
    )


def call_rows(record: TrialRecord) -> Iterator[Row]:
    """Rows of ``calls``: every attempt of every call, including failed calls."""
    key = (record.spec.trial_id, record.spec.spec_hash)
    for row in record.decisions:
        reply = row.decision.reply
        if reply is not None:
            for attempt in reply.attempts:
                cached = attempt.number <= reply.earlier
                yield call_row(*key, row.side, row.number, reply.request, attempt, cached=cached)
    for failed in record.failed_calls:
        for attempt in failed.attempts:
            cached = attempt.number <= failed.earlier
            yield call_row(*key, failed.side, failed.number, failed.request, attempt, cached=cached)


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
        attempt.usage.input_tokens,
        attempt.usage.cached_input_tokens,
        attempt.usage.output_tokens,
        attempt.usage.reasoning_tokens,
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
