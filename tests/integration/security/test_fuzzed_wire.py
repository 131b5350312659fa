"""Whatever headers say: an answer or a named failure, and a delay that a clock can wait for."""

import asyncio
import json
import math

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from merge_runner.llm.delays import server_delay_s
from merge_runner.llm.formats import FORMATS
from merge_runner.llm.formats.server_error import read_error
from merge_runner.llm.http import HttpTransport
from merge_runner.llm.http_outcome import RawReply, TransportFailure, judge, may_be_charged
from merge_runner.providers import Endpoint
from tests.support.cases import table
from tests.support.json_values import paths
from tests.support.raw_server import CHAT, a_request, raw_server

PIECES = table("wire_fuzz")
ODD = [*PIECES["values"], "9" * 5000, "99d" * 99]
VALUES = st.one_of(
    st.sampled_from(ODD),
    st.lists(st.sampled_from(ODD), max_size=4).map(", ".join),
    st.floats().map(str),
    st.datetimes().map(lambda moment: f"{moment:%a, %d %b %Y %H:%M:%S} +{moment.microsecond}"),
    st.text(max_size=40),
)
HEADERS = st.dictionaries(st.sampled_from(PIECES["delays"] + PIECES["framing"]), VALUES, max_size=4)
STATUSES = st.one_of(st.sampled_from([200, 400, 402, 403, 429, 500, 503]), st.integers(100, 999))
SAMPLES = [json.loads(body) for body in table("wire_bodies", "samples").values()]
NAMES = [
    *sorted({path[-1] for sample in SAMPLES for path in paths(sample)} - {0, 1}, key=str),
    *("error", "message", "code", "type", "details", "violations", "quotaId", "retryDelay"),
    *("reason", "error_code"),
]
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(NAMES), inner, max_size=4)
    ),
    max_leaves=12,
)


@given(HEADERS, JSON)
@example({"retry-after": "Mon, 01 Jan 2026 00:00:00 -99999999999999999999"}, None)
@example({"retry-after": "Wed, 21 Oct 2026 07:28:00 +99999999999"}, None)
def test_fuzz_of_headers_every_delay_is_one_that_can_be_waited_for(headers, payload):
    delay_s = server_delay_s(read_error(429, headers, "", payload), FORMATS["openai-chat"])
    assert delay_s is None or (delay_s > 0 and math.isfinite(delay_s))


@given(
    STATUSES, HEADERS, st.text(max_size=80) | JSON.map(json.dumps), st.sampled_from(sorted(FORMATS))
)
@example(200, {}, "[" * 100_000, "gemini")
@example(500, {}, '{"error": {"code": ' + "9" * 5000 + "}}", "openai-chat")
@example(429, {}, '{"error": {"message": 5, "details": [{"violations": [5]}]}}', "gemini")
@example(200, {}, '{"error": {"code": "²"}}', "openai-chat")  # a digit, but not a decimal one
def test_fuzz_of_replies_every_reply_has_an_outcome(status, headers, body, wire):
    raw = RawReply(status, headers, body)
    found = judge(raw, FORMATS[wire])
    assert found.action in {"accept", "retry", "fail", "quota", "rejected"}
    assert (bool(found.name), isinstance(found.reading.text, str)) == (True, True)
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
            return exc.outcome.name

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
