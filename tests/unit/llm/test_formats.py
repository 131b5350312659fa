import json
from copy import deepcopy

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from merge_runner.config import ModelEntry
from merge_runner.llm.formats import FORMATS
from merge_runner.records import Usage

OUTCOMES = {"ok", "refusal", "truncated", "empty", "error"}


def entry(wire, model, **changes):
    return ModelEntry(
        provider="openai", format=wire, id=model, **{"max_output_tokens": 16000, **changes}
    )


# What each kind of entry sends: nothing that its entry does not list.
@pytest.mark.parametrize(
    ("model", "path", "headers", "body"),
    [
        (
            # o3 rejects temperature and max_tokens.
            entry("openai-chat", "o3-2025-04-16", parameters={"reasoning_effort": "medium"}),
            "/chat/completions",
            {},
            {
                "model": "o3-2025-04-16",
                "messages": [{"role": "user", "content": "PROMPT"}],
                "max_completion_tokens": 16000,
                "reasoning_effort": "medium",
            },
        ),
        (
            entry(
                "openai-chat", "default", cap_field="max_tokens", parameters={"temperature": 1.0}
            ),
            "/chat/completions",
            {},
            {
                "model": "default",
                "messages": [{"role": "user", "content": "PROMPT"}],
                "max_tokens": 16000,
                "temperature": 1.0,
            },
        ),
        (
            entry("openai-chat", "dep", path="/deployments/dep/chat/completions?api-version=1"),
            "/deployments/dep/chat/completions?api-version=1",
            {},
            {
                "model": "dep",
                "messages": [{"role": "user", "content": "PROMPT"}],
                "max_completion_tokens": 16000,
            },
        ),
        (
            entry("openai-responses", "gpt-6-sol", parameters={"reasoning": {"effort": "high"}}),
            "/responses",
            {},
            {
                "model": "gpt-6-sol",
                "input": "PROMPT",
                "max_output_tokens": 16000,
                "store": False,
                "reasoning": {"effort": "high"},
            },
        ),
        (
            # A misplaced thinkingConfig is ignored by the server without a word.
            entry(
                "gemini",
                "gemini-2.5-pro",
                parameters={"temperature": 1.0, "thinkingConfig": {"thinkingBudget": -1}},
            ),
            "/v1beta/models/gemini-2.5-pro:generateContent",
            {},
            {
                "contents": [{"role": "user", "parts": [{"text": "PROMPT"}]}],
                "generationConfig": {
                    "maxOutputTokens": 16000,
                    "temperature": 1.0,
                    "thinkingConfig": {"thinkingBudget": -1},
                },
            },
        ),
        (
            # A later version rejects sampling parameters and has other defaults.
            entry("anthropic", "claude-sonnet-4-6"),
            "/v1/messages",
            {"anthropic-version": "2023-06-01"},
            {
                "model": "claude-sonnet-4-6",
                "max_tokens": 16000,
                "messages": [{"role": "user", "content": "PROMPT"}],
            },
        ),
    ],
    ids=lambda value: value.id if isinstance(value, ModelEntry) else "",
)
def test_what_is_sent(model, path, headers, body):
    request = FORMATS[model.format].request(model, "PROMPT")
    assert (request.path, request.headers, request.body) == (path, headers, body)


@pytest.mark.parametrize("wire", FORMATS)
def test_a_path_can_be_overridden_and_a_parameter_wins(wire):
    model = entry(wire, "m", path="/elsewhere", parameters={"extra": [1, {"a": None}]})
    request = FORMATS[wire].request(model, "PROMPT")
    assert request.path == "/elsewhere"
    assert '"extra": [1, {"a": null}]' in json.dumps(request.body)


@pytest.mark.parametrize("wire", FORMATS)
def test_a_request_changes_nothing_in_its_entry(wire):
    model = entry(wire, "m", parameters={"thinking": {"budget": 1}})
    before = model.model_copy(deep=True)
    FORMATS[wire].request(model, "PROMPT")
    assert model == before


CHAT = {
    "id": "chatcmpl-1",
    "object": "chat.completion",
    "created": 1760000000,
    "model": "o3-2025-04-16",
    "choices": [
        {
            "index": 0,
            "message": {
                "role": "assistant",
                "content": "TEXT",
                "refusal": None,
                "annotations": [],
            },
            "logprobs": None,
            "finish_reason": "stop",
        }
    ],
    "usage": {
        "prompt_tokens": 100,
        "completion_tokens": 900,
        "total_tokens": 1000,
        "prompt_tokens_details": {"cached_tokens": 25, "audio_tokens": 0},
        "completion_tokens_details": {"reasoning_tokens": 640, "audio_tokens": 0},
    },
    "service_tier": "default",
    "system_fingerprint": None,
}
RESPONSES = {
    "id": "resp_1",
    "object": "response",
    "created_at": 1760000000,
    "status": "completed",
    "model": "o3-2025-04-16",
    "error": None,
    "incomplete_details": None,
    "output": [
        {"type": "reasoning", "id": "rs_1", "summary": [{"type": "summary_text", "text": "HMM"}]},
        {
            "type": "message",
            "id": "msg_1",
            "role": "assistant",
            "status": "completed",
            "content": [{"type": "output_text", "text": "TEXT", "annotations": []}],
        },
    ],
    "usage": {
        "input_tokens": 100,
        "input_tokens_details": {"cached_tokens": 25},
        "output_tokens": 900,
        "output_tokens_details": {"reasoning_tokens": 640},
        "total_tokens": 1000,
    },
    "service_tier": "default",
    "temperature": 1.0,
    "top_p": 1.0,
}
GEMINI = {
    "candidates": [
        {
            "content": {"role": "model", "parts": [{"text": "TEXT", "thoughtSignature": "s"}]},
            "finishReason": "STOP",
            "index": 0,
        }
    ],
    "usageMetadata": {
        "promptTokenCount": 100,
        "cachedContentTokenCount": 25,
        "candidatesTokenCount": 260,
        "thoughtsTokenCount": 640,
        "totalTokenCount": 1000,
        "promptTokensDetails": [{"modality": "TEXT", "tokenCount": 100}],
    },
    "modelVersion": "gemini-2.5-pro",
    "responseId": "abc",
}
ANTHROPIC = {
    "id": "msg_1",
    "type": "message",
    "role": "assistant",
    "model": "claude-sonnet-4-6",
    "content": [{"type": "text", "text": "TEXT"}],
    "stop_reason": "end_turn",
    "stop_sequence": None,
    "usage": {
        "input_tokens": 70,
        "cache_creation_input_tokens": 5,
        "cache_read_input_tokens": 25,
        "output_tokens": 900,
        "output_tokens_details": {"thinking_tokens": 640},
        "service_tier": "standard",
    },
}
SAMPLES = {
    "openai-chat": CHAT,
    "openai-responses": RESPONSES,
    "gemini": GEMINI,
    "anthropic": ANTHROPIC,
}


def read(wire, payload):
    return FORMATS[wire].read(payload)


def changed(sample, path, value):
    """A copy of a sample with one value replaced."""
    copy = deepcopy(sample)
    inner = copy
    for name in path[:-1]:
        inner = inner[name]
    inner[path[-1]] = value
    return copy


@pytest.mark.parametrize(
    ("wire", "model", "finish"),
    [
        ("openai-chat", "o3-2025-04-16", "stop"),
        ("openai-responses", "o3-2025-04-16", "completed"),
        ("gemini", "gemini-2.5-pro", "STOP"),
        ("anthropic", "claude-sonnet-4-6", "end_turn"),
    ],
)
def test_a_whole_answer(wire, model, finish):
    """All formats count alike: input with the cached tokens, output with the thoughts."""
    reading = read(wire, SAMPLES[wire])
    assert (reading.outcome, reading.text) == ("ok", "TEXT")
    assert (reading.model_served, reading.finish_reason) == (model, finish)
    assert reading.usage == Usage(100, 25, 900, 640)


def chat(content, finish="stop", **message):
    copy = deepcopy(CHAT)
    copy["choices"][0]["message"].update(content=content, **message)
    copy["choices"][0]["finish_reason"] = finish
    return copy


def response(*content, status="completed", reason=None):
    copy = deepcopy(RESPONSES)
    copy["output"][1]["content"] = list(content)
    copy["status"] = status
    copy["incomplete_details"] = {"reason": reason} if reason else None
    return copy


def gemini(candidate):
    return {**deepcopy(GEMINI), "candidates": [candidate]}


def claude(*content, stop="end_turn"):
    return {**deepcopy(ANTHROPIC), "content": list(content), "stop_reason": stop}


REFUSAL = "I cannot help with that."
TEXT = {"type": "output_text", "text": "TEXT"}
REFUSED = {"type": "refusal", "refusal": REFUSAL}
THOUGHT = {"text": "HMM", "thought": True}

# A body, and the outcome and text that are read from it.
ANSWERS = [
    # A refusal is an answer, also where it ends like one.
    ("openai-chat", chat(None, refusal=REFUSAL), "refusal", REFUSAL),
    ("openai-chat", chat("", refusal=REFUSAL), "refusal", REFUSAL),
    ("openai-chat", chat(None, "content_filter"), "refusal", ""),
    ("openai-chat", chat("TEX", "content_filter"), "refusal", "TEX"),
    # The cap was spent on reasoning.
    ("openai-chat", chat("", "length"), "truncated", ""),
    ("openai-chat", chat("TEX", "length"), "truncated", "TEX"),
    ("openai-chat", chat(""), "empty", ""),
    ("openai-chat", chat(" \n"), "empty", " \n"),
    ("openai-chat", chat(None), "empty", ""),
    ("openai-chat", {}, "empty", ""),
    ("openai-chat", {**CHAT, "choices": []}, "empty", ""),
    ("openai-chat", {**CHAT, "choices": None}, "empty", ""),
    # Unknown and missing reasons say nothing against the text.
    ("openai-chat", chat("TEXT", None), "ok", "TEXT"),
    ("openai-chat", chat("TEXT", "eos"), "ok", "TEXT"),
    ("openai-chat", chat("TEXT", reasoning_content="HMM", reasoning="HMM"), "ok", "TEXT"),
    ("openai-chat", chat([{"type": "text", "text": "TE"}, {"text": "XT"}]), "ok", "TEXT"),
    # The finish words of the APIs behind a gateway.
    *(
        ("openai-chat", chat("TEX", word), "truncated", "TEX")
        for word in ("MAX_TOKENS", "max_tokens", "model_length", "model_context_window_exceeded")
    ),
    *(
        ("openai-chat", chat("TEX", word), "refusal", "TEX")
        for word in ("SAFETY", "RECITATION", "PROHIBITED_CONTENT", "refusal", "sensitive")
    ),
    *(
        ("openai-chat", chat("TEX", word), "error", "TEX")
        for word in ("error", "abort", "network_error", "insufficient_system_resource")
    ),
    # Some services add an error without content to each good answer.
    *(
        (wire, {**sample, "error": error}, "ok", "TEXT")
        for wire, sample in (("openai-chat", CHAT), ("openai-responses", RESPONSES))
        for error in ({}, {"message": "", "type": "", "param": None, "code": None}, "", [])
    ),
    ("openai-chat", changed(CHAT, ("choices", 0, "error"), {"message": ""}), "ok", "TEXT"),
    ("gemini", {**GEMINI, "error": {}}, "ok", "TEXT"),
    ("openai-chat", {**CHAT, "error": {"code": 502}}, "error", "TEXT"),
    ("openai-chat", changed(CHAT, ("choices", 0, "error"), {"code": 502}), "error", "TEXT"),
    ("openai-responses", response(REFUSED), "refusal", REFUSAL),
    ("openai-responses", response(TEXT, TEXT), "ok", "TEXTTEXT"),
    ("openai-responses", response(), "empty", ""),
    # Only messages are the answer.
    ("openai-responses", {"output": [{"type": "reasoning", "content": [TEXT]}]}, "empty", ""),
    (
        "openai-responses",
        response(status="incomplete", reason="max_output_tokens"),
        "truncated",
        "",
    ),
    (
        "openai-responses",
        response(TEXT, status="incomplete", reason="content_filter"),
        "refusal",
        "TEXT",
    ),
    ("openai-responses", response(status="failed"), "error", ""),
    ("openai-responses", {**RESPONSES, "error": {"code": "server_error"}}, "error", "TEXT"),
    ("openai-responses", {}, "empty", ""),
    # Gemini's six empty shapes. The first three: the cap was spent on thoughts.
    ("gemini", gemini({"content": {"role": "model"}, "finishReason": "MAX_TOKENS"}), "truncated"),
    ("gemini", gemini({"finishReason": "MAX_TOKENS"}), "truncated"),
    (
        "gemini",
        gemini({"content": {"parts": [{"text": ""}]}, "finishReason": "MAX_TOKENS"}),
        "truncated",
    ),
    ("gemini", gemini({"content": {"role": "model"}, "finishReason": "STOP"}), "empty"),
    ("gemini", {**GEMINI, "candidates": []}, "empty"),
    ("gemini", gemini({"finishReason": "SAFETY"}), "refusal"),
    ("gemini", {"usageMetadata": {"promptTokenCount": 100}}, "empty"),
    *(
        ("gemini", gemini({"finishReason": reason}), "refusal")
        for reason in (
            *("RECITATION", "LANGUAGE", "OTHER", "BLOCKLIST", "PROHIBITED_CONTENT", "SPII"),
            "MODEL_ARMOR",
        )
    ),
    # A blocked prompt has no candidates at all.
    *(
        (
            "gemini",
            {"promptFeedback": {"blockReason": reason}, "modelVersion": "gemini-2.5-pro"},
            "refusal",
        )
        for reason in ("SAFETY", "OTHER", "BLOCKLIST", "PROHIBITED_CONTENT", "JAILBREAK", "NEW")
    ),
    (
        "gemini",
        gemini({"content": {"parts": [{"text": "TEX"}]}, "finishReason": "SAFETY"}),
        "refusal",
        "TEX",
    ),
    # Thoughts come first and are no part of the answer.
    (
        "gemini",
        gemini(
            {
                "content": {"parts": [THOUGHT, {"text": "TE"}, {"text": "XT", "thought": False}]},
                "finishReason": "STOP",
            }
        ),
        "ok",
        "TEXT",
    ),
    ("gemini", gemini({"content": {"parts": [THOUGHT]}, "finishReason": "STOP"}), "empty"),
    ("gemini", gemini({"content": {"parts": [{"text": "TEXT"}]}}), "ok", "TEXT"),
    ("gemini", {"error": {"code": 503, "status": "UNAVAILABLE"}}, "error", ""),
    ("gemini", gemini({"content": {"parts": [{"text": "T"}]}, "finishReason": "NEW"}), "ok", "T"),
    (
        "anthropic",
        claude(
            {"type": "thinking", "thinking": "HMM", "text": "HMM"},
            {"type": "redacted_thinking", "data": "x"},
            {"type": "text", "text": "TE"},
            {"type": "text", "text": "XT"},
        ),
        "ok",
        "TEXT",
    ),
    ("anthropic", claude(stop="refusal"), "refusal", ""),
    ("anthropic", claude({"type": "text", "text": "TEX"}, stop="max_tokens"), "truncated", "TEX"),
    ("anthropic", claude({"type": "thinking"}, stop="max_tokens"), "truncated", ""),
    ("anthropic", claude(stop="model_context_window_exceeded"), "truncated", ""),
    ("anthropic", claude(), "empty", ""),
    ("anthropic", claude({"type": "text", "text": "TEXT"}, stop="pause_turn"), "ok", "TEXT"),
    ("anthropic", {"type": "error", "error": {"type": "overloaded_error"}}, "error", ""),
    ("anthropic", {}, "empty", ""),
]


@pytest.mark.parametrize(
    ("wire", "payload", "outcome", "text"),
    [(wire, payload, outcome, *(text or [""])) for wire, payload, outcome, *text in ANSWERS],
)
def test_what_is_read(wire, payload, outcome, text):
    reading = read(wire, payload)
    assert (reading.outcome, reading.text) == (outcome, text)


def test_the_providers_own_word_for_the_end_is_kept():
    assert read("gemini", gemini({"finishReason": "MAX_TOKENS"})).finish_reason == "MAX_TOKENS"
    assert read("gemini", {"promptFeedback": {"blockReason": "SAFETY"}}).finish_reason == "SAFETY"
    assert read("openai-chat", chat("TEXT", "eos")).finish_reason == "eos"
    incomplete = response(status="incomplete", reason="max_output_tokens")
    assert read("openai-responses", incomplete).finish_reason == "max_output_tokens"
    assert read("anthropic", claude(stop="pause_turn")).finish_reason == "pause_turn"


# Where a count is absent it is unknown, unless the others tell it.
@pytest.mark.parametrize(
    ("wire", "usage", "expected"),
    [
        ("openai-chat", {"prompt_tokens": 7, "completion_tokens": 8}, Usage(7, None, 8, None)),
        ("openai-chat", {"prompt_tokens": None, "completion_tokens": None}, Usage()),
        ("openai-chat", {"prompt_tokens": 7, "prompt_tokens_details": None}, Usage(7)),
        ("openai-chat", None, Usage()),
        ("openai-responses", {"input_tokens": 7, "output_tokens": 8}, Usage(7, None, 8, None)),
        ("openai-responses", None, Usage()),
        # xAI leaves the reasoning out of the output, gateways before Gemini all of it; the total
        # has it. Without a total it is more than the output that should include it.
        *(
            (
                "openai-chat",
                {
                    "prompt_tokens": 700,
                    "completion_tokens": visible,
                    "completion_tokens_details": {"reasoning_tokens": 3000},
                    **total,
                },
                Usage(700, None, 3000 + visible, 3000),
            )
            for visible in (100, 0)
            for total in ({"total_tokens": 700 + visible + 3000}, {})
        ),
        ("openai-chat", {"prompt_tokens": 7, "total_tokens": 15}, Usage(7, None, 8, None)),
        # A total without the output says nothing of it, and the worst case counts.
        ("openai-chat", {"prompt_tokens": 7, "total_tokens": 7}, Usage(7)),
        (
            "openai-chat",
            {"prompt_tokens": 7, "completion_tokens": 8, "total_tokens": 9},
            Usage(7, None, 8, None),
        ),
        (
            "openai-responses",
            {"input_tokens": 7, "output_tokens": 1, "total_tokens": 15},
            Usage(7, None, 8, None),
        ),
        ("gemini", {"promptTokenCount": 7, "totalTokenCount": 15}, Usage(7, None, 8, None)),
        # All output was thoughts.
        (
            "gemini",
            {"promptTokenCount": 7, "thoughtsTokenCount": 640},
            Usage(7, None, 640, 640),
        ),
        ("gemini", {"promptTokenCount": 7, "candidatesTokenCount": 8}, Usage(7, None, 8, None)),
        ("gemini", {"promptTokenCount": 7}, Usage(7)),
        ("gemini", None, Usage()),
        # Anthropic counts the cached input apart.
        (
            "anthropic",
            {"input_tokens": 7, "cache_read_input_tokens": 20, "output_tokens": 8},
            Usage(27, 20, 8, None),
        ),
        (
            "anthropic",
            {"input_tokens": 7, "cache_creation_input_tokens": 20, "output_tokens": 8},
            Usage(27, None, 8, None),
        ),
        ("anthropic", {"input_tokens": 7, "output_tokens": 8}, Usage(7, None, 8, None)),
        ("anthropic", None, Usage()),
    ],
)
def test_how_tokens_are_counted(wire, usage, expected):
    name = "usageMetadata" if wire == "gemini" else "usage"
    assert read(wire, {**SAMPLES[wire], name: usage}).usage == expected


def test_the_service_tier_is_read():
    assert read("openai-chat", {**CHAT, "service_tier": "priority"}).service_tier == "priority"
    assert read("openai-responses", {**RESPONSES, "service_tier": "flex"}).service_tier == "flex"
    usage = {**GEMINI["usageMetadata"], "serviceTier": "PRIORITY"}
    assert read("gemini", {**GEMINI, "usageMetadata": usage}).service_tier == "priority"
    assert read("gemini", GEMINI).service_tier is None
    # Anthropic sells that tier beforehand.
    assert read("anthropic", ANTHROPIC).service_tier is None


def test_gemini_alone_is_known_to_send_empty_answers():
    assert [wire for wire in FORMATS if FORMATS[wire].retries_empty] == ["gemini"]


def paths(value, path=()):
    """The paths to all values inside a JSON value."""
    if isinstance(value, dict | list):
        for name, inner in value.items() if isinstance(value, dict) else enumerate(value):
            yield (*path, name)
            yield from paths(inner, (*path, name))


@pytest.mark.parametrize("wire", FORMATS)
def test_no_value_in_the_place_of_another_makes_it_raise(wire):
    odd = [None, True, 7, -1, 1.5, "x", "", [], [None], ["x"], [[]], {}, {"text": None}]
    for path in paths(SAMPLES[wire]):
        for value in odd:
            reading = read(wire, changed(SAMPLES[wire], path, value))
            assert reading.outcome in OUTCOMES
            assert isinstance(reading.text, str)


NAMES = sorted({path[-1] for s in SAMPLES.values() for path in paths(s)} - {0, 1}, key=str)
json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(NAMES), inner, max_size=4)
    ),
    max_leaves=15,
)


@settings(deadline=None)
@given(
    st.sampled_from(list(FORMATS)),
    st.dictionaries(st.sampled_from(NAMES) | st.text(), json_values, max_size=6),
)
def test_no_json_object_makes_it_raise(wire, payload):
    reading = read(wire, payload)
    assert reading.outcome in OUTCOMES
    assert isinstance(reading.text, str)
