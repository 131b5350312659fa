"""The errors of three providers, as their servers put them."""

from typing import Any

import httpx

from merge_runner.emulator.handler import GEMINI, MESSAGES, ServedFormat, as_json
from merge_runner.records import SCRIPTED_FIELD

# The faults that are errors of the provider, beside a rate limit.
ERRORS = {"server_error": 500, "overloaded": 503, "request_timeout": 408, "conflict": 409}
# What OpenAI, Gemini and Anthropic call an error of a status.
NAMES = {
    400: ("invalid_request_error", "INVALID_ARGUMENT", "invalid_request_error"),
    404: ("not_found", "NOT_FOUND", "not_found_error"),
    408: ("timeout", "DEADLINE_EXCEEDED", "timeout_error"),
    409: ("conflict", "ABORTED", "conflict_error"),
    429: ("rate_limit_exceeded", "RESOURCE_EXHAUSTED", "rate_limit_error"),
    500: ("server_error", "INTERNAL", "api_error"),
    503: ("server_is_overloaded", "UNAVAILABLE", "overloaded_error"),
}


def error_body(wire: ServedFormat, status: int, message: str) -> dict[str, Any]:
    """The body of an error."""
    openai, gemini, anthropic = NAMES[status]
    if wire is GEMINI:
        error = {"code": status, "message": message, "status": gemini, "details": []}
    elif wire is MESSAGES:
        error = {"type": anthropic, "message": message}
        return {"type": "error", "error": error, "request_id": "req_mock", SCRIPTED_FIELD: True}
    else:
        error = {"message": message, "type": openai, "param": None, "code": openai}
    return {"error": error, SCRIPTED_FIELD: True}


def as_error(wire: ServedFormat, status: int, message: str, delay_s: float = 0.0) -> httpx.Response:
    """An error in a provider's form, which asks to wait where it does so."""
    body, headers = error_body(wire, status, message), {}
    if delay_s and wire is GEMINI:
        body["error"]["message"] += f" Please retry in {delay_s:.9f}s."
        kind = "type.googleapis.com/google.rpc.RetryInfo"
        body["error"]["details"] = [{"@type": kind, "retryDelay": f"{delay_s:.9f}s"}]
    elif delay_s and wire is MESSAGES:
        headers = {"retry-after": str(delay_s)}
    elif delay_s:
        body["error"]["message"] += f" Please try again in {delay_s * 1000:.0f}ms."
        headers = {"x-ratelimit-remaining-requests": "0"}
    response = as_json(body, status)
    response.headers.update(headers)
    return response
