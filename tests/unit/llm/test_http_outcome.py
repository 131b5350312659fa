"""What is made of each reply; the cases are in tests/cases/http_outcomes.toml."""

import json
from datetime import UTC, datetime

import pytest

from merge_runner.errors import UsageError
from merge_runner.llm.delays import server_delay_s
from merge_runner.llm.endpoint_state import reason_of, why_rejected
from merge_runner.llm.formats import FORMATS, Reading, WireFormat, WireRequest
from merge_runner.llm.http_outcome import RawReply, judge, may_be_charged
from merge_runner.providers import ModelEntry
from merge_runner.records import Usage
from tests.support.cases import by_format, cases, table


def judged(wire, status, body, headers=None):
    text = body if isinstance(body, str) else json.dumps(body)
    return judge(RawReply(status, headers or {}, text), FORMATS[wire])


@pytest.mark.parametrize(("wire", "case"), by_format("http_outcomes", "means"))
def test_what_a_reply_means(wire, case):
    status, (action, name) = case.get("status", 200), case["means"].split()
    found = judged(wire, status, case["body"], case.get("headers"))
    assert (found.action, found.name, found.pause) == (action, name, name == "rate_limited")
    if name == "rate_limited":
        assert found.delay_s == case.get("wait_s")
    if status != 200:
        assert (found.reading.outcome, found.reading.text) == ("error", "")
        assert action == "accept" or str(status) in found.message


def openrouter(message, **within):
    return {"error": {"code": 429, "message": message, "metadata": {"headers": within}}}


@pytest.mark.parametrize("case", cases("http_outcomes", "resets"))
def test_the_reset_of_a_used_up_limit_is_a_delay(case):
    body = json.dumps(openrouter("Rate limit exceeded", **case.get("within", {})))
    error = RawReply(429, case.get("headers", {}), body).error
    now = datetime.fromtimestamp(1_800_000_000, UTC)
    assert server_delay_s(error, FORMATS["openai-chat"], now) == case.get("delay_s")


def test_a_quota_of_a_day_says_when_it_opens_again_unless_that_is_not_known():
    told = openrouter("free-models-per-day", **{"X-RateLimit-Reset": "1999999999000"})
    assert judged("openai-chat", 200, told).delay_s > 1e6
    details = [{"violations": [{"quotaId": "RequestsPerDayPerProject"}]}, {"retryDelay": "38s"}]
    day = {"error": {"code": 429, "status": "RESOURCE_EXHAUSTED", "details": details}}
    spent = {"error": {"message": "m", "type": "insufficient_quota"}}
    for found in (
        judged("gemini", 429, day),
        judged("openai-chat", 429, spent, {"retry-after": "1"}),
    ):
        assert (found.name, found.delay_s) == ("quota_exhausted", None)


def test_what_came_in_the_place_of_an_answer_is_in_the_message():
    events = 'data: {"choices": [{"delta": {"content": "M"}}]}\n\ndata: [DONE]\n'
    message = judged("openai-chat", 200, events, {"content-type": "text/event-stream"}).message
    assert "text/event-stream: data: {" in message
    assert "\n" not in message
    long = judged("openai-chat", 200, {"status": "x" * 1000}, {"content-type": "text/json"})
    assert "text/json: " in long.message
    assert len(long.message) < 300


@pytest.mark.parametrize("case", cases("http_outcomes", "first_call"))
def test_what_no_call_of_a_run_would_fare_better_with(case):
    outcome = judged("openai-chat", case.get("status", 200), case["body"], case.get("headers"))
    reason = case.get("reason")
    assert reason_of(outcome, "http://localhost/v1/chat/completions") == reason
    if reason is not None:
        entry = ModelEntry(provider="local", format="openai-chat", id="m", max_output_tokens=10)
        assert "\n" not in why_rejected(reason, entry, outcome)


@pytest.mark.parametrize(("url", "reason"), table("http_outcomes", "urls").items())
def test_a_path_that_stands_twice_in_a_url_is_no_unknown_model(url, reason):
    body = {"type": "error", "error": {"type": "not_found_error", "message": "m"}}
    assert reason_of(judged("anthropic", 404, body), url) == reason


@pytest.mark.parametrize("word", ["abort", "network_error", "insufficient_system_resource"])
def test_a_finish_reason_that_says_so_names_the_server_that_broke_off(word):
    choice = {"message": {"content": "M\nI am"}, "finish_reason": word}
    found = judged("openai-chat", 200, {"choices": [choice]})
    assert found.message == f"the server broke its reply off (finish reason {word})"
    assert (found.reading.finish_reason, found.delay_s) == (word, None)


@pytest.mark.parametrize("case", cases("http_outcomes", "words"))
def test_the_servers_words_are_the_message(case):
    assert judged("openai-chat", 400, case["body"]).message == f"HTTP 400: {case['says']}"


def test_what_was_read_of_a_failed_answer_is_kept():
    told = {"status": "failed", "error": {"code": "server_error", "message": "m"}}
    body = told | {"model": "m-1", "usage": {"input_tokens": 7}}
    reading = judged("openai-responses", 200, body).reading
    assert (reading.model_served, reading.usage.input_tokens) == ("m-1", 7)


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


@pytest.mark.parametrize("case", cases("http_outcomes", "own_word"))
def test_a_formats_own_word_on_an_error_goes_before_that_of_others(case):
    body = {"error": {"message": "m", "type": "invalid_request_error", "code": case["code"]}}
    reply = RawReply(case["status"], case.get("headers", {}), json.dumps(body))
    found = judge(reply, Stubborn())
    assert (found.name, found.delay_s) == (case["is"], case.get("delay_s"))


class Faulty(Stubborn):
    """A format that expects too much."""

    def read(self, payload):
        return Reading(payload["said"])


def test_a_format_that_fails_is_told_in_one_line_with_its_place():
    told = r"^the wire format Faulty fails in test_http_outcome.py, line \d+: KeyError: 'said'$"
    with pytest.raises(UsageError, match=told):
        judge(RawReply(200, {}, "{}"), Faulty())


@pytest.mark.parametrize("case", cases("http_outcomes", "charged"))
def test_what_may_be_charged_though_no_usage_is_told(case):
    reply = RawReply(case["status"], {}, case["body"])
    assert may_be_charged(reply, case.get("provider")) == case["charged"]


@pytest.mark.parametrize(("wire", "case"), by_format("wire_bodies", "usage"))
def test_usage_in_an_error_is_read_in_every_format(wire, case):
    told = {"usageMetadata" if wire == "gemini" else "usage": json.loads(case["body"])}
    counts = Usage(*(None if count == -1 else count for count in case["counts"]))
    for status in (400, 429, 500, 503):
        assert judged(wire, status, {"error": {"message": "m"}} | told).reading.usage == counts


def test_a_web_page_is_told_from_all_else():
    pages = ("<!DOCTYPE html><p>", "\ufeff\n <HTML lang=en>", '{"html": "<html>"}', "<hr>", "")
    assert [RawReply(200, {}, body).is_web_page for body in pages] == [True, True, *[False] * 3]
