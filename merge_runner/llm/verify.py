"""What a recorded call must be in order to be used: it may be damaged, or made up.

The numbers of an attempt are checked as it is read, by the bounds in records.py.
"""

from __future__ import annotations

import json
from datetime import datetime
from functools import lru_cache
from typing import Any

from merge_runner.config import MOST_REPETITIONS, MOST_STEPS
from merge_runner.llm.content_hashes import call_key, canonical_json
from merge_runner.records import ANSWERS, Attempt, ChatRequest
from merge_runner.registry import NAME

# What reading content of others can raise; RecursionError where JSON is nested deeply.
DAMAGED = (ValueError, TypeError, KeyError, RecursionError)
LARGEST_STATUS = 999


def check_call(key: str, request: ChatRequest, attempts: tuple[Attempt, ...]) -> None:
    """Raise one of DAMAGED unless a call belongs to its key and its attempts are possible.

    The last attempt is the one that was answered.
    """
    slot = request.slot
    content = call_key(
        endpoint=request.endpoint,
        path=request.path,
        headers=request.headers,
        body=request.body,
        slot=slot,
    )
    if not key == request.key == content:
        raise ValueError("its content does not belong to its key")
    if not (
        NAME.fullmatch(slot.condition)
        and 1 <= slot.repetition <= MOST_REPETITIONS
        and 0 <= slot.decision <= MOST_STEPS
        and slot.sample_set >= 0
    ):
        raise ValueError("its slot is none of a study")
    numbers = [attempt.number for attempt in attempts]
    if numbers != sorted({*numbers}):
        raise ValueError("its attempts are not numbered one after the other")
    last = attempts[-1]
    if last.outcome not in ANSWERS or (last.http_status != 200 and last.outcome != "refusal"):
        raise ValueError("its last attempt is no answer")
    for attempt in attempts:
        if attempt.started_at is not None:
            datetime.fromisoformat(attempt.started_at)
        if attempt.http_status == 200 and (attempt.outcome != "bad_body" or attempt is last):
            reply_object(attempt.reply or "{}")


def check_body(body: str) -> None:
    """Raise one of DAMAGED for the body of a request that we would not send."""
    value = json.loads(body)
    if not isinstance(value, dict) or canonical_json(value) != body:
        raise ValueError("its request is not a canonical JSON object")


@lru_cache(maxsize=1)  # who checks a reply reads it next
def reply_object(text: str) -> dict[str, Any]:
    """Return the JSON object of a reply, not to be changed; raises one of DAMAGED."""
    value = json.loads(text)
    if not isinstance(value, dict):
        raise ValueError("a reply is not a JSON object")
    return value
