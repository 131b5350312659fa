"""How long a server asks to wait, by headers, details or words."""

import json
from datetime import UTC, datetime

import pytest

from merge_runner.llm.delays import server_delay_s
from merge_runner.llm.formats import FORMATS
from merge_runner.llm.formats.server_error import read_error
from tests.support.cases import table

NOW = datetime(2026, 10, 21, 7, 28, 0, tzinfo=UTC)


def delay(headers=None, payload=None):
    return server_delay_s(read_error(429, headers or {}, "", payload), FORMATS["openai-chat"], NOW)


def message(text):
    return {"error": {"message": text, "type": "tokens", "code": "rate_limit_exceeded"}}


@pytest.mark.parametrize(("text", "seconds"), table("http_outcomes", "delays").items(), ids=str)
def test_a_delay_in_the_message(text, seconds):
    assert delay(payload=message(text)) == (None if seconds == "none" else pytest.approx(seconds))


@pytest.mark.parametrize(("header", "seconds"), table("http_outcomes", "headers").items())
def test_of_several_delays_the_longest_counts(header, seconds):
    told = delay(dict([header.split(": ", 1)]))
    assert told == (None if seconds == "none" else pytest.approx(seconds))


@pytest.mark.parametrize(("payload", "seconds"), table("http_outcomes", "errors").items())
def test_a_delay_is_read_from_an_error_of_any_shape(payload, seconds):
    assert delay(payload=json.loads(payload)) == (None if seconds == "none" else seconds)


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
