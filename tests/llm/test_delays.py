from datetime import UTC, datetime

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from merge_runner.llm.formats import FORMATS
from merge_runner.llm.formats.base import read_error
from merge_runner.llm.formats.delays import MOST_S, duration_s, server_delay_s

NOW = datetime(2026, 10, 21, 7, 28, 0, tzinfo=UTC)


def delay(headers=None, payload=None):
    return server_delay_s(read_error(429, headers or {}, "", payload), FORMATS.values(), NOW)


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
        ("Try again in 1 minute and 30 seconds.", 90),
        ("Try again in 2 hours, 1 min.", 7260),
        ("Please try again in 250 milliseconds", 0.25),
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


@pytest.mark.parametrize(
    ("text", "seconds"),
    [
        ("6m0s", 360),
        ("1s", 1),
        ("120ms", 0.12),
        ("8ms", 0.008),
        ("33.023s", 33.023),
        ("2m52.8s", 172.8),
        ("1h30m", 5400),
        ("1h30m5s", 5405),
        ("64", 64),
        ("0", None),
        ("-1", None),
        ("", None),
        ("soon", None),
        ("1x", None),
    ],
)
@pytest.mark.parametrize("kind", ["requests", "tokens"])
def test_the_reset_of_an_exhausted_limit(kind, text, seconds):
    headers = {f"x-ratelimit-remaining-{kind}": "0", f"x-ratelimit-reset-{kind}": text}
    assert delay(headers) == (None if seconds is None else pytest.approx(seconds))


@pytest.mark.parametrize("remaining", ["-1", "-27689"])
def test_a_limit_that_counts_on_below_zero_is_exhausted(remaining):
    prefix = "x-ratelimit"
    headers = {f"{prefix}-remaining-tokens": remaining, f"{prefix}-reset-tokens": "64"}
    assert delay(headers) == 64


@pytest.mark.parametrize("remaining", ["1", "4999", "00", None])
def test_the_reset_of_a_limit_with_something_left_says_nothing(remaining):
    headers = {"x-ratelimit-reset-requests": "6m0s", "x-ratelimit-reset-tokens": "6m0s"}
    if remaining is not None:
        headers["x-ratelimit-remaining-requests"] = remaining
    assert delay(headers) is None


def test_only_the_exhausted_limit_counts_and_of_two_the_longer():
    headers = {
        "x-ratelimit-remaining-requests": "0",
        "x-ratelimit-reset-requests": "120ms",
        "x-ratelimit-remaining-tokens": "5",
        "x-ratelimit-reset-tokens": "6m0s",
    }
    assert delay(headers) == pytest.approx(0.12)
    assert delay({**headers, "x-ratelimit-remaining-tokens": "0"}) == pytest.approx(360)


@pytest.mark.parametrize("kind", ["requests", "tokens", "input-tokens", "output-tokens"])
@pytest.mark.parametrize(
    ("remaining", "reset", "seconds"),
    [
        ("0", "2026-10-21T07:28:59Z", 59),
        ("0", "2026-10-21T09:28:59+02:00", 59),
        ("0", "2026-10-21T07:27:00Z", None),
        ("0", "tomorrow", None),
        ("1", "2026-10-21T07:28:59Z", None),
    ],
)
def test_anthropic_resets_are_points_in_time(kind, remaining, reset, seconds):
    prefix = f"anthropic-ratelimit-{kind}"
    assert delay({f"{prefix}-remaining": remaining, f"{prefix}-reset": reset}) == seconds


def test_the_longest_of_anthropics_exhausted_limits_counts():
    headers = {
        "anthropic-ratelimit-requests-remaining": "0",
        "anthropic-ratelimit-requests-reset": "2026-10-21T07:28:05Z",
        "anthropic-ratelimit-output-tokens-remaining": "0",
        "anthropic-ratelimit-output-tokens-reset": "2026-10-21T07:28:50Z",
    }
    assert delay(headers) == 50


# Every source with its delay, in the order in which they are believed.
SOURCES = [
    ({"retry-after-ms": "1000"}, {}, 1),
    ({"retry-after": "2"}, {}, 2),
    ({}, {"details": [{"retryDelay": "3s"}]}, 3),
    ({}, {"message": "Please try again in 4s."}, 4),
    ({"x-ratelimit-remaining-tokens": "0", "x-ratelimit-reset-tokens": "5s"}, {}, 5),
    (
        {
            "anthropic-ratelimit-tokens-remaining": "0",
            "anthropic-ratelimit-tokens-reset": "2026-10-21T07:28:06Z",
        },
        {},
        6,
    ),
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
        ("Wednesday, 21-Oct-26 07:28:30 GMT, Wed, 21 Oct 2026 07:28:40 GMT", 40),
        ("99999999999", MOST_S),
        ("Fri, 31 Dec 9999 23:59:59 GMT", MOST_S),
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


@settings(deadline=None)
@given(st.text(), st.text("0123456789.hms"))
def test_no_text_makes_it_raise(text, digits):
    for each in (text, digits):
        duration_s(each)
        names = ["retry-after-ms", "retry-after", "x-ratelimit-reset-tokens"]
        resets = {"anthropic-ratelimit-tokens-remaining": "0", "x-ratelimit-remaining-tokens": "0"}
        for name in [*names, "anthropic-ratelimit-tokens-reset"]:
            found = delay({**resets, name: each}, message(f"try again in {each}"))
            assert found is None or found > 0
