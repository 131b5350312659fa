"""Frozen records that cross layers, with their hashes.

SI units; ``left`` and ``right`` are the two branches. A recorded call may be damaged or forged: it
is used only if its content matches its key.
"""

from __future__ import annotations

import hashlib
import json
import re
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime
from functools import lru_cache
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import Field, JsonValue

from merge_runner.errors import MergeRunnerError
from merge_runner.registry import NAME

KEY_VERSION = 1
# Errors of reading foreign content; RecursionError for deeply nested JSON.
DAMAGED = (ValueError, TypeError, KeyError, RecursionError)
LARGEST_STATUS = 999
_TEXT = re.compile(r'"[^"\\]*(?:\\.[^"\\]*)*"')
_CANONICAL = json.JSONEncoder(
    sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False
)
MOST_STEPS = MOST_REPETITIONS = 100_000

Side = Literal["left", "right"]
Road = Literal["merge", "straight"]
ROADS: tuple[Road, Road] = ("merge", "straight")
Tactical = Literal["M", "Y"]

# Outcomes of an attempt that count as a reply.
ANSWERS = ("ok", "refusal", "truncated", "empty")
# The ``failure`` of a decision with a valid plan but without the requested tactical decision.
NO_DECISION = "no_decision"
SIDES: tuple[Side, Side] = ("left", "right")

# Headers that pass the slot and the attempt to our own emulator, and to no other server.
SLOT_HEADER = "x-merge-runner-slot"
ATTEMPT_HEADER = "x-merge-runner-attempt"
# A mock model marks every reply: by this header, and by this field of the body.
SCRIPTED_HEADER = "x-merge-runner-scripted"
SCRIPTED_FIELD = "merge_runner_scripted"
# The field that identifies the answered request, so that swapped replies are detected: the hash of
# the request's body, and the slot if the request named one.
ANSWERED_FIELD = "merge_runner_request"

# Bounds of an attempt's values: a recorded attempt beyond them is damaged or forged.
Amount = Annotated[float, Field(ge=0, le=2**31 - 1)]
Tokens = Annotated[int, Field(ge=0, le=2**33)]

FAR_BEHIND_M = 1000.0
"""Distance behind the ego at which an unseen vehicle is placed (``Observation``)."""


def other_side(side: Side) -> Side:
    """Return the opposite side."""
    return "right" if side == "left" else "left"


@dataclass(frozen=True, slots=True)
class Slot:
    """Position of a sample in a sweep: different slots never share a sample by accident.

    ``decision`` counts from 0 within a trial, ``repetition`` from 1, ``sample_set`` from 0.
    """

    condition: Annotated[str, Field(pattern=f"^{NAME.pattern}$")]
    repetition: Annotated[int, Field(ge=1, le=MOST_REPETITIONS)]
    side: Side
    decision: Annotated[int, Field(ge=0, le=MOST_STEPS)]
    sample_set: Annotated[int, Field(ge=0)]

    def __str__(self) -> str:
        """Return the slot as text."""
        return f"{self.condition} rep {self.repetition} {self.side}, decision {self.decision}"

    def as_dict(self) -> dict[str, str | int]:
        """Return the slot as JSON values, sorted by name."""
        return {
            "condition": self.condition,
            "decision": self.decision,
            "repetition": self.repetition,
            "sample_set": self.sample_set,
            "side": self.side,
        }


@dataclass(frozen=True, slots=True)
class Observation:
    """Observation of one driver at a decision step; ``own`` is the ego vehicle.

    ``relative_distance_m`` is the other's travelled distance minus the ego's: positive while the
    other is ahead. ``distance_to_merge_m`` is None on the straight road. The histories are oldest
    first, one value per simulation step: the accelerations that the ego executed, and the other's
    observed speeds before now. ``own_position_m`` is measured along the ego's branch;
    ``other_acceleration_mps2`` is the other's over the last step, 0 before the first step. Only
    programs use these two; no prompt contains them. ``other_seen`` is false while the other is out
    of sight: prompts say so and its history is empty. For a program that ignores the field, the
    other is then FAR_BEHIND_M behind the ego and as fast, where it cannot matter.
    """

    road: Road
    own_speed_mps: float
    other_speed_mps: float
    relative_distance_m: float
    distance_to_merge_m: float | None
    own_accelerations_mps2: tuple[float, ...]
    other_speeds_mps: tuple[float, ...]
    own_position_m: float
    other_acceleration_mps2: float
    other_seen: bool = True


@dataclass(frozen=True, slots=True)
class Usage:
    """Tokens of one attempt; input includes cached tokens, output includes reasoning tokens."""

    input_tokens: Tokens | None = None
    cached_input_tokens: Tokens | None = None
    output_tokens: Tokens | None = None
    reasoning_tokens: Tokens | None = None


@dataclass(frozen=True, slots=True)
class Attempt:
    """One HTTP attempt at a call.

    ``outcome`` is ``ok``, ``refusal``, ``truncated`` or ``empty`` for a reply, ``unknown`` if the
    run was killed before the reply, else the name of the failure. ``reply`` is the body as
    received, None without one. ``started_at`` is UTC in ISO 8601. ``scripted`` is true if a mock
    model answered. ``batch_id`` is the provider's batch of the request, None for a request of its
    own; a request in a batch has no latency.
    """

    number: Annotated[int, Field(ge=1, le=2**31 - 1)]
    outcome: Annotated[str, Field(pattern="^[a-z][a-z0-9_]{0,39}$")]
    http_status: Annotated[int | None, Field(ge=0, le=999)] = None
    model_served: str | None = None
    finish_reason: str | None = None
    usage: Usage = field(default_factory=Usage)
    latency_s: Amount | None = None
    started_at: str | None = None
    reply: str | None = None
    error: str | None = None
    cost_usd: Amount | None = None
    scripted: bool = False
    # Left out if None, so that the stored JSON of attempts without a batch does not change.
    batch_id: Annotated[str | None, Field(exclude_if=lambda value: value is None)] = None


@dataclass(frozen=True, slots=True)
class ChatRequest:
    """One request, as it is hashed and sent.

    ``headers`` are those that change the meaning of the request, never a secret. ``body`` is
    canonical JSON: the hashed bytes are the bytes that are sent. ``model`` is the requested id; it
    and ``provider`` are labels and not part of the hash.
    """

    key: str
    provider: str
    endpoint: str
    model: str
    path: str
    headers: dict[str, str]
    body: str
    slot: Slot


class CallFailed(MergeRunnerError):
    """A call ended without a reply.

    The first ``cached_attempts`` were made before this run, or for another trial of it.
    """

    def __init__(
        self,
        message: str,
        request: ChatRequest,
        attempts: tuple[Attempt, ...] = (),
        cached_attempts: int = 0,
    ) -> None:
        super().__init__(message)
        self.request, self.attempts, self.cached_attempts = request, attempts, cached_attempts


class ReplayMiss(CallFailed):
    """A replay needs a reply that is not recorded."""

    exit_code = 4


class ChatReply(NamedTuple):
    """Reply to a call: text, outcome and all attempts, the answered one last.

    The first ``cached_attempts`` were made before this run, or for another trial of it.
    """

    text: str
    outcome: str
    request: ChatRequest
    attempts: tuple[Attempt, ...]
    cached_attempts: int


@dataclass(frozen=True, slots=True)
class Decision:
    """Decision of a driver at one decision step.

    ``plan`` holds the normalised accelerations of a valid decision over the whole horizon, None if
    it was invalid; ``applied`` those to execute now. With ``fallback``, ``applied`` comes from an
    older plan, or is 0 without one. ``failure`` is the reason why a decision is invalid;
    ``no_decision`` means that the plan is valid but the requested tactical decision is missing.
    """

    plan: tuple[float, ...] | None
    applied: tuple[float, ...]
    tactical: Tactical | None = None
    rationale: str | None = None
    failure: str | None = None
    fallback: bool = False
    prompt: str | None = None
    reply: ChatReply | None = None

    @property
    def valid(self) -> bool:
        """True if the plan satisfies the schema."""
        return self.plan is not None


def is_scripted(request: ChatRequest, attempt: Attempt) -> bool:
    """Return whether a mock model answered, whatever base URL or model name was used.

    The body says so even if a recording lost the header.
    """
    return attempt.scripted or request.provider == "emulator" or says_scripted(attempt.reply or "")


def says_scripted(body: str) -> bool:
    """Return whether the body has the field at its top level; a model's text does not count."""
    if SCRIPTED_FIELD in body:
        with suppress(ValueError, RecursionError):
            payload = json.loads(body)
            parts = payload if isinstance(payload, list) else [payload]
            return any(isinstance(part, dict) and SCRIPTED_FIELD in part for part in parts)
    return False


def canonical_json(value: object) -> str:
    """Return a JSON value as canonical text: sorted keys, no spaces; raises ValueError for NaN."""
    return _CANONICAL.encode(value)


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
    """Return the key of a reply: the SHA-256 of a canonical JSON object of all its parts.

    The parts are the key version, the endpoint's identity, the path, the headers that change the
    meaning of the request, its canonical ``body``, and the slot.
    """
    parts = {"endpoint": endpoint, "headers": headers, "key_version": KEY_VERSION, "path": path}
    # "body" sorts before the other names, so that the whole is canonical.
    text = f'{{"body":{body},{canonical_json(parts | {"slot": slot.as_dict()})[1:]}'
    return hashlib.sha256(text.encode()).hexdigest()


def without_prompt(body: str) -> str:
    """Return a canonical body without its longest string, which is the prompt."""
    return body.replace(max(_TEXT.findall(body), key=len, default='""'), '""')


def check_call(
    key: str,
    request: ChatRequest,
    attempts: tuple[Attempt, ...],
    expected: ChatRequest | None = None,
) -> None:
    """Raise one of DAMAGED unless a call matches its key and its attempts are possible.

    The last attempt is the answered one. A request equal to the ``expected`` one is not hashed.
    """
    if request != expected:
        content = call_key(
            endpoint=request.endpoint,
            path=request.path,
            headers=request.headers,
            body=request.body,
            slot=request.slot,
        )
        if not key == request.key == content:
            raise ValueError("its content does not belong to its key")
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
    """Raise one of DAMAGED unless a request's body is a canonical JSON object."""
    value = json.loads(body)
    if not isinstance(value, dict) or canonical_json(value) != body:
        raise ValueError("its request is not a canonical JSON object")


@lru_cache(maxsize=1)  # a reply is read right after its check
def reply_object(text: str) -> dict[str, Any]:
    """Return the JSON object of a reply, shared and read only; raises one of DAMAGED."""
    value = json.loads(text)
    if not isinstance(value, dict):
        raise ValueError("a reply is not a JSON object")
    return value
