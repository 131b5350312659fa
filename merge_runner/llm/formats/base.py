"""What every wire format offers, and how to read JSON that servers send in many shapes."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Protocol

from pydantic import JsonValue

from merge_runner.config import ModelEntry
from merge_runner.records import Usage

MOST_TOKENS = 2**31 - 1


@dataclass(frozen=True, slots=True)
class WireRequest:
    """A request without its secret: ``headers`` are those that change its meaning."""

    path: str
    body: dict[str, JsonValue]
    headers: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Reading:
    """What a JSON body of status 200 says.

    ``outcome`` is ``ok``, ``refusal``, ``truncated``, ``empty``, or ``error`` where the body
    reports a failure after all. ``finish_reason`` is the provider's own word.
    """

    outcome: str
    text: str = ""
    finish_reason: str | None = None
    model_served: str | None = None
    usage: Usage = field(default_factory=Usage)


class WireFormat(Protocol):
    """One provider's request and reply."""

    retries_empty: bool
    """Whether an empty answer is a known fault of the service that asking again may mend."""

    members: frozenset[str]
    """Those of which an answer has one, whatever it says."""

    def request(self, entry: ModelEntry, prompt: str) -> WireRequest:
        """The request for a prompt."""
        ...

    def read(self, payload: dict[str, Any]) -> Reading:
        """Read a body of status 200; unknown keys and missing ones are normal."""
        ...


@dataclass(frozen=True, slots=True)
class ErrorInfo:
    """An error body in one shape: servers send nested, flat, listed and string errors."""

    message: str
    names: frozenset[str]
    details: tuple[dict[str, Any], ...]


def is_answer(payload: dict[str, Any], members: frozenset[str]) -> bool:
    """Whether a body of status 200 has anything of an answer: an empty one has its frame."""
    return any(payload.get(name) not in (None, [], {}) for name in members)


def outcome_of(text: str, *, truncated: bool, refused: bool) -> str:
    """The outcome of an answer, from its text and what its finish reason means."""
    if refused:
        return "refusal"
    if truncated:
        return "truncated"
    return "ok" if text.strip() else "empty"


def as_dict(value: object) -> dict[str, Any]:
    """A JSON object, or an empty one where the server sent something else."""
    return value if isinstance(value, dict) else {}


def as_list(value: object) -> list[Any]:
    """A JSON array, or an empty one where the server sent something else."""
    return value if isinstance(value, list) else []


def as_text(value: object) -> str | None:
    """A JSON string, or None where the server sent something else.

    JSON can spell half of a surrogate pair, which no file can hold: a "?" takes its place.
    """
    if not isinstance(value, str):
        return None
    return value if value.isascii() else value.encode(errors="replace").decode()


def as_count(value: object) -> int | None:
    """A token count, or None where it is absent or cannot be one; some servers write 9.0."""
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    return value if type(value) is int and 0 <= value <= MOST_TOKENS else None


def total(*counts: int | None) -> int | None:
    """The sum of the counts that are there; None where none is."""
    known = [count for count in counts if count is not None]
    return sum(known) if known else None


def error_info(payload: object, body: str) -> ErrorInfo:
    """Read an error body of any known shape; the text itself serves where it is no JSON."""
    top = as_dict(payload)
    nested = top.get("error")
    if nested is None:
        choice = as_dict(next(iter(as_list(top.get("choices"))), None))
        nested = choice.get("error")
    error = as_dict(nested) or ({"message": nested} if isinstance(nested, str) else top)
    details = error.get("details")
    listed = [as_dict(detail) for detail in as_list(details)] or [as_dict(details)]
    names = {
        str(name)
        for name in (
            error.get("type"),
            error.get("code"),
            error.get("status"),
            *(detail.get("error_code") for detail in listed),
            *(detail.get("reason") for detail in listed),
        )
        if name is not None
    }
    # It reaches a user as one line; Gemini's has several.
    message = " ".join((as_text(error.get("message")) or body[:200]).split())
    return ErrorInfo(message, frozenset(names), tuple(listed))
