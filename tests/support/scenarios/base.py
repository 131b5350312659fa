"""A scene: what is sent in place of the ordinary answer."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import timedelta
from typing import Any, Literal

Body = Callable[[dict[str, Any]], object]
Break = Literal["hang", "reset", "truncated_body", "truncated_json"]


def answer(*without: str, **members: object) -> Body:
    """The ordinary answer with some of its members replaced."""
    return lambda usual: {k: v for k, v in (usual | members).items() if k not in without}


@dataclass(frozen=True, slots=True)
class Scene:
    """A reply in one format.

    ``body`` makes it from the ordinary answer's body; a text is sent as it is. A header that is a
    timedelta is sent as the time so far from now, in RFC 3339. The reply takes ``after_s``.
    ``breaks`` says how the connection fails instead.
    """

    body: Body = field(default_factory=answer)
    status: int = 200
    headers: Mapping[str, str | timedelta] = field(default_factory=dict)
    after_s: float = 0.0
    breaks: Break | None = None


Scenario = dict[str, Scene]
"""A scene for each format that it concerns."""


def fixed(status: int, body: object, headers: Mapping[str, str | timedelta] | None = None) -> Scene:
    """A reply that has nothing in common with an answer."""
    return Scene(lambda _: body, status, headers or {})
