"""Google Gemini: its answers without text, and its errors."""

from __future__ import annotations

from typing import Any

from tests.support.scenarios.base import Body, Scenario, Scene, answer, fixed

RPC = "type.googleapis.com/google.rpc."
QUOTA = "You exceeded your current quota, please check your plan and billing details."
METRIC = "generativelanguage.googleapis.com/generate_content_free_tier_requests"
PER_MINUTE = "GenerateRequestsPerMinutePerProjectPerModel-FreeTier"
PER_DAY = "GenerateRequestsPerDayPerProjectPerModel-FreeTier"
HELP = {
    "@type": RPC + "Help",
    "links": [
        {
            "description": "Learn more about Gemini API quotas",
            "url": "https://ai.google.dev/gemini-api/docs/rate-limits",
        }
    ],
}
# No candidatesTokenCount: a count may be absent.
ALL_THOUGHTS = {"promptTokenCount": 700, "thoughtsTokenCount": 15996, "totalTokenCount": 16696}


def _candidate(finish: str, **content: Any) -> Body:  # members of any JSON type
    return answer(
        candidates=[{**content, "finishReason": finish, "index": 0}], usageMetadata=ALL_THOUGHTS
    )


def _error(status: int, name: str, message: str, *details: object) -> dict[str, Any]:
    error = {"code": status, "message": message, "status": name}
    return {"error": error | ({"details": list(details)} if details else {})}


def _violation(quota_id: str) -> dict[str, object]:
    return {
        "@type": RPC + "QuotaFailure",
        "violations": [
            {
                "quotaMetric": METRIC,
                "quotaId": quota_id,
                "quotaDimensions": {"location": "global", "model": "gemini-2.5-pro"},
                "quotaValue": "5",
            }
        ],
    }


def _retry_info(delay: str) -> dict[str, str]:
    return {"@type": RPC + "RetryInfo", "retryDelay": delay}


def _think_aloud(usual: dict[str, Any]) -> object:
    """The summary of the thoughts comes first, flagged."""
    (candidate,) = usual["candidates"]
    thought = {"text": "**Merging**\n\nI could do [0.1, 0.2] first.", "thought": True}
    parts = [thought, *candidate["content"]["parts"]]
    changed = {**candidate, "content": {"role": "model", "parts": parts}}
    return {**usual, "candidates": [changed]}


SCENES: dict[str, Scene] = {
    "ok": Scene(),
    "thoughts": Scene(_think_aloud),
    # From 2026-12-01 on, without an error.
    "substituted": Scene(answer(modelVersion="gemini-3.8-flash")),
    "max_tokens_no_parts": Scene(_candidate("MAX_TOKENS", content={"role": "model"})),
    "max_tokens_no_content": Scene(_candidate("MAX_TOKENS")),
    "max_tokens_no_text": Scene(
        _candidate("MAX_TOKENS", content={"role": "model", "parts": [{"text": ""}]})
    ),
    # A known intermittent fault of Gemini 2.5 Pro.
    "empty_stop": Scene(_candidate("STOP", content={"role": "model"})),
    "no_candidates": Scene(answer("candidates")),
    "safety": Scene(_candidate("SAFETY")),
    "recitation": Scene(_candidate("RECITATION")),
    "other": Scene(_candidate("OTHER")),
    "prompt_blocked": Scene(
        answer(
            "candidates",
            promptFeedback={"blockReason": "PROHIBITED_CONTENT", "safetyRatings": []},
            usageMetadata={"promptTokenCount": 700, "totalTokenCount": 700},
        )
    ),
    "bad_key": fixed(
        400,
        _error(
            400,
            "INVALID_ARGUMENT",
            "API key not valid. Please pass a valid API key.",
            {
                "@type": RPC + "ErrorInfo",
                "reason": "API_KEY_INVALID",
                "domain": "googleapis.com",
                "metadata": {"service": "generativelanguage.googleapis.com"},
            },
        ),
    ),
    "budget_0": fixed(
        400,
        _error(
            400,
            "INVALID_ARGUMENT",
            "Budget 0 is invalid. This model only works in thinking mode.",
        ),
    ),
    "credits_depleted": fixed(
        402, _error(402, "RESOURCE_EXHAUSTED", "Your prepayment credits are depleted.")
    ),
    "forbidden": fixed(
        403,
        _error(
            403,
            "PERMISSION_DENIED",
            "Method doesn't allow unregistered callers (callers without established identity).",
        ),
    ),
    "not_for_new_users": fixed(
        404,
        _error(
            404,
            "NOT_FOUND",
            "This model models/gemini-2.5-pro is no longer available to new users.",
        ),
    ),
    # A transient limit in the words of a quota.
    "per_minute": fixed(
        429,
        _error(
            429,
            "RESOURCE_EXHAUSTED",
            f"{QUOTA} \n* Quota exceeded for metric: {METRIC}, limit: 5\n"
            "Please retry in 45.837906927s.",
            _violation(PER_MINUTE),
            HELP,
            _retry_info("45.837906927s"),
        ),
    ),
    # A short delay that would not help.
    "per_day": fixed(
        429,
        _error(
            429,
            "RESOURCE_EXHAUSTED",
            f"{QUOTA} Please retry in 38.804097346s.",
            _violation(PER_MINUTE),
            _violation(PER_DAY),
            HELP,
            _retry_info("38s"),
        ),
    ),
    "bare": fixed(
        429,
        _error(429, "RESOURCE_EXHAUSTED", "Resource has been exhausted (e.g. check quota)."),
    ),
    "listed": fixed(
        429,
        [
            _error(
                429, "RESOURCE_EXHAUSTED", QUOTA, _retry_info("38s"), _violation(PER_MINUTE), HELP
            )
        ],
    ),
    "server_error": fixed(500, _error(500, "INTERNAL", "An internal error has occurred.")),
    "overloaded": fixed(
        503, _error(503, "UNAVAILABLE", "The model is overloaded. Please try again later.")
    ),
    "deadline": fixed(
        504,
        _error(504, "DEADLINE_EXCEEDED", "Deadline expired before operation could complete."),
    ),
}
GEMINI: dict[str, Scenario] = {name: {"gemini": scene} for name, scene in SCENES.items()}
