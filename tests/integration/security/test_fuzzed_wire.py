"""Whatever headers say: an answer or a named failure, and a delay that a clock can wait for."""

from __future__ import annotations

import asyncio
import math

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from merge_runner.config import Endpoint
from merge_runner.llm.formats import FORMATS, read_error
from merge_runner.llm.http import HttpTransport
from merge_runner.llm.http_outcome import (
    RawReply,
    TransportFailure,
    judge,
    may_be_charged,
    server_delay_s,
)
from tests.support.raw_server import CHAT, a_request, raw_server

DELAYS = (
    *("retry-after", "retry-after-ms", "x-should-retry", "x-ratelimit-remaining-requests"),
    *("x-ratelimit-reset-requests", "x-ratelimit-remaining-tokens", "x-ratelimit-reset-tokens"),
    *("anthropic-ratelimit-tokens-remaining", "anthropic-ratelimit-tokens-reset"),
)
FRAMING = (
    *("content-length", "content-encoding", "content-type", "transfer-encoding", "connection"),
    *("set-cookie", "x-request-id", "x-merge-runner-scripted", "location", "trailer", "upgrade"),
)
NUMBERS = ("0", "-1", "1e400", "nan", "inf", "-inf", "1_0", "٣", "0x10", "9" * 5000, "1" * 19, "+5")
DATES = (
    "Wed, 21 Oct 2026 07:28:00 GMT",
    "Mon, 01 Jan 2026 00:00:00 +9999",
    "Mon, 01 Jan 2026 00:00:00 -99999999999999999999",
    "Mon, 99 Jan 99999 99:99:99 GMT",
    "01 Jan 0001 00:00:00 +2359",
    "9999-12-31T23:59:59-23:59",
    "0001-01-01T00:00:00+23:59",
)
WORDS = (
    *("true", "false", "gzip", "br", "zstd", "deflate", "gzip, gzip", "chunked", "identity"),
    *("application/json; charset=zlib", "text/html; charset=idna", "a=b; Path=/", "websocket", ""),
    *("charset=rot13", "charset=undefined", "charset=\x00", "close"),
    *("6m0s", "1h30m", "5 minutes", "99d" * 99),
)
VALUES = st.one_of(
    st.sampled_from([*NUMBERS, *DATES, *WORDS]),
    st.lists(st.sampled_from([*NUMBERS, *DATES, *WORDS]), max_size=4).map(", ".join),
    st.floats().map(str),
    st.datetimes().map(lambda moment: f"{moment:%a, %d %b %Y %H:%M:%S} +{moment.microsecond}"),
    st.text(max_size=40),
)
HEADERS = st.dictionaries(st.sampled_from(DELAYS + FRAMING), VALUES, max_size=4)
STATUSES = st.one_of(st.sampled_from([200, 400, 402, 403, 429, 500, 503]), st.integers(100, 999))
NAMES = ("error", "message", "code", "type", "details", "choices", "usage", "retryDelay", "id")
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(NAMES), inner, max_size=3)
    ),
    max_leaves=6,
)


@given(HEADERS, JSON)
@example({"retry-after": "Mon, 01 Jan 2026 00:00:00 -99999999999999999999"}, None)
@example({"retry-after": "Wed, 21 Oct 2026 07:28:00 +99999999999"}, None)
def test_fuzz_of_headers_every_delay_is_one_that_can_be_waited_for(headers, payload):
    delay_s = server_delay_s(read_error(429, headers, "", payload), FORMATS["openai-chat"])
    assert delay_s is None or (delay_s > 0 and math.isfinite(delay_s))


@given(STATUSES, HEADERS, st.text(max_size=80) | JSON.map(str), st.sampled_from(sorted(FORMATS)))
@example(200, {}, "[" * 100_000, "gemini")
@example(500, {}, '{"error": {"code": ' + "9" * 5000 + "}}", "openai-chat")
def test_fuzz_of_replies_every_reply_has_an_outcome(status, headers, body, wire):
    raw = RawReply(status, headers, body)
    assert judge(raw, FORMATS[wire]).action in {"accept", "retry", "fail", "quota", "refused"}
    for provider in ("openai", None):
        assert may_be_charged(raw, provider) in (True, False)


@pytest.fixture(scope="module")
def answered():
    """What the transport makes of the bytes that a server answers with: its outcome or status."""

    async def ask(transport, answers, raw):
        answers[:] = [raw]
        try:
            return (await transport.send(a_request(), attempt=1, timeout_s=0.1)).status
        except TransportFailure as exc:
            return exc.outcome

    async def say(talk, _):
        await talk.say(answers[0])
        talk.close()

    answers = []
    with asyncio.Runner() as runner:
        server = raw_server(say)
        url = runner.run(server.__aenter__()).url
        transport = HttpTransport(Endpoint("openai", "openai", url, {}), connections=1)
        yield lambda raw: runner.run(ask(transport, answers, raw))
        runner.run(transport.close())
        runner.run(server.__aexit__(None, None, None))


@given(STATUSES, HEADERS, st.sampled_from([CHAT, b"", b"{", b"\x1f\x8b\x08", CHAT * 2]))
@example(200, {"content-type": "application/json; charset=zlib"}, CHAT)
def test_fuzz_of_heads_the_transport_has_a_reply_or_a_named_failure(
    answered, status, headers, body
):
    lines = [f"HTTP/1.1 {status} X", *(f"{name}: {value}" for name, value in headers.items())]
    raw = "\r\n".join([*lines, "", ""]).encode("latin-1", "replace") + body
    assert answered(raw) in {
        *range(1000),
        *("connection_lost", "timeout", "reply_refused", "wrong_answer", "no_connection"),
    }
