"""What is sent and read in each wire format; the cases are in tests/cases/wire_bodies.toml."""

import json

import pytest

from merge_runner.llm.formats import FORMATS
from merge_runner.providers import ModelEntry
from merge_runner.records import Usage
from tests.support.cases import by_format, table
from tests.support.json_values import paths, replaced

OUTCOMES = {"ok", "refusal", "truncated", "empty", "error"}
SAMPLES = {wire: json.loads(body) for wire, body in table("wire_bodies", "samples").items()}


def entry(wire, **fields):
    return ModelEntry(provider="openai", format=wire, max_output_tokens=16000, **fields)


def read(wire, **changes):
    return FORMATS[wire].read(SAMPLES[wire] | changes)


@pytest.mark.parametrize(("wire", "case"), by_format("wire_bodies", "requests"))
def test_what_is_sent(wire, case):
    model = entry(wire, **case["entry"])
    request = FORMATS[wire].request(model, "PROMPT")
    assert (request.path, request.headers) == (case["path"], case.get("headers", {}))
    assert request.body == json.loads(case["body"])


@pytest.mark.parametrize("wire", FORMATS)
def test_a_path_can_be_overridden_a_parameter_wins_and_the_entry_stays_as_it_is(wire):
    model = entry(wire, id="m", path="/elsewhere", parameters={"extra": [1, {"a": None}]})
    before = model.model_copy(deep=True)
    request = FORMATS[wire].request(model, "PROMPT")
    assert request.path == "/elsewhere"
    assert '"extra": [1, {"a": null}]' in json.dumps(request.body)
    assert model == before


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
    reading = read(wire)
    assert (reading.outcome, reading.text) == ("ok", "TEXT")
    assert (reading.model_served, reading.finish_reason) == (model, finish)
    assert reading.usage == Usage(100, 25, 900, 640)


@pytest.mark.parametrize(("wire", "case"), by_format("wire_bodies", "answers"))
def test_what_is_read(wire, case):
    body = json.loads(case["body"])
    reading = FORMATS[wire].read(body) if "alone" in case else read(wire, **body)
    assert (reading.outcome, reading.text) == (case["outcome"], case.get("text", ""))
    assert reading.finish_reason == case.get("finish", reading.finish_reason)


@pytest.mark.parametrize(("wire", "case"), by_format("wire_bodies", "usage"))
def test_how_tokens_are_counted(wire, case):
    """Where a count is absent it is unknown, unless the others tell it."""
    name = "usageMetadata" if wire == "gemini" else "usage"
    expected = (None if count == -1 else count for count in case["counts"])
    assert read(wire, **{name: json.loads(case["body"])}).usage == Usage(*expected)


def test_the_service_tier_is_read():
    assert read("openai-chat", service_tier="priority").service_tier == "priority"
    assert read("openai-responses", service_tier="flex").service_tier == "flex"
    usage = {**SAMPLES["gemini"]["usageMetadata"], "serviceTier": "PRIORITY"}
    assert read("gemini", usageMetadata=usage).service_tier == "priority"
    # Anthropic sells that tier beforehand.
    assert read("gemini").service_tier is read("anthropic").service_tier is None


def test_gemini_alone_is_known_to_send_empty_answers():
    assert [wire for wire in FORMATS if FORMATS[wire].retries_empty] == ["gemini"]


@pytest.mark.parametrize("wire", FORMATS)
def test_no_value_in_the_place_of_another_makes_it_raise(wire):
    odd = [None, True, 7, -1, 1.5, "x", "", [], [None], ["x"], [[]], {}, {"text": None}]
    for path in paths(SAMPLES[wire]):
        for value in odd:
            reading = FORMATS[wire].read(replaced(SAMPLES[wire], path, value))
            assert reading.outcome in OUTCOMES
            assert isinstance(reading.text, str)
