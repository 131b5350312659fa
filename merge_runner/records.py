"""Frozen records that cross layers, and the hashes under which they are known.

SI units; ``left`` and ``right`` are the two branches. A recorded call may be damaged, or made up:
it is used only if its content belongs to its key.
"""

from __future__ import annotations

import hashlib
import json
import re
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime
from functools import lru_cache
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field, JsonValue

from merge_runner.errors import MergeRunnerError
from merge_runner.registry import NAME

if TYPE_CHECKING:
    from merge_runner.scenarios.merge.conditions import Condition

KEY_VERSION = 1
SPEC_VERSION = 2  # since then one valid array in a reply is enough
# What reading content of others can raise; RecursionError where JSON is nested deeply.
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
Status = Literal["finished", "collided", "timeout", "failed"]

# The outcomes of an attempt that are answers.
ANSWERS = ("ok", "refusal", "truncated", "empty")
# The ``failure`` of a decision with a valid plan and without the tactical decision asked for.
NO_DECISION = "no_decision"
SIDES: tuple[Side, Side] = ("left", "right")

# Headers that tell the slot and the attempt to our own emulator, and to nobody else.
SLOT_HEADER = "x-merge-runner-slot"
ATTEMPT_HEADER = "x-merge-runner-attempt"
# A scripted stand-in says what it is in every reply: by this header, and by this field of the body.
SCRIPTED_HEADER = "x-merge-runner-scripted"
SCRIPTED_FIELD = "merge_runner_scripted"
# By this field it says what it answers, so that a swapped answer is noticed: the hash of the
# request's body, and the slot if the request named one.
ANSWERED_FIELD = "merge_runner_request"

# What an attempt can have: a recorded one with other values is damaged, or made up.
Amount = Annotated[float, Field(ge=0, le=2**31 - 1)]
Tokens = Annotated[int, Field(ge=0, le=2**33)]

FAR_BEHIND_M = 1000.0
"""Where the other vehicle is put while it is not seen; see Observation."""


def other_side(side: Side) -> Side:
    """The side across the road."""
    return "right" if side == "left" else "left"


@dataclass(frozen=True, slots=True)
class Slot:
    """Where in a sweep a sample stands: two slots never share a sample by accident.

    ``decision`` counts from 0 within a trial, ``repetition`` from 1, ``sample_set`` from 0.
    """

    condition: Annotated[str, Field(pattern=f"^{NAME.pattern}$")]
    repetition: Annotated[int, Field(ge=1, le=MOST_REPETITIONS)]
    side: Side
    decision: Annotated[int, Field(ge=0, le=MOST_STEPS)]
    sample_set: Annotated[int, Field(ge=0)]

    def __str__(self) -> str:
        """The slot for a reader."""
        return f"{self.condition} rep {self.repetition} {self.side}, decision {self.decision}"

    def as_dict(self) -> dict[str, str | int]:
        """The slot as plain JSON values, by their names' order."""
        return {
            "condition": self.condition,
            "decision": self.decision,
            "repetition": self.repetition,
            "sample_set": self.sample_set,
            "side": self.side,
        }


@dataclass(frozen=True, slots=True)
class Observation:
    """What one driver sees at a decision instant; ``own`` is the ego vehicle.

    ``relative_distance_m`` is the other's travelled distance minus the own one, so that it is
    positive while the other is ahead. ``distance_to_merge_m`` is None on the straight road.
    The histories are oldest first, one value per simulation step: the accelerations that the own
    vehicle executed, and the speeds at which the other was seen before now. ``own_position_m`` is
    travelled along the own branch; ``other_acceleration_mps2`` is what the other executed over the
    last step, 0 before the first. Programs see these two; no prompt tells them.
    ``other_seen`` is false while the other is out of sight: prompts say so, its history is empty,
    and a program that does not ask finds a car that cannot matter, FAR_BEHIND_M behind it and as
    fast as itself.
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
    """Tokens of one attempt; ``input`` includes the cached ones, ``output`` the reasoning ones."""

    input_tokens: Tokens | None = None
    cached_input_tokens: Tokens | None = None
    output_tokens: Tokens | None = None
    reasoning_tokens: Tokens | None = None


@dataclass(frozen=True, slots=True)
class Attempt:
    """One HTTP attempt at a call.

    ``outcome`` is ``ok``, ``refusal``, ``truncated`` or ``empty`` for an answer, ``unknown`` where
    nobody knows what became of the attempt, else the named reason of the failure. ``reply`` is
    the body as received, None if there was none.
    ``started_at`` is UTC in ISO 8601. ``scripted`` says that a scripted stand-in answered.
    ``batch_id`` names the provider's batch that the request was a line of; None: it was sent alone.
    A line has no latency.
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
    # Left out where there is none, so that what is kept of other attempts stays as it was.
    batch_id: Annotated[str | None, Field(exclude_if=lambda value: value is None)] = None


@dataclass(frozen=True, slots=True)
class ChatRequest:
    """One request as it is hashed and sent.

    ``headers`` are those that change the meaning of the request, never a secret. ``body`` is
    canonical JSON: the bytes that are hashed are the bytes that are sent. ``model`` is the id
    asked for; it and ``provider`` are labels, and not hashed by themselves.
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
    """A call ended without an answer.

    ``attempts`` holds what was tried, the first ``earlier`` times by earlier runs.
    """

    def __init__(
        self,
        message: str,
        request: ChatRequest,
        attempts: tuple[Attempt, ...] = (),
        earlier: int = 0,
    ) -> None:
        super().__init__(message)
        self.request, self.attempts, self.earlier = request, attempts, earlier


class ReplayMiss(CallFailed):
    """A sealed replay needs a reply that is not recorded."""

    exit_code = 4


@dataclass(frozen=True, slots=True)
class ChatReply:
    """The answer to a call: its text and outcome, and every attempt, the answering one last.

    The first ``earlier`` attempts were made before this run, or for another trial of it.
    """

    text: str
    outcome: str
    request: ChatRequest
    attempts: tuple[Attempt, ...]
    earlier: int

    @property
    def cached(self) -> bool:
        """Whether the whole call was there already."""
        return self.earlier == len(self.attempts)


@dataclass(frozen=True, slots=True)
class Decision:
    """What a driver decided at one instant.

    ``plan`` holds the normalised accelerations of a valid decision over the whole horizon, None
    where it was invalid; ``applied`` the ones to execute now. ``fallback`` says that ``applied``
    comes from an older plan, or is 0 because there is none. ``failure`` names why a decision is
    invalid; ``no_decision`` says that a valid one lacks the tactical decision asked for.
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
        """Whether the driver gave a plan that satisfies the schema."""
        return self.plan is not None


@dataclass(frozen=True, slots=True)
class TrialSpec:
    """One trial to play, or one that humans drove.

    A trial of the source ``first_decision`` ends before its drivers decide again.
    ``order`` is its place in the sweep: lower goes first. ``scripted`` says that the emulator
    takes part, a stand-in and no language model. Humans have a ``pair`` and no ``variant``.
    ``factors`` are the levels of the study's factors, those of ``words`` among them, ``arm`` names
    their crossing. ``focal`` is the side of the ego where the two drivers are given different
    things, and ``prompts`` are by side where not both are of the ``variant``. ``kinematics`` are
    what its condition's name stands for.
    """

    trial_id: str
    spec_hash: str
    source: Literal["llm", "driver", "human", "first_decision"]
    model_left: str
    model_right: str
    variant: str | None
    condition: str
    repetition: int
    sample_set: int
    order: int
    scripted: bool = False
    pair: str | None = None
    factors: tuple[tuple[str, str], ...] = ()
    words: frozenset[str] = frozenset()
    arm: str = ""
    focal: Side | None = None
    prompts: dict[Side, str] = field(default_factory=dict)
    kinematics: Condition = field(kw_only=True)


@dataclass(frozen=True, slots=True)
class StateRow:
    """One vehicle at one sample; the acceleration is the one realised over the step before it."""

    step: int
    time_s: float
    side: Side
    position_m: float
    velocity_mps: float
    acceleration_mps2: float


@dataclass(frozen=True, slots=True)
class DecisionRow:
    """One decision of one driver, at its number and time in the trial.

    ``told`` is what the driver was told where its perception is imperfect, None: the truth.
    """

    number: int
    time_s: float
    side: Side
    decision: Decision
    told: Observation | None = None


@dataclass(frozen=True, slots=True)
class FailedCall:
    """A call without an answer, and what was tried, the first ``earlier`` times by earlier runs.

    ``missed`` says that a replay found no reply to it, and did not try.
    """

    number: int
    side: Side
    request: ChatRequest
    attempts: tuple[Attempt, ...]
    earlier: int = 0
    missed: bool = False


@dataclass(frozen=True, slots=True)
class TrialRecord:
    """A played trial with its whole trace."""

    spec: TrialSpec
    status: Status
    merged_first: Side | None
    end_time_s: float
    error: str | None
    states: tuple[StateRow, ...]
    decisions: tuple[DecisionRow, ...]
    failed_calls: tuple[FailedCall, ...] = ()

    @property
    def calls(self) -> list[ChatReply | FailedCall]:
        """All calls of its drivers."""
        replies = [row.decision.reply for row in self.decisions if row.decision.reply]
        return [*replies, *self.failed_calls]

    @property
    def scripted(self) -> bool:
        """Whether a scripted stand-in drove on a side, or answered any call."""
        return self.spec.scripted or any(
            is_scripted(call.request, attempt) for call in self.calls for attempt in call.attempts
        )


def is_scripted(request: ChatRequest, attempt: Attempt) -> bool:
    """Whether a scripted stand-in answered, whatever base URL or model name was used.

    The body says so even where a recording has lost the header.
    """
    return attempt.scripted or request.provider == "emulator" or says_scripted(attempt.reply or "")


def says_scripted(body: str) -> bool:
    """Whether a body has the field at its top; what a model writes in its answer is no field."""
    if SCRIPTED_FIELD in body:
        with suppress(ValueError, RecursionError):
            payload = json.loads(body)
            parts = payload if isinstance(payload, list) else [payload]
            return any(isinstance(part, dict) and SCRIPTED_FIELD in part for part in parts)
    return False


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
    """Return the key of a reply: the SHA-256 of one canonical JSON object of all parts.

    These are the key version, the endpoint's identity, the path, the headers that change the
    meaning of a request, its exact ``body``, canonical already, and the slot.
    """
    # "body" sorts before the other names and "slot" after them, so that the whole is canonical.
    parts = {"endpoint": endpoint, "headers": headers, "key_version": KEY_VERSION, "path": path}
    between = canonical_json(parts)[1:-1]
    text = f'{{"body":{body},{between},"slot":{canonical_json(slot.as_dict())}}}'
    return hashlib.sha256(text.encode()).hexdigest()


def without_prompt(body: str) -> str:
    """Return a canonical body without its longest text, which is the prompt."""
    return body.replace(max(_TEXT.findall(body), key=len, default='""'), '""')


def check_call(
    key: str,
    request: ChatRequest,
    attempts: tuple[Attempt, ...],
    asked: ChatRequest | None = None,
) -> None:
    """Raise one of DAMAGED unless a call belongs to its key and its attempts are possible.

    The last attempt is the one that was answered. A request equal to the one that is ``asked``
    needs no key of its own.
    """
    if request != asked:
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
