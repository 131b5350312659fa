from datetime import UTC, datetime

import pytest

from merge_runner.llm.formats import FORMATS, read_error
from merge_runner.llm.http_outcome import server_delay_s

NOW = datetime(2026, 10, 21, 7, 28, 0, tzinfo=UTC)


def delay(headers=None, payload=None):
    return server_delay_s(read_error(429, headers or {}, "", payload), FORMATS["openai-chat"], NOW)


def message(text):
    return {"error": {"message": text, "type": "tokens", "code": "rate_limit_exceeded"}}


def retry_info(duration, text="Please retry in 38.804097346s."):
    kind = "type.googleapis.com/google.rpc."
    return {
        "error": {
            "code": 429,
            "message": text,
            "status": "RESOURCE_EXHAUSTED",
            "details": [
                {"@type": kind + "QuotaFailure", "violations": [{"quotaId": "PerMinute"}]},
                {"@type": kind + "Help", "links": []},
                {"@type": kind + "RetryInfo", "retryDelay": duration},
            ],
        }
    }


@pytest.mark.parametrize(
    ("headers", "seconds"),
    [
        ({"retry-after-ms": "1500"}, 1.5),
        ({"retry-after-ms": "0.5"}, 0.0005),
        ({"retry-after": "7"}, 7),
        ({"retry-after": "0.25"}, 0.25),
        ({"retry-after": "Wed, 21 Oct 2026 07:28:30 GMT"}, 30),
        ({"retry-after": "Wed, 21 Oct 2026 09:28:30 +0200"}, 30),
        # Without a zone the date is UTC, as HTTP has it.
        ({"retry-after": "Wed, 21 Oct 2026 07:29:00 -0000"}, 60),
    ],
)
def test_retry_after_in_all_its_forms(headers, seconds):
    assert delay(headers) == pytest.approx(seconds)


@pytest.mark.parametrize(
    ("duration", "seconds"),
    [("34s", 34), ("38s", 38), ("45.837906927s", 45.837906927), ("0.5s", 0.5)],
)
def test_gemini_retry_info(duration, seconds):
    assert delay(payload=retry_info(duration)) == pytest.approx(seconds)


@pytest.mark.parametrize(
    ("text", "seconds"),
    [
        ("Limit 200000, Used 162960. Please try again in 1.574s. Visit https://x.y/z.", 1.574),
        ("Please try again in 644ms. Visit https://platform.openai.com", 0.644),
        ("Please try again in 34.337s.", 34.337),
        ("Please try again in 6m0s. Visit us.", 360),
        ("Please try again in 1m26.4s.", 86.4),
        ("Please try again in 1h2m3s.", 3723),
        # Milliseconds, not 52 minutes.
        ("Please try again in 52ms.", 0.052),
        ("Please try again in 52ms", 0.052),
        ("Please try again in 20s.", 20),
        ("Please try again in 5 minutes.", 300),
        ("Please try again in 2 hrs", 7200),
        ("Please try again in 20 milliseconds", 0.02),
        ("Please retry after 1h30m and 5 seconds.", 5405),
        ("Please retry after 3 mins, 5 secs.", 185),
        ("You have reached your limit. Try again in 1 day.", 86400),
        ("of your current OpenAI S0 pricing tier. Please retry after 26 seconds. Go to", 26),
        ("You exceeded your current quota. Please retry in 38.804097346s.", 38.804097346),
    ],
)
def test_a_delay_in_the_message(text, seconds):
    assert delay(payload=message(text)) == pytest.approx(seconds)


@pytest.mark.parametrize(
    "payload",
    [
        {"error": "busy, try again in 7s"},
        {"object": "error", "message": "busy, try again in 7s"},
        {"choices": [{"error": {"code": 429, "message": "busy, try again in 7s"}}]},
    ],
)
def test_a_delay_is_read_from_an_error_of_any_shape(payload):
    assert delay(payload=payload) == 7


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


@pytest.mark.parametrize(
    ("values", "seconds"),
    [
        ("7, 3600", 3600),
        ("3600,7", 3600),
        ("soon, 7, nan, -1, inf", 7),
        ("Wed, 21 Oct 2026 07:28:30 GMT, 7", 30),
        ("7, Wed, 21 Oct 2026 07:28:30 GMT", 30),
        ("99999999999", 99999999999),
        ("Wed, 21 Oct 2026 07:28:30 +99999999999999999999", None),
        ("Wed, 21 Oct 2026 07:28:30 +9999, 7", 7),
    ],
)
def test_of_several_delays_the_longest_counts(values, seconds):
    assert delay({"retry-after": values}) == seconds


def test_of_several_delays_in_ms_the_longest_counts_too():
    assert delay({"retry-after-ms": "250, 1500", "retry-after": "7"}) == 1.5


def test_a_date_that_has_passed_is_no_delay():
    assert delay({"retry-after": "Wed, 21 Oct 2026 07:27:30 GMT"}) is None


@pytest.mark.parametrize(
    "payload",
    [
        None,
        [],
        "text",
        {},
        {"error": None},
        {"error": "text"},
        {"error": {"message": None, "details": None}},
        {"error": {"details": [None, "x", {"retryDelay": 5}, {"retryDelay": "soon"}]}},
        message("Rate limit reached. Please slow down."),
        message("Please try again in a while."),
        message("Please try again in ...s"),
        message("Please try again in 2 weeks."),
        message("Please try again in 3 attempts."),
        message("Resource has been exhausted (e.g. check quota)."),
    ],
    ids=str,
)
def test_nothing_usable_is_none(payload):
    assert delay(payload=payload) is None
