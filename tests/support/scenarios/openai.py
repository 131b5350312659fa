"""OpenAI: Chat Completions and Responses, which share their errors."""

from __future__ import annotations

from collections.abc import Mapping

from tests.support.scenarios.base import Scenario, Scene, answer, fixed

O3 = "o3-2025-04-16"
REFUSAL = "I'm sorry, but I cannot help with that."
QUOTA = (
    "You exceeded your current quota, please check your plan and billing details. For more "
    "information on this error, read the docs: "
    "https://platform.openai.com/docs/guides/error-codes/api-errors."
)
VISIT = "Visit https://platform.openai.com/account/rate-limits to learn more."


def error(
    status: int,
    message: str,
    kind: str = "invalid_request_error",
    code: str | None = None,
    param: str | None = None,
    headers: Mapping[str, str] | None = None,
) -> Scene:
    """An error in OpenAI's envelope, which has all four members."""
    body = {"error": {"message": message, "type": kind, "param": param, "code": code}}
    return fixed(status, body, dict(headers or {}))


def _both(scene: Scene) -> Scenario:
    return {"openai-chat": scene, "openai-responses": scene}


def _chat(content: str | None, finish: str, *, refusal: str | None = None) -> Scene:
    message: dict[str, object] = {"role": "assistant", "content": content, "annotations": []}
    message["refusal"] = refusal
    choice = {"index": 0, "message": message, "logprobs": None, "finish_reason": finish}
    return Scene(answer(choices=[choice]))


def _responses(*parts: object, status: str = "completed", reason: str | None = None) -> Scene:
    output: list[object] = [{"type": "reasoning", "id": "rs_scene", "summary": []}]
    if parts:
        message = {"type": "message", "id": "msg_scene", "role": "assistant", "status": status}
        output.append({**message, "content": list(parts)})
    details = {"reason": reason} if reason else None
    return Scene(answer(status=status, output=output, incomplete_details=details))


def _failed(code: str, message: str) -> Scenario:
    """A failure that arrives with status 200."""
    told = {"code": code, "message": message}
    return {"openai-responses": Scene(answer("usage", status="failed", error=told, output=[]))}


OPENAI: dict[str, Scenario] = {
    "ok": _both(Scene()),
    "cached_tokens": {
        "openai-chat": Scene(
            answer(
                usage={
                    "prompt_tokens": 1000,
                    "completion_tokens": 900,
                    "total_tokens": 1900,
                    "prompt_tokens_details": {"cached_tokens": 896, "audio_tokens": 0},
                    "completion_tokens_details": {"reasoning_tokens": 640, "audio_tokens": 0},
                }
            )
        ),
        "openai-responses": Scene(
            answer(
                usage={
                    "input_tokens": 1000,
                    "input_tokens_details": {"cached_tokens": 896},
                    "output_tokens": 900,
                    "output_tokens_details": {"reasoning_tokens": 640},
                    "total_tokens": 1900,
                }
            )
        ),
    },
    "refusal": {
        "openai-chat": _chat(None, "stop", refusal=REFUSAL),
        "openai-responses": _responses({"type": "refusal", "refusal": REFUSAL}),
    },
    # The cap is spent on reasoning.
    "length": {
        "openai-chat": _chat("", "length"),
        "openai-responses": _responses(status="incomplete", reason="max_output_tokens"),
    },
    "content_filter": {
        "openai-chat": _chat("", "content_filter"),
        "openai-responses": _responses(status="incomplete", reason="content_filter"),
    },
    "failed_server_error": _failed("server_error", "The server had an error."),
    "failed_rate_limit": _failed(
        "rate_limit_exceeded", f"Rate limit reached for {O3}. Please try again in 34.337s."
    ),
    "failed_invalid_prompt": _failed("invalid_prompt", "Your prompt was flagged."),
    "temperature": _both(
        error(
            400,
            "Unsupported value: 'temperature' does not support 0.2 with this model. Only the "
            "default (1) value is supported.",
            code="unsupported_value",
            param="temperature",
        )
    ),
    "max_tokens": _both(
        error(
            400,
            "Unsupported parameter: 'max_tokens' is not supported with this model. Use "
            "'max_completion_tokens' instead.",
            code="unsupported_parameter",
            param="max_tokens",
        )
    ),
    "stream_unverified": _both(
        error(
            400,
            "Your organization must be verified to stream this model. Please go to: "
            "https://platform.openai.com/settings/organization/general and click on Verify "
            "Organization.",
            code="unsupported_value",
            param="stream",
        )
    ),
    "context_length": _both(
        error(
            400,
            "This model's maximum context length is 200000 tokens. Please reduce the length of "
            "the messages.",
            code="context_length_exceeded",
            param="messages",
        )
    ),
    "bad_key": _both(error(401, "Incorrect API key provided: sk-....", code="invalid_api_key")),
    "forbidden": _both(
        error(
            403,
            "Country, region, or territory not supported",
            "request_forbidden",
            "unsupported_country_region_territory",
        )
    ),
    "no_model": {
        "openai-chat": error(
            404,
            f"The model `{O3}` does not exist or you do not have access to it.",
            code="model_not_found",
        ),
        "openai-responses": error(
            400,
            f"The requested model '{O3}' does not exist.",
            code="model_not_found",
            param="model",
        ),
    },
    # What a shut-down model answers is not documented; earlier ones answered so.
    "shut_down": _both(
        error(
            404,
            f"The model `{O3}` has been deprecated, learn more here: "
            "https://platform.openai.com/docs/deprecations",
            code="model_not_found",
        )
    ),
    "requests_per_minute": _both(
        error(
            429,
            f"Rate limit reached for {O3} in organization org-x on requests per min (RPM): "
            f"Limit 500, Used 500, Requested 1. {VISIT}",
            "requests",
            "rate_limit_exceeded",
            headers={
                "x-ratelimit-limit-requests": "500",
                "x-ratelimit-remaining-requests": "0",
                "x-ratelimit-reset-requests": "2m52.8s",
            },
        )
    ),
    # The delay is only in the text.
    "tokens_per_minute": _both(
        error(
            429,
            f"Rate limit reached for {O3} in organization org-x on tokens per min (TPM): "
            f"Limit 200000, Used 162960, Requested 42288. Please try again in 1.574s. {VISIT}",
            "tokens",
            "rate_limit_exceeded",
        )
    ),
    "request_too_large": _both(
        error(
            429,
            f"Request too large for {O3} in organization org-x on tokens per min (TPM): "
            f"Limit 30000, Requested 31538. {VISIT}",
            "tokens",
            "rate_limit_exceeded",
        )
    ),
    "insufficient_quota": _both(error(429, QUOTA, "insufficient_quota", "insufficient_quota")),
    "credit_exhausted": _both(error(429, QUOTA, "insufficient_quota", "credit_balance_exhausted")),
    "flex_unavailable": _both(
        error(429, "Resource Unavailable", "resource_unavailable", "resource_unavailable")
    ),
    "server_error": _both(
        error(
            500,
            "The server had an error while processing your request. Sorry about that!",
            "server_error",
        )
    ),
    "bad_gateway": _both(
        fixed(
            502,
            "<html>\r\n<head><title>502 Bad Gateway</title></head>\r\n<body>\r\n"
            "<center><h1>502 Bad Gateway</h1></center>\r\n</body>\r\n</html>\r\n",
        )
    ),
    "overloaded": _both(
        error(
            503,
            "The engine is currently overloaded, please try again later.",
            "service_unavailable_error",
            "server_is_overloaded",
            headers={"retry-after": "20"},
        )
    ),
    "gateway_timeout": _both(fixed(504, "upstream request timeout")),
}
