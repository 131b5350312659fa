"""The hashes under which a reply and the definition of a trial are known.

The key of a reply covers the key version, the endpoint's identity, the path, the headers that
change the meaning of a request, its exact body and the slot. All stand in one canonical JSON
object, so no two of them can run into each other.

A recorded call may be damaged, or made up: it is used only if its content belongs to its key. The
numbers of its attempts are checked as they are read, by the bounds in records.py.
"""

from __future__ import annotations

import hashlib
import json
import re
from datetime import datetime
from functools import lru_cache
from typing import Any

from pydantic import JsonValue

from merge_runner.config import MOST_REPETITIONS, MOST_STEPS
from merge_runner.records import ANSWERS, Attempt, ChatRequest, Slot
from merge_runner.registry import NAME

KEY_VERSION = 1
SPEC_VERSION = 2  # since then one valid array in a reply is enough
# What reading content of others can raise; RecursionError where JSON is nested deeply.
DAMAGED = (ValueError, TypeError, KeyError, RecursionError)
LARGEST_STATUS = 999
_TEXT = re.compile(r'"[^"\\]*(?:\\.[^"\\]*)*"')
_CANONICAL = json.JSONEncoder(
    sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False
)


def canonical_json(value: object) -> str:
    """Return the one spelling of a JSON value: sorted keys, no spaces; NaN raises ValueError."""
    return _CANONICAL.encode(value)


def spec_hash(text: str) -> str:
    """Return the short hash of the canonical JSON that defines a trial."""
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def make_request(
    *,
    provider: str,
    endpoint: str,
    model: str,
    path: str,
    headers: dict[str, str],
    body: dict[str, JsonValue],
    slot: Slot,
) -> ChatRequest:
    """Return a request with its key."""
    text = canonical_json(body)
    key = call_key(endpoint=endpoint, path=path, headers=headers, body=text, slot=slot)
    return ChatRequest(key, provider, endpoint, model, path, headers, text, slot)


def call_key(*, endpoint: str, path: str, headers: dict[str, str], body: str, slot: Slot) -> str:
    """Return the SHA-256 of the canonical JSON of all parts; ``body`` is canonical already."""
    # "body" sorts before the other names and "slot" after them, so that the whole is canonical.
    parts = {"endpoint": endpoint, "headers": headers, "key_version": KEY_VERSION, "path": path}
    between = canonical_json(parts)[1:-1]
    text = f'{{"body":{body},{between},"slot":{canonical_json(slot.as_dict())}}}'
    return hashlib.sha256(text.encode()).hexdigest()


def without_prompt(body: str) -> str:
    """Return a canonical body without its longest text, which is the prompt."""
    return body.replace(max(_TEXT.findall(body), key=len, default='""'), '""')


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
