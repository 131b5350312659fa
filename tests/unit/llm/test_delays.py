"""How long a server asks to wait, by headers, details or words."""

from datetime import UTC, datetime

import pytest

from merge_runner.llm.formats import FORMATS, read_error
from merge_runner.llm.http_outcome import server_delay_s
from tests.support.cases import table

NOW = datetime(2026, 10, 21, 7, 28, 0, tzinfo=UTC)


def delay(headers=None, payload=None):
    return server_delay_s(read_error(429, headers or {}, "", payload), FORMATS["openai-chat"], NOW)


def message(text):
    return {"error": {"message": text, "type": "tokens", "code": "rate_limit_exceeded"}}


def retry_info(duration):
    kind = "type.googleapis.com/google.rpc."
    details = [
        {"@type": f"{kind}QuotaFailure", "violations": [{"quotaId": "PerMinute"}]},
        {"@type": f"{kind}RetryInfo", "retryDelay": duration},
    ]
    return {"error": {"code": 429, "message": "Please retry in 38.8s.", "details": details}}


@pytest.mark.parametrize(("text", "seconds"), table("http_outcomes", "delays").items(), ids=str)
def test_a_delay_in_the_message(text, seconds):
    assert delay(payload=message(text)) == (None if seconds == "none" else pytest.approx(seconds))


GMT = "Wed, 21 Oct 2026 07:28:30 GMT"


@pytest.mark.parametrize(
    ("name", "value", "seconds"),
    [
        ("retry-after-ms", "1500", 1.5),
        ("retry-after-ms", "0.5", 0.0005),
        ("retry-after", "7", 7),
        ("retry-after", "0.25", 0.25),
        ("retry-after", GMT, 30),
        ("retry-after", "Wed, 21 Oct 2026 09:28:30 +0200", 30),
        # Without a zone the date is UTC, as HTTP has it.
        ("retry-after", "Wed, 21 Oct 2026 07:29:00 -0000", 60),
        # Of several the longest counts.
        ("retry-after", "7, 3600", 3600),
        ("retry-after", "3600,7", 3600),
        ("retry-after", "soon, 7, nan, -1, inf", 7),
        ("retry-after", f"{GMT}, 7", 30),
        ("retry-after", f"7, {GMT}", 30),
        ("retry-after", "99999999999", 99999999999),
        ("retry-after", "Wed, 21 Oct 2026 07:28:30 +99999999999999999999", None),
        ("retry-after", "Wed, 21 Oct 2026 07:28:30 +9999, 7", 7),
        ("retry-after", "Wed, 21 Oct 2026 07:27:30 GMT", None),
        ("retry-after-ms", "250, 1500", 1.5),
    ],
)
def test_of_several_delays_the_longest_counts(name, value, seconds):
    assert delay({name: value}) == (seconds and pytest.approx(seconds))


@pytest.mark.parametrize(
    ("payload", "seconds"),
    [
        *((retry_info(told), float(told[:-1])) for told in ("34s", "45.837906927s", "0.5s")),
        ({"error": "busy, try again in 7s"}, 7),
        ({"object": "error", "message": "busy, try again in 7s"}, 7),
        ({"choices": [{"error": {"code": 429, "message": "busy, try again in 7s"}}]}, 7),
        (None, None),
        ([], None),
        ("text", None),
        ({}, None),
        ({"error": None}, None),
        ({"error": "text"}, None),
        ({"error": {"message": None, "details": None}}, None),
        ({"error": {"details": [None, "x", {"retryDelay": 5}, {"retryDelay": "soon"}]}}, None),
    ],
    ids=str,
)
def test_a_delay_is_read_from_an_error_of_any_shape(payload, seconds):
    assert delay(payload=payload) == seconds


# Every source with its delay, in the order in which they are believed.
SOURCES = [
    ({"retry-after-ms": "1000"}, {}, 1),
    ({"retry-after": "2"}, {}, 2),
    ({}, {"details": [{"retryDelay": "3s"}]}, 3),
    ({}, {"message": "Please try again in 4s."}, 4),
]


@pytest.mark.parametrize("first", range(len(SOURCES)))
def test_the_order_of_the_sources(first):
    headers, error = {}, {}
    for more_headers, more_error, _ in SOURCES[first:]:
        headers.update(more_headers)
        error.update(more_error)
    assert delay(headers, {"error": error}) == SOURCES[first][2]


@pytest.mark.parametrize("useless", ["0", "-1", "soon", "", "nan", "inf"])
@pytest.mark.parametrize("name", ["retry-after-ms", "retry-after"])
def test_a_source_that_says_nothing_usable_gives_way_to_the_next(name, useless):
    assert delay({name: useless}, message("Please try again in 4s.")) == 4
    assert delay({name: useless}) is None
