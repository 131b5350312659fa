"""What goes wrong on purpose, each fault a function of the seed, the slot and the attempt.

Errors are put as the servers of three providers put them.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

from merge_runner.chance import draw
from merge_runner.emulator.handler import GEMINI, MESSAGES, as_json
from merge_runner.records import SCRIPTED_FIELD

# Faults of the provider (besides a rate limit), and of the connection.
ERRORS = {"request_timeout": 408, "conflict": 409, "server_error": 500, "overloaded": 503}
BREAKS = ("hang", "reset", "truncated_body")
# A sweep with these ends like one without; answers that are ``empty`` or ``malformed`` are kept.
TRANSIENT = (
    *("rate_limit", "request_timeout", "conflict", "server_error", "bad_gateway", "overloaded"),
    *(*BREAKS, "truncated_json"),
)
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


@dataclass(frozen=True, kw_only=True)
class BatchPlan:
    """What becomes of batches; rates are probabilities per line, ``lost`` per creation.

    A line has its result within ``delay_s``; a batch ends with its last line, but not before its
    state was asked for ``polls`` times. A share ``failed`` of the lines ends with a 429, 500 or
    503 and ``expired`` without being asked. Of a share ``lost`` of the creations the answer is
    lost. While more than ``enqueued_tokens`` would wait, a batch is refused. Whoever asks for a
    file of results is told ``late_results`` times that there is none, and then gets half of it
    ``short_results`` times.
    """

    delay_s: float = 0.0
    polls: int = 0
    failed: float = 0.0
    expired: float = 0.0
    lost: float = 0.0
    enqueued_tokens: int | None = None
    late_results: int = 0
    short_results: int = 0


@dataclass(frozen=True, kw_only=True)
class FaultPlan:
    """Rates of faults per attempt; a hang is silent for ``hang_s``, and then closes.

    Every answer takes ``latency_s``. A rate limit asks to wait ``delay_s``.
    """

    rates: Mapping[str, float] = field(default_factory=dict)
    latency_s: float = 0.0
    delay_s: float = 0.05
    seed: int = 0
    hang_s: float = 30.0
    batch: BatchPlan = field(default_factory=BatchPlan)

    def fault(self, where: str, attempt: int) -> str | None:
        """What goes wrong with an attempt; ``where`` names the request."""
        chance = draw("fault", self.seed, where, attempt)
        for fault, rate in self.rates.items():
            chance -= rate
            if chance < 0:
                return fault
        return None


def error_body(wire, status, message):
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


def as_error(wire, status, message, delay_s=0.0):
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
