"""Anthropic: stop reasons, and errors that say when to come back."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import timedelta
from typing import Any

from tests.support.scenarios.base import Scenario, Scene, answer, fixed


def _error(
    status: int,
    kind: str,
    message: str,
    details: Mapping[str, str] | None = None,
    headers: Mapping[str, str | timedelta] | None = None,
) -> Scene:
    error = {"type": kind, "message": message} | ({"details": details} if details else {})
    return fixed(status, {"type": "error", "error": error, "request_id": "req_emulated"}, headers)


def _think_first(usual: dict[str, Any]) -> object:
    thinking = {"type": "thinking", "thinking": "I could do [0.1, 0.2] first.", "signature": "x"}
    return {**usual, "content": [thinking, *usual["content"]]}


def _limit(kind: str, *, limit: str, remaining: str, reset_s: float) -> dict[str, str | timedelta]:
    prefix = f"anthropic-ratelimit-{kind}"
    return {
        f"{prefix}-limit": limit,
        f"{prefix}-remaining": remaining,
        f"{prefix}-reset": timedelta(seconds=reset_s),
    }


SCENES: dict[str, Scene] = {
    "ok": Scene(),
    "thinking_first": Scene(_think_first),
    "max_tokens": Scene(answer(content=[], stop_reason="max_tokens")),
    "refusal": Scene(
        answer(
            content=[],
            stop_reason="refusal",
            stop_details={"type": "refusal", "category": "cyber", "explanation": None},
        )
    ),
    # Under version 2026-10-21 of the API, whatever the value; its words are not documented.
    "temperature": _error(400, "invalid_request_error", "temperature: not supported"),
    "no_max_tokens": _error(400, "invalid_request_error", "max_tokens: Field required"),
    "no_version": _error(400, "invalid_request_error", "anthropic-version: header is required"),
    "rate_limit": _error(
        429,
        "rate_limit_error",
        "This request would exceed your organization's rate limit.",
        headers={
            **_limit("requests", limit="50", remaining="49", reset_s=300),
            **_limit("output-tokens", limit="8000", remaining="0", reset_s=42),
        },
    ),
    "spend_limit": _error(
        429,
        "rate_limit_error",
        "You have reached your specified workspace usage limits.",
        {"error_code": "enforced_spend_limit_reached"},
        {"retry-after": "30"},
    ),
    "too_large": _error(413, "request_too_large", "Request exceeds the maximum size"),
    "overloaded": _error(529, "overloaded_error", "Overloaded"),
}
ANTHROPIC: dict[str, Scenario] = {name: {"anthropic": scene} for name, scene in SCENES.items()}
