"""Reasoning within a reply's text: kept apart from the answer, and never read as one."""

import json
import re

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from merge_runner.llm.formats import FORMATS, reasoning_of
from merge_runner.llm.http_outcome import RawReply, judge
from merge_runner.llm.reasoning import split_reasoning
from merge_runner.prompts.parse import parse_reply
from tests.support.cases import by_format, cases

ANSWER = f"M\nI am ahead.\n```python\n{[0.1] * 20}\n```"
OTHER = f"Brake? ```python\n{[-0.9] * 20}\n``` No."
TAGS = [
    *((f"<{name}>", f"</{name}>") for name in ("think", "thinking", "thought", "reasoning")),
    ("[THINK]", "[/THINK]"),
    ("\u25c1think\u25b7", "\u25c1/think\u25b7"),
    ("<THINK>", "</THINK>"),
]
HARMONY = ("<|channel|>analysis<|message|>", "<|end|><|start|>assistant<|channel|>final<|message|>")


def filled(text):
    """The text of a case."""
    words = {"ANSWER": ANSWER, "OTHER": OTHER, "REST": ANSWER[2:]}
    words |= {"GO": str([0.1] * 20), "BRAKE": str([-0.9] * 20)}
    return re.sub("|".join(words), lambda match: words[match[0]], text)


def body(wire, text, finish=None):
    """A whole answer in a wire format."""
    message = {"type": "message", "content": [{"type": "output_text", "text": text}]}
    parts = {"parts": [{"text": text}]}
    choice = {"message": {"content": text}, "finish_reason": finish or "stop"}
    return {
        "openai-chat": {"choices": [choice]},
        "openai-responses": {"status": "completed", "output": [message]},
        "gemini": {"candidates": [{"content": parts, "finishReason": "STOP"}]},
        "anthropic": {"content": [{"type": "text", "text": text}], "stop_reason": "end_turn"},
    }[wire]


def judged(wire, payload):
    outcome = judge(RawReply(200, {}, json.dumps(payload)), FORMATS[wire])
    return outcome.name, outcome.reading.text, outcome.reading.reasoning


@pytest.mark.parametrize("wire", FORMATS)
@pytest.mark.parametrize(("opening", "closing"), [*TAGS, HARMONY])
@pytest.mark.parametrize("gap", ["", "\n\n"])
def test_in_every_format_what_stands_before_the_answer_is_no_part_of_it(
    wire, opening, closing, gap
):
    name, text, reasoning = judged(wire, body(wire, f"{opening}{OTHER}{closing}{gap}{ANSWER}"))
    assert (name, text.strip(), OTHER in reasoning) == ("ok", ANSWER, True)
    assert parse_reply(text, 20).plan == (0.1,) * 20
    assert reasoning_of(body(wire, f"{opening}{OTHER}{closing}{ANSWER}")) == reasoning


@pytest.mark.parametrize("wire", FORMATS)
@pytest.mark.parametrize(("opening", "closing"), [*TAGS, HARMONY])
def test_a_reply_that_ends_within_its_reasoning_is_truncated(wire, opening, closing):
    """Whatever word for the end the server has."""
    assert judged(wire, body(wire, f"\n{opening}{OTHER}")) == ("truncated", "", OTHER)
    assert judged(wire, body(wire, opening))[:2] == ("truncated", "")
    again = f"{opening}{OTHER}{closing}{opening}{OTHER}"
    assert judged(wire, body(wire, again))[:2] == ("truncated", "")


@pytest.mark.parametrize("case", cases("reasoning", "answered"))
def test_the_answer_is_what_follows_the_last_closing_tag(case):
    text, answer = map(filled, case)
    parts = split_reasoning(text)
    assert parts.answer.strip().startswith(answer)
    assert (parts.cut, parse_reply(parts.answer, 20).plan) == (False, (0.1,) * 20)


@pytest.mark.parametrize("case", cases("reasoning", "mentioned"))
def test_a_tag_that_is_only_mentioned_eats_no_answer(case):
    assert split_reasoning(filled(case)) == ("", filled(case), False)


@given(st.text() | st.text("<>/|[]\u25c1\u25b7 \nthink"))
def test_a_reply_without_a_closing_tag_and_no_opening_one_at_its_head_is_an_answer(text):
    if not text.strip().lower().startswith(("<", "[think]", "\u25c1think\u25b7")):
        text = text.replace("/", "-")
        assert split_reasoning(text) == ("", text, False)


PLAIN = st.text(st.characters(blacklist_characters="<[\u25c1`\"'(\u201c\u2018"))


@settings(max_examples=30)
@given(PLAIN, PLAIN.filter(str.strip), st.sampled_from([*TAGS, HARMONY]))
def test_thoughts_and_answer_are_told_apart_whatever_they_are(thoughts, answer, tags):
    opening, closing = tags
    assert split_reasoning(f"{opening}{thoughts}{closing}{answer}") == (thoughts, answer, False)


TAGGED = ["</think>", "x </think> x", "`</think>`", "<think>", "<think></think>", "<|channel|>"]


@pytest.mark.parametrize("unit", [*TAGGED, "analysis", " ", "<|channel|>" + " " * 50_000])
def test_many_tags_are_read_in_no_time(unit):
    text = unit * (200_000 // len(unit)) + "x"
    parts = split_reasoning(text)
    assert len(parts.reasoning) + len(parts.answer) <= len(text)


@pytest.mark.parametrize(("wire", "payload"), by_format("wire_bodies", "thoughts"))
def test_thoughts_that_a_provider_keeps_apart_are_reasoning_too(wire, payload):
    payload = json.loads(payload)
    assert judged(wire, payload) == ("ok", "A", "T")
    assert reasoning_of(payload) == "T"


@pytest.mark.parametrize("payload", [{}, {"choices": None}, {"error": "no"}, {"a": [1]}])
def test_a_body_without_thoughts_has_none(payload):
    assert reasoning_of(payload) == ""


def test_thoughts_of_several_kinds_are_all_kept():
    payload = body("openai-chat", "<think>B</think>A")
    payload["choices"][0]["message"]["reasoning"] = "A"
    assert judged("openai-chat", payload) == ("ok", "A", "AB")


def test_an_answer_that_is_cut_off_after_the_reasoning_is_truncated_and_keeps_its_text():
    payload = body("openai-chat", "<think>T</think>M\nI", finish="length")
    assert judged("openai-chat", payload) == ("truncated", "M\nI", "T")


@pytest.mark.parametrize(
    ("phases", "text", "reasoning"),
    [
        (("commentary", "final_answer"), "final_answer!", "commentary!"),
        (("commentary", "commentary", None), "None!", "commentary!\n\ncommentary!"),
        (("final_answer",), "final_answer!", ""),
        (("commentary",), "commentary!", ""),
        ((None, None), "None!None!", ""),
    ],
)
def test_a_commentary_beside_the_final_message_is_reasoning(phases, text, reasoning):
    output = [
        {"type": "message", "phase": each, "content": [{"type": "output_text", "text": f"{each}!"}]}
        for each in phases
    ]
    payload = {"status": "completed", "output": output}
    assert judged("openai-responses", payload) == ("ok", text, reasoning)
