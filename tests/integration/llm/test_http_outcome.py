import json
from datetime import UTC, datetime

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from merge_runner.config import ModelEntry
from merge_runner.llm.formats import FORMATS, Reading, WireFormat, WireRequest
from merge_runner.llm.http_outcome import (
    RawReply,
    judge,
    may_be_charged,
    reason_of,
    server_delay_s,
    why_refused,
)

OPENAI_QUOTA = (
    "You exceeded your current quota, please check your plan and billing details. For more "
    "information on this error, read the docs: https://platform.openai.com/docs/guides."
)
# Gemini says the same for a limit per minute, which passes.
GEMINI_QUOTA = (
    "You exceeded your current quota, please check your plan and billing details. Please retry in "
    "38.804097346s."
)
HTML = "<html>\n<head><title>502 Bad Gateway</title></head>\n<body>nginx</body></html>"
TOKENS = (
    "Rate limit reached for o4-mini in organization org-x on tokens per min (TPM): Limit 200000, "
    "Used 162960, Requested 42288. Please try again in 1.574s. Visit https://platform.openai.com."
)
TOO_LARGE = (
    "Request too large for o3 in organization org-x on tokens per min (TPM): Limit 30000, "
    "Requested 31538."
)


def openai(message="m", kind="invalid_request_error", code=None, param=None):
    return {"error": {"message": message, "type": kind, "param": param, "code": code}}


def gemini(code, status, message="m", *details):
    kind = "type.googleapis.com/google.rpc."
    listed = [{"@type": kind + name, **detail} for name, detail in details]
    return {"error": {"code": code, "message": message, "status": status, "details": listed}}


def violations(*quota_ids):
    return "QuotaFailure", {"violations": [{"quotaId": each} for each in quota_ids]}


def anthropic(kind, message="m", **details):
    error = {"type": kind, "message": message}
    if details:
        error["details"] = details
    return {"type": "error", "error": error, "request_id": "req_1"}


def openrouter(code, message="m", **metadata):
    return {"error": {"code": code, "message": message, "metadata": metadata}}


def minimax(code, words):
    body = {"base_resp": {"status_code": code, "status_msg": words}}
    return body if code == 0 else {**body, "choices": None}


PER_MINUTE = "GenerateRequestsPerMinutePerProjectPerModel-FreeTier"
PER_DAY = "GenerateRequestsPerDayPerProjectPerModel-FreeTier"
RETRY_38 = ("RetryInfo", {"retryDelay": "38s"})
HELP = ("Help", {"links": [{"description": "quotas", "url": "https://ai.google.dev"}]})
BAD_KEY = ("ErrorInfo", {"reason": "API_KEY_INVALID", "domain": "googleapis.com"})


def judged(wire, status, body, headers=None):
    text = body if isinstance(body, str) else json.dumps(body)
    return judge(RawReply(status, headers or {}, text), FORMATS[wire])


# An error: format, status, body, headers, and what is to be done.
ERRORS = [
    # OpenAI.
    ("openai-chat", 400, openai(code="unsupported_value"), {}, "fail", "bad_request"),
    ("openai-chat", 400, openai(code="unsupported_parameter"), {}, "fail", "bad_request"),
    ("openai-chat", 400, openai(code="context_length_exceeded"), {}, "fail", "bad_request"),
    ("openai-chat", 400, openai(code="invalid_prompt"), {}, "fail", "bad_prompt"),
    ("openai-chat", 400, openai(param="service_tier"), {}, "fail", "bad_request"),
    ("openai-responses", 400, openai(code="model_not_found"), {}, "refused", "unknown_model"),
    ("openai-chat", 404, openai(code="model_not_found"), {}, "refused", "unknown_model"),
    ("openai-chat", 401, openai(code="invalid_api_key"), {}, "refused", "not_allowed"),
    ("openai-chat", 403, openai(code="unsupported_country"), {}, "refused", "not_allowed"),
    ("openai-chat", 408, openai("timeout"), {}, "retry", "request_timeout"),
    ("openai-chat", 409, openai("lock"), {}, "retry", "conflict"),
    ("openai-chat", 413, openai("too large"), {}, "fail", "bad_request"),
    ("openai-chat", 422, openai("unprocessable"), {}, "fail", "bad_request"),
    ("openai-chat", 500, openai("oops", "server_error"), {}, "retry", "server_error"),
    ("openai-chat", 502, HTML, {}, "retry", "server_error"),
    ("openai-chat", 503, openai(code="server_is_overloaded"), {}, "retry", "overloaded"),
    ("openai-chat", 504, "", {}, "retry", "server_timeout"),
    ("openai-chat", 520, HTML, {}, "retry", "server_error"),
    ("openai-chat", 521, HTML, {}, "retry", "server_error"),
    ("openai-chat", 522, HTML, {}, "retry", "server_error"),
    ("openai-chat", 523, HTML, {}, "retry", "server_error"),
    ("openai-chat", 524, HTML, {}, "retry", "server_timeout"),
    # Quotas, whatever the message says; the type alone or the code alone is enough.
    *(
        ("openai-chat", 429, body, {}, "quota", "quota_exhausted")
        for code in (
            "insufficient_quota",
            "billing_hard_limit_reached",
            "credit_balance_exhausted",
            "organization_spend_limit_exceeded",
            "project_spend_limit_exceeded",
            "organization_usage_limit_exceeded",
        )
        for body in (
            openai(OPENAI_QUOTA, "insufficient_quota", code),
            openai("other words", "x", code),
        )
    ),
    ("openai-chat", 429, openai("m", "insufficient_quota"), {}, "quota", "quota_exhausted"),
    (
        "openai-chat",
        429,
        openai(OPENAI_QUOTA, "insufficient_quota", "insufficient_quota"),
        {"retry-after": "1"},
        "quota",
        "quota_exhausted",
    ),
    # It can never succeed, however long one waits.
    (
        "openai-chat",
        429,
        openai(TOO_LARGE, "tokens", "rate_limit_exceeded"),
        {},
        "fail",
        "request_too_large",
    ),
    # Gemini.
    ("gemini", 400, gemini(400, "INVALID_ARGUMENT"), {}, "fail", "bad_request"),
    ("gemini", 400, gemini(400, "FAILED_PRECONDITION"), {}, "fail", "bad_request"),
    ("gemini", 400, gemini(400, "INVALID_ARGUMENT", "m", BAD_KEY), {}, "refused", "not_allowed"),
    ("gemini", 401, gemini(401, "UNAUTHENTICATED"), {}, "refused", "not_allowed"),
    ("gemini", 402, gemini(402, "RESOURCE_EXHAUSTED"), {}, "quota", "quota_exhausted"),
    ("gemini", 403, gemini(403, "PERMISSION_DENIED"), {}, "refused", "not_allowed"),
    ("gemini", 404, gemini(404, "NOT_FOUND"), {}, "refused", "unknown_model"),
    (
        "gemini",
        429,
        gemini(429, "RESOURCE_EXHAUSTED", GEMINI_QUOTA, violations(PER_DAY), RETRY_38),
        {},
        "quota",
        "quota_exhausted",
    ),
    (
        "gemini",
        429,
        gemini(429, "RESOURCE_EXHAUSTED", GEMINI_QUOTA, RETRY_38, violations(PER_MINUTE, PER_DAY)),
        {},
        "quota",
        "quota_exhausted",
    ),
    ("gemini", 500, gemini(500, "INTERNAL"), {}, "retry", "server_error"),
    ("gemini", 503, gemini(503, "UNAVAILABLE"), {}, "retry", "overloaded"),
    ("gemini", 503, gemini(503, "RESOURCE_EXHAUSTED"), {}, "retry", "overloaded"),
    ("gemini", 504, gemini(504, "DEADLINE_EXCEEDED"), {}, "retry", "server_timeout"),
    # Anthropic.
    ("anthropic", 400, anthropic("invalid_request_error"), {}, "fail", "bad_request"),
    (
        "anthropic",
        400,
        anthropic("invalid_request_error", "Your credit balance is too low to access the API."),
        {},
        "quota",
        "quota_exhausted",
    ),
    (
        "anthropic",
        400,
        anthropic("invalid_request_error", "You have reached your spend limit."),
        {},
        "quota",
        "quota_exhausted",
    ),
    ("anthropic", 401, anthropic("authentication_error"), {}, "refused", "not_allowed"),
    ("anthropic", 402, anthropic("billing_error"), {}, "quota", "quota_exhausted"),
    ("anthropic", 403, anthropic("permission_error"), {}, "refused", "not_allowed"),
    ("anthropic", 404, anthropic("not_found_error"), {}, "refused", "unknown_model"),
    ("anthropic", 408, anthropic("timeout_error"), {}, "retry", "request_timeout"),
    ("anthropic", 409, anthropic("conflict_error"), {}, "retry", "conflict"),
    ("anthropic", 413, HTML, {}, "fail", "bad_request"),
    *(
        (
            "anthropic",
            429,
            anthropic("rate_limit_error", error_code=code),
            {},
            "quota",
            "quota_exhausted",
        )
        for code in ("enforced_spend_limit_reached", "contract_spend_limit_reached")
    ),
    ("anthropic", 500, anthropic("api_error"), {}, "retry", "server_error"),
    ("anthropic", 504, anthropic("timeout_error"), {}, "retry", "server_timeout"),
    ("anthropic", 529, anthropic("overloaded_error"), {}, "retry", "overloaded"),
    # Its monthly limit, and an account without money, in others' words.
    (
        "anthropic",
        400,
        anthropic(
            "invalid_request_error",
            "You have reached your specified API usage limits. You will regain access on "
            "2027-01-01 at 00:00 UTC.",
        ),
        {"x-should-retry": "false"},
        "quota",
        "quota_exhausted",
    ),
    *(
        ("openai-chat", status, body, {}, "quota", "quota_exhausted")
        for status, body in (
            (429, openai("Your account is not active.", "billing_not_active")),
            (429, openai("Please check your billing details on our website.", "x")),
            (429, openai("Your account is suspended.", "exceeded_current_quota_error")),
            (403, openai("Insufficient account balance", "x")),
            (403, {"code": 30001, "message": "Sorry, your account balance is insufficient"}),
            (403, openrouter(403, "Key limit exceeded (monthly limit).")),
        )
    ),
    # Limits of a day, of which the delay is no reason to wait.
    *(
        ("openai-chat", 429, body, headers, "quota", "quota_exhausted")
        for body, headers in (
            (openrouter(429, "Rate limit exceeded: free-models-per-day"), {}),
            (openai("Rate limit reached on requests per day (RPD): Limit 200.", "requests"), {}),
            (openai("Rate limit reached on tokens per day (TPD): Used 99.", "tokens"), {}),
            (openai("You have hit your daily limit.", "x"), {"retry-after": "3"}),
        )
    ),
    # Whatever breaks off at a provider or before it.
    ("gemini", 499, gemini(499, "CANCELLED"), {}, "retry", "server_timeout"),
    *(
        ("openai-chat", status, HTML, {}, "retry", "server_error")
        for status in (507, 525, 526, 527, 530, 561, 599)
    ),
    *(("openai-chat", status, HTML, {}, "fail", "bad_request") for status in (501, 505, 511)),
    ("openai-chat", 407, HTML, {}, "refused", "proxy_refused"),
    # vLLM: the code is a number; older ones send no envelope.
    (
        "openai-chat",
        400,
        {"error": {"message": "m", "type": "BadRequestError", "param": None, "code": 400}},
        {},
        "fail",
        "bad_request",
    ),
    (
        "openai-chat",
        400,
        {"object": "error", "message": "m", "type": "BadRequestError", "code": 400},
        {},
        "fail",
        "bad_request",
    ),
    (
        "openai-chat",
        404,
        {"object": "error", "message": "m", "type": "NotFoundError", "code": 404},
        {},
        "refused",
        "unknown_model",
    ),
    # Ollama.
    ("openai-chat", 400, {"error": "m"}, {}, "fail", "bad_request"),
    ("openai-chat", 404, {"error": "model 'm' not found"}, {}, "refused", "unknown_model"),
    ("openai-chat", 503, {"error": "m: server busy"}, {}, "retry", "overloaded"),
    # llama.cpp.
    (
        "openai-chat",
        503,
        {"error": {"code": 503, "message": "Loading model m", "type": "unavailable_error"}},
        {},
        "retry",
        "overloaded",
    ),
    (
        "openai-chat",
        400,
        {"error": {"code": 400, "message": "m", "type": "exceed_context_size_error", "n_ctx": 1}},
        {},
        "fail",
        "bad_request",
    ),
    # OpenRouter.
    ("openai-chat", 402, openrouter(402), {}, "quota", "quota_exhausted"),
    (
        "openai-chat",
        402,
        openrouter(402, limit_source="openrouter_credits"),
        {"retry-after": "3"},
        "quota",
        "quota_exhausted",
    ),
    (
        "openai-chat",
        402,
        openrouter(402, limit_source="openrouter_in_flight_budget"),
        {},
        "quota",
        "quota_exhausted",
    ),
    ("openai-chat", 502, openrouter(502, raw="upstream"), {}, "retry", "server_error"),
    ("openai-chat", 503, openrouter(503), {}, "retry", "overloaded"),
    # LiteLLM's own budgets.
    (
        "openai-chat",
        429,
        openai("Budget has been exceeded! Current cost: 10.51", "budget_exceeded", "429"),
        {},
        "quota",
        "quota_exhausted",
    ),
    # Azure.
    ("openai-chat", 401, {"error": {"code": "401", "message": "m"}}, {}, "refused", "not_allowed"),
    (
        "openai-chat",
        404,
        {"error": {"code": "DeploymentNotFound", "message": "m"}},
        {},
        "refused",
        "unknown_model",
    ),
    # Gemini's OpenAI endpoint puts errors into a list.
    ("openai-chat", 400, [gemini(400, "INVALID_ARGUMENT")], {}, "fail", "bad_request"),
    (
        "openai-chat",
        400,
        openai("Invalid prompt: 'an insufficient balance of speed'", "x", "invalid_prompt"),
        {},
        "fail",
        "bad_prompt",
    ),
    (
        "openai-chat",
        429,
        [gemini(429, "RESOURCE_EXHAUSTED", "m", violations(PER_DAY))],
        {},
        "quota",
        "quota_exhausted",
    ),
]


@pytest.mark.parametrize(("wire", "status", "body", "headers", "action", "outcome"), ERRORS)
def test_what_an_error_means(wire, status, body, headers, action, outcome):
    found = judged(wire, status, body, headers)
    assert (found.action, found.name, found.pause) == (action, outcome, False)
    assert found.reading.outcome == "error"
    assert str(status) in found.message


# A rate limit: format, status, body, headers, and how long everybody waits.
LIMITS = [
    ("openai-chat", 429, openai(TOKENS, "tokens", "rate_limit_exceeded"), {}, 1.574),
    ("openai-chat", 429, openai("m", "rate_limit_error", "slow_down"), {}, None),
    ("openai-chat", 429, openai("Resource Unavailable", "x", "resource_unavailable"), {}, None),
    (
        "openai-chat",
        429,
        openai(TOKENS, "tokens", "rate_limit_exceeded"),
        {"retry-after": "3"},
        3,
    ),
    ("openai-chat", 429, HTML, {"retry-after": "3"}, 3),
    # A limit of a day is only listed.
    *(
        ("openai-chat", 429, openai(words, "requests"), {}, delay_s)
        for words, delay_s in (
            ("Limit of 60 requests per minute reached (daily limit: 10000). Try again in 3s", 3),
            ("Rate limit reached. Limits: 3 RPM, 200 RPD. Please try again in 20s.", 20),
        )
    ),
    # Per minute, with the words of a quota; the RetryInfo is believed before the message.
    (
        "gemini",
        429,
        gemini(429, "RESOURCE_EXHAUSTED", GEMINI_QUOTA, violations(PER_MINUTE), HELP, RETRY_38),
        {},
        38,
    ),
    (
        "gemini",
        429,
        gemini(429, "RESOURCE_EXHAUSTED", "m", ("RetryInfo", {"retryDelay": "45.837906927s"})),
        {},
        45.837906927,
    ),
    (
        "gemini",
        429,
        gemini(429, "RESOURCE_EXHAUSTED", GEMINI_QUOTA, violations(PER_MINUTE)),
        {},
        38.804097346,
    ),
    ("gemini", 429, gemini(429, "RESOURCE_EXHAUSTED", "Resource has been exhausted."), {}, None),
    ("anthropic", 429, anthropic("rate_limit_error"), {"retry-after": "12"}, 12),
    (
        "anthropic",
        429,
        anthropic("rate_limit_error", error_code="ramp_limit_exceeded"),
        {"retry-after": "12"},
        12,
    ),
    (
        "openai-chat",
        402,
        openrouter(402, limit_source="openrouter_in_flight_budget"),
        {"retry-after": "3"},
        3,
    ),
    # LiteLLM: the code is a number in a text.
    ("openai-chat", 429, openai("m", "throttling_error", "429"), {}, None),
    # Azure.
    (
        "openai-chat",
        429,
        {"error": {"code": "RateLimitReached", "message": "m"}},
        {"retry-after": "1", "retry-after-ms": "640"},
        0.64,
    ),
    ("openai-chat", 429, [gemini(429, "RESOURCE_EXHAUSTED", "m", RETRY_38)], {}, 38),
    # Answers with status 200 that carry a rate limit.
    ("openai-chat", 200, openrouter(429), {"retry-after": "3"}, 3),
    ("anthropic", 200, anthropic("rate_limit_error"), {"retry-after": "3"}, 3),
    ("openai-chat", 200, minimax(1002, "rate limit"), {}, None),
    ("openai-chat", 200, {"choices": [{"error": {"code": 429, "message": "m"}}]}, {}, None),
    (
        "openai-responses",
        200,
        {"status": "failed", "error": {"code": "rate_limit_exceeded", "message": TOKENS}},
        {},
        1.574,
    ),
]


@pytest.mark.parametrize(("wire", "status", "body", "headers", "delay"), LIMITS)
def test_a_rate_limit_makes_all_calls_of_the_key_wait(wire, status, body, headers, delay):
    found = judged(wire, status, body, headers)
    assert (found.action, found.name, found.pause) == ("retry", "rate_limited", True)
    assert found.delay_s == (None if delay is None else pytest.approx(delay))


@pytest.mark.parametrize("status", [408, 409, 500, 502, 503, 504, 520, 524, 529])
def test_the_delay_that_a_failing_server_asks_for_is_kept_for_this_call_alone(status):
    found = judged("openai-chat", status, HTML, {"retry-after": "9"})
    assert (found.action, found.delay_s, found.pause) == ("retry", 9, False)


def choice(content="M", finish="stop", **changes):
    return {"choices": [{"message": {"content": content}, "finish_reason": finish, **changes}]}


def candidate(finish, *parts):
    return {"candidates": [{"content": {"parts": list(parts)}, "finishReason": finish}]}


def failed(code):
    return {"status": "failed", "error": {"code": code, "message": "m"}, "output": []}


@pytest.mark.parametrize(
    ("headers", "within", "delay_s"),
    [
        ({"x-ratelimit-reset": "60"}, {}, 60),
        ({"x-ratelimit-reset": "60", "x-ratelimit-remaining": "0"}, {}, 60),
        ({"x-ratelimit-reset": "60", "x-ratelimit-remaining": "7"}, {}, None),
        ({"x-ratelimit-reset": "soon"}, {}, None),
        ({"x-ratelimit-reset": "60", "retry-after": "3"}, {}, 3),
        ({}, {"X-RateLimit-Reset": str(1_800_000_030_000), "X-RateLimit-Remaining": "0"}, 30),
        ({}, {"X-RateLimit-Reset": str(1_800_000_030)}, 30),
        ({}, {"X-RateLimit-Reset": str(1_700_000_000)}, None),
    ],
)
def test_the_reset_of_a_used_up_limit_is_a_delay(headers, within, delay_s):
    body = json.dumps(openrouter(429, "Rate limit exceeded", headers=within))
    now = datetime.fromtimestamp(1_800_000_000, UTC)
    error = RawReply(429, headers, body).error
    assert server_delay_s(error, FORMATS["openai-chat"], now) == delay_s


def test_a_quota_of_a_day_says_when_it_opens_again_unless_that_is_not_known():
    when = {"X-RateLimit-Reset": "1999999999000"}
    told = judged("openai-chat", 200, openrouter(429, "free-models-per-day", headers=when))
    assert told.delay_s > 1e6
    gemini_day = gemini(429, "RESOURCE_EXHAUSTED", "m", violations(PER_DAY), RETRY_38)
    assert judged("gemini", 429, gemini_day).delay_s is None
    spent = openai("m", "insufficient_quota")
    assert judged("openai-chat", 429, spent, {"retry-after": "1"}).delay_s is None


def test_what_came_in_the_place_of_an_answer_is_in_the_message():
    events = 'data: {"choices": [{"delta": {"content": "M"}}]}\n\ndata: [DONE]\n'
    kind = {"content-type": "text/event-stream"}
    message = judged("openai-chat", 200, events, kind).message
    assert "text/event-stream: data: {" in message
    assert "\n" not in message
    long = judged("openai-chat", 200, {"status": "x" * 1000}, {"content-type": "text/json"})
    assert "text/json: " in long.message
    assert len(long.message) < 300


# Status, body, headers, and which reason not to ask on they are at the first call of a run.
KINDS = [
    (200, "data: {}\n\n", {}, "stream"),
    (200, ": OPENROUTER PROCESSING\n\ndata: {}", {}, "stream"),
    (200, "", {"content-type": "text/event-stream; charset=utf-8"}, "stream"),
    (200, "id: 1\nretry: 10\nevent: end\ndata: {}", {}, "stream"),
    (200, "id: no such", {}, "text"),
    (200, ": no such", {}, "text"),
    (200, HTML, {"content-type": "text/html"}, "page"),
    (200, '{"status": "up"}', {}, "other_format"),
    (200, '{"detail": "Not Found"}', {}, "other_format"),
    (200, "[1]", {}, "other_format"),
    (200, '{"choices": [', {}, "text"),
    (200, "", {}, "text"),
    (200, "\ufffd\ufffd", {"content-encoding": "br"}, "packed"),
    (200, "\ufffd\ufffd", {"content-encoding": "identity"}, "text"),
    (200, '{"error": "Unexpected endpoint or method. (POST /chat)"}', {}, "other_error"),
    (200, '{"error": {"message": "m", "type": "overloaded_error"}}', {}, None),
    (502, HTML, {}, None),
    (503, "", {}, None),
    (405, "", {}, "other_format"),
    (400, "{}", {}, "request"),
]


@pytest.mark.parametrize(("status", "body", "headers", "reason"), KINDS)
def test_what_no_call_of_a_run_would_fare_better_with(status, body, headers, reason):
    outcome = judged("openai-chat", status, body, headers)
    assert reason_of(outcome, "http://localhost/v1/chat/completions") == reason
    if reason is not None:
        entry = ModelEntry(provider="local", format="openai-chat", id="m", max_output_tokens=10)
        assert "\n" not in why_refused(reason, "local", entry, outcome)


@pytest.mark.parametrize(
    ("url", "reason"),
    [
        ("http://localhost/v1/v1/messages", "path_twice"),
        ("http://localhost/x/v1beta/v1beta/models/m:generateContent", "path_twice"),
        ("http://localhost/v1/chat/completions/chat/completions", "path_twice"),
        ("http://localhost/v1/messages", "unknown_model"),
        ("http://localhost/v1/v1beta/messages", "unknown_model"),
        ("anthropic/v1/messages", "unknown_model"),
    ],
)
def test_a_path_that_stands_twice_in_a_url_is_no_unknown_model(url, reason):
    assert reason_of(judged("anthropic", 404, anthropic("not_found_error")), url) == reason


@pytest.mark.parametrize("member", ["reasoning_content", "reasoning"])
def test_an_answer_that_is_nothing_but_reasoning_is_told(member):
    message = {"content": None, member: "M\nI go first."}
    outcome = judged("openai-chat", 200, {"choices": [{"message": message}]})
    assert reason_of(outcome, "") == "reasoning_alone"
    cut = {"choices": [{"message": message, "finish_reason": "length"}]}
    assert reason_of(judged("openai-chat", 200, cut), "") is None
    assert reason_of(judged("openai-chat", 200, choice("")), "") is None
    parts = [{"type": "thinking", "thinking": [{"type": "text", "text": "M"}]}]
    assert reason_of(judged("openai-chat", 200, choice(parts)), "") == "reasoning_alone"
    assert reason_of(judged("openai-chat", 200, choice("<think>M</think>")), "") is None


# A body of status 200: format, body, and what is to be done.
SUCCESSES = [
    ("openai-chat", choice(), "accept", "ok"),
    ("openai-chat", choice("", "length"), "accept", "truncated"),
    ("openai-chat", choice(None, "content_filter"), "accept", "refusal"),
    ("openai-chat", choice(""), "accept", "empty"),
    ("openai-chat", " \n\n" + json.dumps(choice()), "accept", "ok"),
    ("gemini", candidate("STOP", {"text": "M"}), "accept", "ok"),
    ("gemini", candidate("STOP"), "accept", "empty"),
    ("gemini", candidate("SAFETY"), "accept", "refusal"),
    ("gemini", candidate("MAX_TOKENS"), "accept", "truncated"),
    ("gemini", gemini(503, "UNAVAILABLE"), "retry", "overloaded"),
    # Bodies that are cut, or come from somebody else than the server.
    ("openai-chat", json.dumps(choice())[:-3], "retry", "bad_body"),
    ("openai-chat", "", "retry", "bad_body"),
    ("openai-chat", HTML, "retry", "bad_body"),
    ("openai-chat", "null", "retry", "bad_body"),
    ("openai-chat", "[]", "retry", "bad_body"),
    ("openai-chat", {"choices": []}, "retry", "bad_body"),
    ("openai-chat", {"id": "x", "choices": None, "usage": None}, "retry", "bad_body"),
    *((wire, {"status_page": "maintenance"}, "retry", "bad_body") for wire in FORMATS),
    ("anthropic", {"content": [], "stop_reason": "end_turn"}, "accept", "empty"),
    # Responses fail with status 200.
    ("openai-responses", failed("server_error"), "retry", "server_error"),
    ("openai-responses", failed("invalid_prompt"), "fail", "bad_prompt"),
    # One that ended early, whatever the reason.
    ("openai-responses", {"status": "incomplete", "output": []}, "accept", "truncated"),
    # So does OpenRouter, at the top or in the choice.
    ("openai-chat", openrouter(502), "retry", "server_error"),
    ("openai-chat", openrouter(503), "retry", "overloaded"),
    ("openai-chat", openrouter(400), "fail", "bad_request"),
    ("openai-chat", openrouter(402), "quota", "quota_exhausted"),
    ("openai-chat", openrouter(401), "refused", "not_allowed"),
    ("openai-chat", choice(error={"code": 502, "message": "m"}), "retry", "server_error"),
    ("openai-chat", choice(error={"code": 400, "message": "m"}), "fail", "bad_request"),
    ("openai-chat", choice("", "error"), "retry", "server_error"),
    (
        "openai-chat",
        {**choice("", "error"), "usage": {"prompt_tokens": None, "completion_tokens": None}},
        "retry",
        "server_error",
    ),
    ("openai-chat", {**choice("", "error"), "usage": None}, "retry", "server_error"),
    # The server broke its answer off, whatever else it sent.
    ("openai-chat", choice("M\nI am", "abort"), "retry", "server_error"),
    ("openai-chat", {**choice("M\nI am", "network_error"), "code": 0}, "retry", "server_error"),
    ("openai-chat", choice("M", "insufficient_system_resource"), "retry", "server_error"),
    ("openai-chat", {**choice("M", "error"), "status": "ok"}, "retry", "server_error"),
    ("openai-chat", {**choice("M", "abort"), "error": {"code": 503}}, "retry", "overloaded"),
    ("openai-chat", {"error": "m"}, "retry", "server_error"),
    ("openai-chat", openai("m", "insufficient_quota"), "quota", "quota_exhausted"),
    # A gateway passes on an error that came within a stream.
    *(
        (wire, body, "retry", outcome)
        for code, outcome in (
            ("overloaded_error", "overloaded"),
            ("service_unavailable_error", "overloaded"),
            ("api_error", "server_error"),
            ("timeout_error", "server_timeout"),
        )
        for wire, body in (
            ("openai-chat", openai("m", code)),
            ("openai-chat", anthropic(code)),
            ("anthropic", anthropic(code)),
            ("anthropic", {"error": {"type": code, "message": "m"}}),
            ("gemini", openai("m", "x", code)),
        )
    ),
    ("openai-chat", openai("m", "x", "529"), "retry", "overloaded"),
    ("openai-chat", openai("m", "x", 530), "retry", "server_error"),
    ("openai-chat", openai("m", "invalid_request_error"), "fail", "bad_request"),
    # MiniMax.
    ("openai-chat", minimax(1008, "insufficient balance"), "quota", "quota_exhausted"),
    ("openai-chat", minimax(1013, "internal"), "retry", "server_error"),
    ("openai-chat", minimax(1004, "no key"), "refused", "not_allowed"),
    ("openai-chat", choice() | minimax(0, ""), "accept", "ok"),
    # A quota of a day within a 200.
    ("openai-chat", openrouter(429, "free-models-per-day"), "quota", "quota_exhausted"),
]


@pytest.mark.parametrize("word", ["abort", "network_error", "insufficient_system_resource"])
def test_a_finish_reason_that_says_so_names_the_server_that_broke_off(word):
    found = judged("openai-chat", 200, choice("M\nI am", word))
    assert found.message == f"the server broke its answer off (finish reason {word})"
    assert (found.reading.finish_reason, found.delay_s) == (word, None)


@pytest.mark.parametrize(("wire", "body", "action", "outcome"), SUCCESSES)
def test_what_a_body_of_status_200_means(wire, body, action, outcome):
    found = judged(wire, 200, body)
    assert (found.action, found.name, found.pause) == (action, outcome, False)


AZURE_FILTER = {
    "message": "The response was filtered",
    "type": None,
    "param": "prompt",
    "code": "content_filter",
    "status": 400,
    "innererror": {"code": "ResponsibleAIPolicyViolation"},
}
OPENROUTER_FILTER = openrouter(403, "Your input was flagged", flagged_input="PROMPT", reasons=["x"])


@pytest.mark.parametrize(
    ("status", "body"), [(400, {"error": AZURE_FILTER}), (403, OPENROUTER_FILTER)]
)
def test_a_filter_is_a_refusal_and_no_failure(status, body):
    found = judged("openai-chat", status, body)
    assert (found.action, found.name) == ("accept", "refusal")
    assert found.reading.text == ""


@pytest.mark.parametrize(("status", "outcome"), [(200, "bad_body"), (500, "server_error")])
def test_a_body_that_is_nested_too_deep_is_no_json(status, outcome):
    found = judged("openai-chat", status, "[" * 100_000)
    assert (found.action, found.name) == ("retry", outcome)


@pytest.mark.parametrize(
    ("body", "message"),
    [
        (openai("the words"), "HTTP 400: the words"),
        (openai("the words\n* in  lines\n"), "HTTP 400: the words * in lines"),
        ([openai("the words")], "HTTP 400: the words"),
        ({"error": "the words"}, "HTTP 400: the words"),
        ({"message": "the words", "object": "error"}, "HTTP 400: the words"),
        ("some\n  text\twithout JSON", "HTTP 400: some text without JSON"),
        ("x" * 1000, "HTTP 400: " + "x" * 200),
        ("", "HTTP 400: no reason is given"),
    ],
)
def test_the_servers_words_are_the_message(body, message):
    assert judged("openai-chat", 400, body).message == message


def test_what_was_read_of_a_failed_answer_is_kept():
    body = {**failed("server_error"), "model": "m-1", "usage": {"input_tokens": 7}}
    reading = judged("openai-responses", 200, body).reading
    assert (reading.model_served, reading.usage.input_tokens) == ("m-1", 7)


NAMES = [
    *("error", "message", "type", "code", "status", "details", "choices", "violations"),
    *("quotaId", "retryDelay", "reason", "error_code", "finish_reason", "output"),
]
json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(NAMES), inner, max_size=4)
    ),
    max_leaves=12,
)


@settings(deadline=None)
@given(
    st.sampled_from(list(FORMATS)),
    st.sampled_from([200, 400, 402, 404, 429, 500]),
    st.text() | json_values.map(json.dumps),
)
# A digit, but not a decimal one.
@example("openai-chat", 200, '{"error": {"code": "²"}}')
def test_no_body_makes_it_raise(wire, status, body):
    found = judged(wire, status, body)
    assert found.action in ("accept", "retry", "fail", "quota", "refused")
    assert found.name


class Stubborn(WireFormat):
    """A format that understands a few errors otherwise than all others."""

    members = frozenset({"said"})

    def request(self, entry, prompt):
        return WireRequest("/", {})

    def read(self, payload):
        return Reading("error" if payload.get("error") else "ok")

    def meaning(self, error):
        return "request_too_large" if "insufficient_quota" in error.names else None

    def delay_s(self, error):
        return 11.0 if "soon" in error.names else None


@pytest.mark.parametrize(
    ("status", "code", "headers", "name", "delay_s"),
    [
        (429, "insufficient_quota", {}, "request_too_large", None),
        (503, "soon", {}, "overloaded", 11),
        (503, "soon", {"retry-after": "13"}, "overloaded", 13),
        # What only another format knows, as a gateway may pass it on.
        (400, "model_not_found", {}, "unknown_model", None),
        (429, "enforced_spend_limit_reached", {}, "quota_exhausted", None),
    ],
)  # fmt: skip
def test_a_formats_own_word_on_an_error_goes_before_that_of_others(
    status, code, headers, name, delay_s
):
    raw = RawReply(status, headers, json.dumps(openai(code=code)))
    found = judge(raw, Stubborn())
    assert (found.name, found.delay_s) == (name, delay_s)


OPENAI_ERROR = {"error": {"message": "m", "type": "server_error", "param": None, "code": None}}
GEMINI_ERROR = {"error": {"code": 503, "message": "m", "status": "UNAVAILABLE"}}
ANTHROPIC_ERROR = {"type": "error", "error": {"type": "overloaded_error", "message": "m"}}


@pytest.mark.parametrize(
    ("provider", "status", "body", "charged"),
    [
        ("openai", 500, OPENAI_ERROR, False),
        ("gemini", 503, GEMINI_ERROR, False),
        ("gemini", 503, [GEMINI_ERROR], False),
        ("anthropic", 529, ANTHROPIC_ERROR, False),
        ("openrouter", 502, {"error": {"code": 502, "message": "m"}}, False),
        # In no form that the provider documents, so that a proxy may have made it.
        ("openai", 500, {"error": {"message": "m"}}, True),
        ("openai", 502, "<html>502 Bad Gateway</html>", True),
        ("anthropic", 500, OPENAI_ERROR | {"error": "m"}, True),
        ("local", 500, OPENAI_ERROR, True),
        # For want of time, perhaps after the work.
        ("openai", 408, OPENAI_ERROR, True),
        ("gemini", 504, GEMINI_ERROR, True),
        (None, 499, OPENAI_ERROR, True),
        # Another server in the provider's format.
        (None, 500, OPENAI_ERROR, True),
        (None, 503, "", True),
        # Before any work.
        (None, 429, OPENAI_ERROR, False),
        (None, 401, "", False),
        (None, 404, "<html>", False),
        (None, 302, "", False),
        # What is not counted, or not to be understood.
        ("openai", 200, OPENAI_ERROR, True),
        (None, 201, "", True),
        ("openai", 500, OPENAI_ERROR | {"usage": {"prompt_tokens": 5}}, True),
        (None, 429, OPENAI_ERROR | {"usage": "much"}, True),
        # Azure charges for a prompt that its filter has read.
        (None, 400, {"error": {"code": "content_filter", "message": "m"}}, True),
        (None, 400, {"error": {"code": "context_length_exceeded", "message": "m"}}, True),
        ("openai", 400, {"error": {"code": "context_length_exceeded", "message": "m"}}, False),
        (None, 400, {"error": {"code": "unsupported_value", "message": "m"}}, False),
    ],
)
def test_what_may_be_charged_though_no_usage_is_told(provider, status, body, charged):
    text = body if isinstance(body, str) else json.dumps(body)
    assert may_be_charged(RawReply(status, {}, text), provider) == charged


@pytest.mark.parametrize("status", [400, 429, 500, 503])
def test_usage_in_an_error_is_read_in_every_format(status):
    bodies = {
        "openai-chat": {"usage": {"prompt_tokens": 7, "completion_tokens": 9}},
        "openai-responses": {"usage": {"input_tokens": 7, "output_tokens": 9}},
        "anthropic": {"usage": {"input_tokens": 7, "output_tokens": 9}},
        "gemini": {"usageMetadata": {"promptTokenCount": 7, "candidatesTokenCount": 9}},
    }
    for wire, told in bodies.items():
        body = json.dumps({"error": {"message": "m"}} | told)
        usage = judge(RawReply(status, {}, body), FORMATS[wire]).reading.usage
        assert (usage.input_tokens, usage.output_tokens) == (7, 9)


@pytest.mark.parametrize(
    ("body", "page"),
    [
        ("<!DOCTYPE html><p>", True),
        ("\ufeff\n <HTML lang=en>", True),
        ('{"html": "<html>"}', False),
        ("<hr>", False),
        ("", False),
    ],
)
def test_a_web_page_is_told_from_all_else(body, page):
    assert RawReply(200, {}, body).is_web_page == page
