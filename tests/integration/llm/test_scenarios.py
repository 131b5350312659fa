"""What becomes of a call in every scenario, in every format of it.

The real client asks an emulator over loopback, in virtual time: see virtual_time.py.
"""

from __future__ import annotations

import os
from contextlib import asynccontextmanager
from dataclasses import dataclass

import aiohttp
import pytest

from merge_runner.config import Endpoint, ModelEntry
from merge_runner.emulator.driver import answer
from merge_runner.errors import CallFailed, EndpointRefused, QuotaExhausted
from merge_runner.llm.cache import ResponseCache
from merge_runner.llm.client import LlmClient
from merge_runner.llm.http import HttpTransport
from merge_runner.llm.http_outcome import FIRST_BACKOFF_S, LONGEST_BACKOFF_S, backoff_s
from merge_runner.llm.limiter import Limiter
from merge_runner.records import Slot
from tests.support.scenarios import SCENARIOS
from tests.support.scenarios.playing import ScenarioPlan, playing
from tests.support.virtual_time import in_virtual_time, now_s

CHAT, RESPONSES, GEMINI, ANTHROPIC = "openai-chat", "openai-responses", "gemini", "anthropic"
OPENAI = (CHAT, RESPONSES)
ALL = (CHAT, RESPONSES, GEMINI, ANTHROPIC)
MODELS = {
    CHAT: "o3-2025-04-16",
    RESPONSES: "o3-2025-04-16",
    GEMINI: "gemini-2.5-pro",
    ANTHROPIC: "claude-sonnet-4-6",
}
TIMEOUT_S, DEADLINE_S = 600, 1200
EXIT_CODES = {CallFailed: 1, EndpointRefused: 2, QuotaExhausted: 3}

# What is an answer: scenario, formats, outcome, attempts, and what is told of it.
ANSWERS = [
    ("openai/ok", OPENAI, "ok", 1, "model_served='o3-2025-04-16'"),
    ("openai/cached_tokens", OPENAI, "ok", 1, "cached_input_tokens=896, output_tokens=900"),
    ("openai/refusal", OPENAI, "refusal", 1, "I cannot help with that"),
    ("openai/length", [CHAT], "truncated", 1, "finish_reason='length'"),
    ("openai/length", [RESPONSES], "truncated", 1, "finish_reason='max_output_tokens'"),
    ("openai/content_filter", OPENAI, "refusal", 1, "finish_reason='content_filter'"),
    ("gemini/ok", [GEMINI], "ok", 1, "model_served='gemini-2.5-pro'"),
    ("gemini/thoughts", [GEMINI], "ok", 1, "finish_reason='STOP'"),
    ("gemini/substituted", [GEMINI], "ok", 1, "gemini-2.5-pro -> gemini-3.8-flash"),
    ("gemini/max_tokens_no_parts", [GEMINI], "truncated", 1, "reasoning_tokens=15996"),
    ("gemini/max_tokens_no_content", [GEMINI], "truncated", 1, "finish_reason='MAX_TOKENS'"),
    ("gemini/max_tokens_no_text", [GEMINI], "truncated", 1, "finish_reason='MAX_TOKENS'"),
    ("gemini/empty_stop", [GEMINI], "empty", 3, "finish_reason='STOP'"),
    ("gemini/no_candidates", [GEMINI], "empty", 3, "finish_reason=None"),
    ("gemini/safety", [GEMINI], "refusal", 1, "finish_reason='SAFETY'"),
    ("gemini/recitation", [GEMINI], "refusal", 1, "finish_reason='RECITATION'"),
    ("gemini/other", [GEMINI], "refusal", 1, "finish_reason='OTHER'"),
    ("gemini/prompt_blocked", [GEMINI], "refusal", 1, "finish_reason='PROHIBITED_CONTENT'"),
    ("anthropic/ok", [ANTHROPIC], "ok", 1, "model_served='claude-sonnet-4-6'"),
    ("anthropic/thinking_first", [ANTHROPIC], "ok", 1, "finish_reason='end_turn'"),
    ("anthropic/max_tokens", [ANTHROPIC], "truncated", 1, "finish_reason='max_tokens'"),
    ("anthropic/refusal", [ANTHROPIC], "refusal", 1, "finish_reason='refusal'"),
    ("openrouter/null_usage", [CHAT], "ok", 1, "output_tokens=None"),
    ("azure/content_filter", [CHAT], "refusal", 1, "content management policy"),
    ("network/slow", ALL, "ok", 1, ""),
]

# What no other attempt would mend: scenario, formats, the attempt's outcome, error, its words.
UNKNOWN = "has no model 'o3-2025-04-16'"
STOPS = [
    ("openai/failed_invalid_prompt", [RESPONSES], "bad_prompt", CallFailed, "flagged"),
    ("openai/temperature", OPENAI, "bad_request", CallFailed, "does not support 0.2"),
    ("openai/max_tokens", OPENAI, "bad_request", CallFailed, "Use 'max_completion_tokens'"),
    ("openai/stream_unverified", OPENAI, "bad_request", CallFailed, "must be verified"),
    ("openai/context_length", OPENAI, "bad_request", CallFailed, "maximum context length"),
    ("openai/request_too_large", OPENAI, "request_too_large", CallFailed, "Requested 31538"),
    ("openai/bad_key", OPENAI, "not_allowed", EndpointRefused, "does not accept the key"),
    ("openai/forbidden", OPENAI, "not_allowed", EndpointRefused, "region, or territory"),
    ("openai/no_model", OPENAI, "unknown_model", EndpointRefused, UNKNOWN),
    ("openai/shut_down", OPENAI, "unknown_model", EndpointRefused, UNKNOWN),
    ("openai/insufficient_quota", OPENAI, "quota_exhausted", QuotaExhausted, "plan and billing"),
    ("openai/credit_exhausted", OPENAI, "quota_exhausted", QuotaExhausted, "is exhausted"),
    ("gemini/budget_0", [GEMINI], "bad_request", CallFailed, "Budget 0 is invalid"),
    ("gemini/bad_key", [GEMINI], "not_allowed", EndpointRefused, "API key not valid"),
    ("gemini/forbidden", [GEMINI], "not_allowed", EndpointRefused, "unregistered callers"),
    ("gemini/not_for_new_users", [GEMINI], "unknown_model", EndpointRefused, "new users"),
    ("gemini/credits_depleted", [GEMINI], "quota_exhausted", QuotaExhausted, "are depleted"),
    ("gemini/per_day", [GEMINI], "quota_exhausted", QuotaExhausted, "is exhausted"),
    ("anthropic/temperature", [ANTHROPIC], "bad_request", CallFailed, "temperature"),
    ("anthropic/no_max_tokens", [ANTHROPIC], "bad_request", CallFailed, "max_tokens"),
    ("anthropic/no_version", [ANTHROPIC], "bad_request", CallFailed, "anthropic-version"),
    ("anthropic/too_large", [ANTHROPIC], "bad_request", CallFailed, "exceeds the maximum size"),
    ("anthropic/spend_limit", [ANTHROPIC], "quota_exhausted", QuotaExhausted, "usage limits"),
    ("vllm/nested", [CHAT], "bad_request", CallFailed, "maximum context length is 8192"),
    ("vllm/flat", [CHAT], "bad_request", CallFailed, "maximum context length is 8192"),
    ("ollama/string", [CHAT], "unknown_model", EndpointRefused, "try pulling it first"),
    ("litellm/budget", [CHAT], "quota_exhausted", QuotaExhausted, "Budget has been exceeded"),
]


@dataclass(frozen=True)
class Passes:
    """What another attempt may mend: the attempt's outcome, and the words where none does.

    ``delay_s`` is what the server asks to wait, ``takes_s`` the time until an attempt fails.
    """

    scenario: str
    formats: tuple[str, ...]
    outcome: str
    says: str
    delay_s: float = 0.0
    takes_s: float = 0.0


PASSES = [
    Passes("openai/failed_server_error", (RESPONSES,), "server_error", "had an error"),
    Passes("openai/failed_rate_limit", (RESPONSES,), "rate_limited", "limit", delay_s=34.337),
    Passes("openai/requests_per_minute", OPENAI, "rate_limited", "Limit 500"),
    Passes("openai/tokens_per_minute", OPENAI, "rate_limited", "Used 162960", delay_s=1.574),
    Passes("openai/flex_unavailable", OPENAI, "rate_limited", "Resource Unavailable"),
    Passes("openai/server_error", OPENAI, "server_error", "Sorry about that"),
    Passes("openai/bad_gateway", OPENAI, "server_error", "502 Bad Gateway"),
    Passes("openai/overloaded", OPENAI, "overloaded", "currently overloaded", delay_s=20),
    Passes("openai/gateway_timeout", OPENAI, "server_timeout", "upstream request timeout"),
    Passes("gemini/per_minute", (GEMINI,), "rate_limited", "quota", delay_s=45.837906927),
    Passes("gemini/bare", (GEMINI,), "rate_limited", "Resource has been exhausted"),
    Passes("gemini/listed", (GEMINI,), "rate_limited", "quota", delay_s=38),
    Passes("gemini/server_error", (GEMINI,), "server_error", "An internal error has occurred"),
    Passes("gemini/overloaded", (GEMINI,), "overloaded", "The model is overloaded"),
    Passes("gemini/deadline", (GEMINI,), "server_timeout", "Deadline expired"),
    Passes("anthropic/rate_limit", (ANTHROPIC,), "rate_limited", "rate limit"),
    Passes("anthropic/overloaded", (ANTHROPIC,), "overloaded", "Overloaded"),
    Passes("llamacpp/loading", (CHAT,), "overloaded", "Loading model"),
    Passes("openrouter/error_in_200", (CHAT,), "server_error", "Provider returned error"),
    Passes("openrouter/finish_error", (CHAT,), "server_error", "Provider returned error"),
    Passes("litellm/string_code", (CHAT,), "rate_limited", "litellm.RateLimitError"),
    Passes("azure/integer_reset", (CHAT,), "rate_limited", "limit"),
    Passes("azure/words", (CHAT,), "rate_limited", "S0 pricing tier", delay_s=26),
    Passes("network/hang", ALL, "timeout", "no reply within", takes_s=TIMEOUT_S),
    Passes("network/reset", ALL, "connection_lost", "Connection reset by peer"),
    Passes("network/truncated_body", ALL, "connection_lost", "received 11 of 5000 bytes"),
    Passes("network/truncated_json", ALL, "bad_body", "not a JSON object"),
]
WALL_CLOCK_S = 0.6


@pytest.fixture(autouse=True)
def _no_settings_of_the_user(monkeypatch, tmp_path):
    for name in list(os.environ):
        if name.upper().endswith("_PROXY"):
            monkeypatch.delenv(name)
    # Nothing here speaks TLS, and to load the certificates takes longer than most of the tests.
    monkeypatch.delenv("SSL_CERT_FILE", raising=False)
    monkeypatch.setenv("SSL_CERT_DIR", str(tmp_path))


@pytest.fixture(autouse=True)
def _idle_connections_grow_old_in_virtual_time(monkeypatch):
    monkeypatch.setattr(aiohttp.connector, "monotonic", now_s)


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    """One folder for all tests: to make a durable one takes a while."""
    cache = ResponseCache(tmp_path_factory.mktemp("responses"))
    yield cache
    cache.close()


def entry_of(wire):
    return ModelEntry(
        provider="openai",
        format=wire,
        id=MODELS[wire],
        max_output_tokens=16000,
        shutdown="2026-12-11",
        price="free",
        timeout_s=TIMEOUT_S,
        deadline_s=DEADLINE_S,
    )


@asynccontextmanager
async def client_of(cache, wire, plan):
    """A client of an emulator that plays a plan."""
    entry, identity = entry_of(wire), f"{plan} {wire}"
    async with playing(plan) as url:
        base_url = f"{url}/v1" if wire in OPENAI else url
        transport = HttpTransport(Endpoint("openai", identity, base_url, {}), connections=4)
        try:
            yield LlmClient(
                name="my-model",
                entry=entry,
                endpoint=identity,
                cache=cache,
                transport=transport,
                limiter=Limiter(),
            )
        finally:
            await transport.close()


def always(scenario, **changes):
    """A hang lasts longer than any deadline."""
    return ScenarioPlan(scenario=scenario, hang_s=10 * DEADLINE_S, **changes)


def ask(client):
    return client.ask("prompt", Slot("N_0_0", 1, "left", 0, 0))


def per_format(rows):
    """A case for each row and format, with a readable id."""
    cases = []
    for row in rows:
        scenario, formats, *rest = (
            (row.scenario, row.formats, row) if isinstance(row, Passes) else row
        )
        cases += [pytest.param(scenario, w, *rest, id=f"{scenario} {w}") for w in formats]
    return cases


def attempts_until_deadline(row, jitter_s):
    """How many attempts there are if every wait has so much jitter."""
    used_s, attempts = 0.0, 0
    while used_s < DEADLINE_S:
        attempts += 1
        used_s += min(row.takes_s, DEADLINE_S - used_s)
        used_s += max(row.delay_s, min(backoff_s(attempts) + jitter_s, LONGEST_BACKOFF_S))
    return attempts


def test_every_scenario_has_its_row_in_every_format():
    listed = [case.id for rows in (ANSWERS, STOPS, PASSES) for case in per_format(rows)]
    assert sorted(listed) == sorted(
        f"{scenario} {wire}" for scenario, scenes in SCENARIOS.items() for wire in scenes
    )


@pytest.mark.parametrize(("scenario", "wire", "outcome", "attempts", "says"), per_format(ANSWERS))
@in_virtual_time
async def test_an_answer_is_kept_as_what_it_is(cache, scenario, wire, outcome, attempts, says):
    async with client_of(cache, wire, always(scenario)) as client:
        reply = await ask(client)
        waited_s = now_s()
        mismatches = client.meter.mismatches
        again = await ask(client)
    assert [attempt.outcome for attempt in reply.attempts] == [outcome] * attempts
    assert reply.outcome == outcome
    assert says in f"{reply.text} {reply.attempts[-1]} {list(mismatches)}"
    assert (reply.text == answer("prompt", None)) == (outcome == "ok")
    retried = [backoff_s(n) for n in range(1, attempts)]
    takes_s = 35 if scenario == "network/slow" else 0
    assert takes_s + sum(retried) <= waited_s
    assert waited_s <= takes_s + sum(retried) + FIRST_BACKOFF_S * len(retried) + 0.1
    assert (again.cached, again.text) == (True, reply.text)


@pytest.mark.parametrize(("scenario", "wire", "outcome", "error", "says"), per_format(STOPS))
@in_virtual_time
async def test_what_no_attempt_would_mend_is_not_tried_again(
    cache, scenario, wire, outcome, error, says
):
    async with client_of(cache, wire, always(scenario)) as client:
        with pytest.raises(error) as caught:
            await ask(client)
    assert client.meter.outcomes == {outcome: 1}
    assert caught.value.exit_code == EXIT_CODES[error]
    message = str(caught.value)
    assert "my-model" in message
    assert says in message
    assert "\n" not in message
    assert now_s() < 0.1


@pytest.mark.parametrize(("scenario", "wire", "row"), per_format(PASSES))
@in_virtual_time
async def test_what_passes_is_tried_again_after_the_servers_delay(cache, scenario, wire, row):
    async with client_of(cache, wire, always(scenario, first_alone=True)) as client:
        reply = await ask(client)
        waited_s = now_s() - row.takes_s
    assert [attempt.outcome for attempt in reply.attempts] == [row.outcome, "ok"]
    assert reply.text == answer("prompt", None)
    tolerance_s = WALL_CLOCK_S if scenario == "anthropic/rate_limit" else 0.1
    assert max(row.delay_s, FIRST_BACKOFF_S) - tolerance_s <= waited_s
    assert waited_s <= max(row.delay_s, 2 * FIRST_BACKOFF_S) + tolerance_s


@pytest.mark.parametrize(("scenario", "wire", "row"), per_format(PASSES))
@in_virtual_time
async def test_what_does_not_pass_fails_at_the_deadline(cache, scenario, wire, row):
    async with client_of(cache, wire, always(scenario)) as client:
        with pytest.raises(CallFailed) as caught:
            await ask(client)
        waited_s = now_s()
    attempts = [attempt.outcome for attempt in caught.value.attempts]
    assert set(attempts) == {row.outcome}
    fewest, most = (attempts_until_deadline(row, jitter_s) for jitter_s in (FIRST_BACKOFF_S, 0))
    assert fewest <= len(attempts) <= most
    assert DEADLINE_S - max(row.delay_s, LONGEST_BACKOFF_S) - 1 <= waited_s <= DEADLINE_S
    assert caught.value.exit_code == 1
    message = str(caught.value)
    assert f"no answer within {DEADLINE_S} s" in message
    assert row.says in message
    assert f"{len(attempts)} attempts" in message
    assert "\n" not in message
