"""What a recorded call must be in order to be used: it may be damaged, or made up."""

from __future__ import annotations

import json
import re
from datetime import datetime
from functools import lru_cache
from typing import Any

from merge_runner.config import MOST_REPETITIONS, MOST_STEPS
from merge_runner.llm.content_hashes import call_key, canonical_json
from merge_runner.records import ANSWERS, Attempt, ChatRequest
from merge_runner.registry import NAME

# What reading content of others can raise; RecursionError where JSON is nested deeply.
DAMAGED = (ValueError, TypeError, KeyError, RecursionError)
LARGEST_NUMBER = 2**31 - 1
LARGEST_STATUS = 999
# The name of an answer or of a failure, as the client and the wire formats give it.
OUTCOME = re.compile(r"[a-z][a-z0-9_]{0,39}")
MOST_TOKENS = 2**33


def check_call(key: str, request: ChatRequest, attempts: tuple[Attempt, ...]) -> None:
    """Raise one of DAMAGED unless a call belongs to its key and its attempts are possible."""
    content = call_key(
        endpoint=request.endpoint,
        path=request.path,
        headers=request.headers,
        body=request.body,
        slot=request.slot,
    )
    if not key == request.key == content:
        raise ValueError("its content does not belong to its key")
    slot = request.slot
    if not (
        NAME.fullmatch(slot.condition)
        and 1 <= slot.repetition <= MOST_REPETITIONS
        and 0 <= slot.decision <= MOST_STEPS
        and slot.sample_set >= 0
    ):
        raise ValueError("its slot is none of a study")
    _check_attempts(attempts)


def check_body(body: str) -> None:
    """Raise one of DAMAGED for the body of a request that we would not send."""
    value = json.loads(body)
    if not isinstance(value, dict) or canonical_json(value) != body:
        raise ValueError("its request is not a canonical JSON object")


def _check_attempts(attempts: tuple[Attempt, ...]) -> None:
    """Raise one of DAMAGED for values that no attempt has, and no replay or table can take.

    The last attempt is the one that was answered.
    """
    numbers = [attempt.number for attempt in attempts]
    if numbers != sorted({*numbers}) or 0 in numbers:
        raise ValueError("its attempts are not numbered one after the other")
    for last in attempts[-1:]:
        if last.outcome not in ANSWERS or (last.http_status != 200 and last.outcome != "refusal"):
            raise ValueError("its last attempt is no answer")
    for attempt in attempts:
        _check_numbers(attempt)
        if not OUTCOME.fullmatch(attempt.outcome):
            raise ValueError("an attempt has an outcome that no attempt can have")
        if attempt.started_at is not None:
            datetime.fromisoformat(attempt.started_at)
        is_answer = attempt.outcome != "bad_body" or attempt is attempts[-1]
        if attempt.http_status == 200 and is_answer:
            reply_object(attempt.reply or "{}")


@lru_cache(maxsize=1)  # who checks a reply reads it next
def reply_object(text: str) -> dict[str, Any]:
    """Return the JSON object of a reply, not to be changed; raises one of DAMAGED."""
    value = json.loads(text)
    if not isinstance(value, dict):
        raise ValueError("a reply is not a JSON object")
    return value


def _check_numbers(attempt: Attempt) -> None:
    usage = attempt.usage
    numbers = (attempt.number, attempt.latency_s, attempt.cost_usd)
    tokens = (usage.input_tokens, usage.cached_input_tokens, usage.output_tokens)
    for most, counts in (
        (LARGEST_STATUS, (attempt.http_status,)),
        (LARGEST_NUMBER, numbers),
        (MOST_TOKENS, (*tokens, usage.reasoning_tokens)),
    ):
        for count in counts:
            if count is not None and not 0 <= count <= most:
                raise ValueError("an attempt has a number that no attempt can have")
