"""What a wire format is, and how to read JSON that servers send in many shapes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

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


@dataclass(frozen=True, slots=True)
class ServerError:
    """An error in one shape: servers send nested, flat, listed and string errors.

    ``status`` is that of the reply, or the one that an error within a 200 stands for. ``names``
    are its type, its code, its status in words and the reasons among its ``details``.
    """

    status: int
    headers: Mapping[str, str]
    body: str
    message: str
    names: frozenset[str]
    details: tuple[dict[str, Any], ...]


class WireFormat(ABC):
    """One format of requests and replies, with all that is particular to it.

    What a format says of errors may be asked of a reply in any format, since gateways pass on the
    errors of others. None leaves a question to the rules for all servers (http_outcome.py).
    """

    parameters: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    """Parameters that a study may vary, by common names: where each stands in an entry's own."""
    members: ClassVar[frozenset[str]]
    """Members of a body: an answer has at least one of them, whatever it says."""
    headers: ClassVar[Mapping[str, str]] = {}
    """Headers that every request to a batch mode has, since they change its meaning."""
    retries_empty: ClassVar[bool] = False
    """Whether an empty answer is a known fault of the service that asking again may mend."""

    @abstractmethod
    def request(self, entry: ModelEntry, prompt: str) -> WireRequest:
        """Return the request for a prompt."""

    @abstractmethod
    def read(self, payload: dict[str, Any]) -> Reading:
        """Read a body of status 200; unknown keys and missing ones are normal."""

    def meaning(self, error: ServerError) -> str | None:
        """Return the meaning of an error whose status does not tell it.

        It is ``refusal``, ``quota_exhausted``, ``unknown_model``, ``not_allowed``,
        ``rate_limited`` or ``request_too_large``, as in the table of calls, or ``bad_prompt``,
        which speaks of one prompt alone.
        """
        return None

    def delay_s(self, error: ServerError) -> float | None:
        """Return the delay in s in a member of the error; its words are read for every format."""
        return None


def outcome_of(
    text: str, *, failed: object = False, truncated: bool = False, refused: bool = False
) -> str:
    """Return the outcome of an answer, from its text and what its finish reason means.

    ``failed`` is what the body reports as an error, where it does.
    """
    outcomes = {
        "error": failed,
        "refusal": refused,
        "truncated": truncated,
        "empty": not text.strip(),
    }
    return next((outcome for outcome, is_so in outcomes.items() if is_so), "ok")


def at(value: object, path: str) -> Any:  # noqa: ANN401 # whatever JSON holds there
    """Return the JSON at a path such as ``choices.0.message``, None where there is none."""
    for name in path.split("."):
        if isinstance(value, list):
            value = next(iter(value), None) if name == "0" else None
        else:
            value = as_dict(value).get(name)
    return value


def as_dict(value: object) -> dict[str, Any]:
    """Return a JSON object, or an empty one for anything else."""
    return value if isinstance(value, dict) else {}


def as_dicts(value: object) -> list[dict[str, Any]]:
    """Return the objects of a JSON array; anything else counts as an empty one."""
    return [as_dict(item) for item in value] if isinstance(value, list) else []


def joined(parts: Iterable[dict[str, Any]], member: str = "text") -> str:
    """Return the text of all parts of an answer that have some."""
    return "".join(as_text(part.get(member)) or "" for part in parts)


def as_text(value: object) -> str | None:
    """Return a JSON string, or None for anything else.

    JSON can spell half of a surrogate pair, which no file can hold: a "?" takes its place.
    """
    if not isinstance(value, str):
        return None
    return value if value.isascii() else value.encode(errors="replace").decode()


def as_count(value: object) -> int | None:
    """Return a token count, or None for what cannot be one; some servers write 9.0."""
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    return value if type(value) is int and 0 <= value <= MOST_TOKENS else None


def read_error(status: int, headers: Mapping[str, str], body: str, payload: object) -> ServerError:
    """Read an error body of any known shape; one that is no JSON is its own message."""
    top = as_dict(payload)
    nested = top.get("error") if top.get("error") is not None else at(top, "choices.0.error")
    error = as_dict(nested) or ({"message": nested} if isinstance(nested, str) else top)
    details = as_dicts(error.get("details")) or [as_dict(error.get("details"))]
    names = [error.get(name) for name in ("type", "code", "status")]
    names += [detail.get(name) for detail in details for name in ("error_code", "reason")]
    # It reaches a user as one line; Gemini's has several.
    message = " ".join((as_text(error.get("message")) or body[:200]).split())
    known = frozenset(str(name) for name in names if name is not None)
    return ServerError(status, headers, body, message, known, tuple(details))
