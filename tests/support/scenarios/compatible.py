"""Servers and routers that speak Chat Completions, each with its own errors."""

from __future__ import annotations

from typing import Any

from tests.support.scenarios.base import Scenario, Scene, answer, fixed
from tests.support.scenarios.openai import error

TOO_LONG = "This model's maximum context length is 8192 tokens. However, you requested 9000 tokens."
UPSTREAM = {
    "code": 502,
    "message": "Provider returned error",
    "metadata": {"provider_name": "OpenAI", "raw": '{"error":{"message":"upstream"}}'},
}
NULLS = {"prompt_tokens": None, "completion_tokens": None, "total_tokens": None}


def _broken_off(usual: dict[str, Any]) -> object:
    (choice,) = usual["choices"]
    failed = {
        **choice,
        "message": {"role": "assistant", "content": "M"},
        "finish_reason": "error",
        "native_finish_reason": None,
        "error": UPSTREAM,
    }
    return {**usual, "choices": [failed], "usage": NULLS}


SCENES: dict[str, dict[str, Scene]] = {
    "vllm": {
        # Since 0.10.1 the code is a number; before, there was no envelope.
        "nested": fixed(
            400,
            {"error": {"message": TOO_LONG, "type": "BadRequestError", "param": None, "code": 400}},
        ),
        "flat": fixed(
            400,
            {
                "object": "error",
                "message": TOO_LONG,
                "type": "BadRequestError",
                "param": None,
                "code": 400,
            },
        ),
    },
    "ollama": {"string": fixed(404, {"error": 'model "o3" not found, try pulling it first'})},
    "llamacpp": {
        "loading": fixed(
            503, {"error": {"code": 503, "message": "Loading model", "type": "unavailable_error"}}
        ),
    },
    "openrouter": {
        "error_in_200": fixed(200, {"error": UPSTREAM}),
        "finish_error": Scene(_broken_off),
        "null_usage": Scene(answer("service_tier", provider="OpenAI", usage=NULLS)),
    },
    "litellm": {
        "string_code": error(
            429,
            "litellm.RateLimitError: Rate limit reached. Received Model Group=o3",
            "throttling_error",
            "429",
        ),
        "budget": error(
            429,
            "Budget has been exceeded! Current cost: 10.51, Max budget: 10.00",
            "budget_exceeded",
            "429",
        ),
    },
    "azure": {
        "content_filter": fixed(
            400,
            {
                "error": {
                    "message": "The response was filtered due to the prompt triggering Azure "
                    "OpenAI's content management policy. Please modify your prompt and retry.",
                    "type": None,
                    "param": "prompt",
                    "code": "content_filter",
                    "status": 400,
                    "innererror": {
                        "code": "ResponsibleAIPolicyViolation",
                        "content_filter_result": {
                            "violence": {"filtered": True, "severity": "medium"}
                        },
                    },
                }
            },
        ),
        # It counts below zero.
        "integer_reset": fixed(
            429,
            {"error": {"code": "RateLimitReached", "message": "Rate limit reached."}},
            {"x-ratelimit-remaining-tokens": "-27689", "x-ratelimit-reset-tokens": "64"},
        ),
        "words": fixed(
            429,
            {
                "error": {
                    "code": "429",
                    "message": "Requests to the ChatCompletions_Create Operation under Azure "
                    "OpenAI API version 2024-10-21 have exceeded token rate limit of your current "
                    "OpenAI S0 pricing tier. Please retry after 26 seconds.",
                }
            },
        ),
    },
}
COMPATIBLE: dict[str, dict[str, Scenario]] = {
    server: {name: {"openai-chat": scene} for name, scene in scenes.items()}
    for server, scenes in SCENES.items()
}
