"""Frozen records of trials: specs, states, decisions and failed calls."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, NamedTuple

from merge_runner.records import (
    Attempt,
    ChatReply,
    ChatRequest,
    Decision,
    Observation,
    Side,
    is_scripted,
)

if TYPE_CHECKING:
    from merge_runner.scenarios.merge.conditions import Condition

SPEC_VERSION = 2  # since then one valid array in a reply is enough
Status = Literal["finished", "collided", "timeout", "failed"]


@dataclass(frozen=True, slots=True)
class TrialSpec:
    """One trial to play, or one that humans drove.

    A trial with the source ``first_decision`` ends before its drivers decide again. ``order`` is
    its place in the sweep, lowest first. ``scripted`` is true if the emulator takes part, a mock
    model. Humans have a ``pair`` and no ``variant``. ``factors`` are the levels of the study's
    factors, including the text factors in ``words``; ``arm`` is their combination. ``focal`` is the
    ego's side if the two drivers have different texts, parameters or perceptions. ``prompts`` are
    by side if not both have the ``variant``. ``kinematics`` are the numbers of its condition.
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

    @property
    def key(self) -> tuple[str, str]:
        """The trial's key in the database: trial_id and spec_hash."""
        return self.trial_id, self.spec_hash


class StateRow(NamedTuple):
    """One vehicle at one sample; the acceleration is that realised over the step before it."""

    step: int
    time_s: float
    side: Side
    position_m: float
    velocity_mps: float
    acceleration_mps2: float


class DecisionRow(NamedTuple):
    """One decision of one driver, with its number and time in the trial.

    ``observed`` is the driver's observation under imperfect perception, None if it was noise-free.
    """

    number: int
    time_s: float
    side: Side
    decision: Decision
    observed: Observation | None = None


class FailedCall(NamedTuple):
    """Call without a reply, with the attempts of its ``CallFailed``.

    ``missed`` means that a replay had no recorded reply and made no attempt.
    """

    number: int
    side: Side
    request: ChatRequest
    attempts: tuple[Attempt, ...]
    cached_attempts: int = 0
    missed: bool = False


class TrialRecord(NamedTuple):
    """Played trial with its trace."""

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
        """Calls of both drivers."""
        replies = [row.decision.reply for row in self.decisions if row.decision.reply]
        return [*replies, *self.failed_calls]

    @property
    def scripted(self) -> bool:
        """True if a mock model drove either side or answered any call."""
        return self.spec.scripted or any(
            is_scripted(call.request, attempt) for call in self.calls for attempt in call.attempts
        )


def spec_hash(text: str) -> str:
    """Return the short hash of the canonical JSON that defines a trial."""
    return hashlib.sha256(text.encode()).hexdigest()[:16]
