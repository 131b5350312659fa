"""Replies as models write them: what is read, what is refused by name, and nothing is run."""

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from merge_runner.prompts.parse import parse_reply
from tests.support.cases import table

N = 20
PLAN = tuple(round(0.05 * k - 0.5, 2) for k in range(N))
LIST = str(list(PLAN))
WORDS = {
    "@LIST": LIST,
    "@OTHER": str([-0.5] * N),
    "@TIMES": str([round(0.2 * k, 1) for k in range(N)]),
    "@ZEROS": ", ".join(["0.0"] * (N - 1)),
}


def fenced(code, tag="python"):
    return f"M\nI go first because I am ahead.\n```{tag}\n{code}\n```"


def with_first(entry):
    """A plan of the right length whose first entry is ``entry``."""
    return fenced(f"[{entry}, {WORDS['@ZEROS']}]")


def spelt(reply):
    return re.sub("@[A-Z]+", lambda word: WORDS[word[0]], reply)


@pytest.mark.parametrize("tag", ["python", "Python", "py", "json", "", " python "])
def test_the_language_tag_of_the_fence_does_not_matter(tag):
    assert parse_reply(fenced(LIST, tag), N).plan == PLAN


@pytest.mark.parametrize(
    "code",
    [
        f"  {LIST}  ",
        LIST.replace(",", " ,  "),
        LIST.replace(", ", ","),
        LIST.replace(", ", ",\n    "),
        LIST.replace("[", "[\n").replace("]", "\n]"),
        LIST.replace("]", ",]"),
        LIST.replace("]", ",\n]"),
        f"np.array({LIST})",
        f"import numpy as np\nplan = np.array({LIST}, dtype=float)",
        f"plan = {LIST}",
        f"[{LIST}]",
        f"# the plan, first action first\n{LIST}  # [m/s^2] / 2.5",
        LIST.replace(", ", ",  # 0.2 s later\n", 1),
        f"{LIST}\n\n{LIST}",
        LIST.replace("-0.5,", "-0.50,", 1) + "\n" + LIST,
        LIST.replace("-0.5,", "- 0.5,", 1),
        LIST.replace("-", "\u2212"),
        LIST.replace("-", "\u2013"),
        LIST.replace("0.", "."),
        LIST.replace("0.05", "5e-2"),
        LIST.replace(" 0.45", " +0.45"),
    ],
)
def test_a_sloppily_written_list_is_read(code):
    parsed = parse_reply(fenced(code), N)
    assert (parsed.plan, parsed.failure) == (PLAN, None)


@pytest.mark.parametrize("reply", table("replies", "valid"))
def test_one_valid_list_is_enough_wherever_it_stands(reply):
    assert parse_reply(spelt(reply), N).plan == PLAN


def test_line_endings_change_nothing():
    reply = f"M\n\nI am ahead.\nI go first.\n```python\n{LIST}\n```\nSee you."
    assert parse_reply(reply.replace("\n", "\r\n"), N) == parse_reply(reply, N)


def test_whole_numbers_and_both_bounds_are_valid_and_the_length_is_the_callers():
    for bound in (-1, 1):
        assert parse_reply(with_first(bound), N).plan == (bound,) + (0.0,) * (N - 1)
    assert parse_reply("[0.1, 0.2]", 2).plan == (0.1, 0.2)
    assert parse_reply("[0.1, 0.2]", 3).failure == "wrong_length"


@pytest.mark.parametrize(("reply", "failure"), table("replies", "refused").items())
def test_what_holds_not_one_plan_is_refused_by_name(reply, failure):
    parsed = parse_reply(spelt(reply), N)
    assert (parsed.plan, parsed.failure) == (None, failure)


@pytest.mark.parametrize(("entry", "failure"), table("replies", "entries").items())
def test_an_entry_that_is_no_number_or_out_of_range_is_refused_by_name(entry, failure):
    parsed = parse_reply(with_first(entry), N)
    assert (parsed.plan, parsed.failure) == (None, failure)


@pytest.mark.parametrize(("head", "decided"), table("replies", "decided").items())
def test_the_decision_at_the_head_is_read_in_its_usual_dressings_and_words(head, decided):
    parsed = parse_reply(f"{head}\n```python\n{LIST}\n```", N)
    assert (parsed.plan, [parsed.tactical, parsed.rationale]) == (PLAN, decided)


@pytest.mark.parametrize("prose", table("replies", "undecided"))
def test_a_word_or_a_late_letter_is_no_token_and_stays_in_the_rationale(prose):
    parsed = parse_reply(f"{prose}\n```python\n{LIST}\n```", N)
    assert (parsed.tactical, parsed.rationale, parsed.plan) == (None, prose, PLAN)


@pytest.mark.parametrize("key", ["decision", "tactical_decision", "Tactical decision", "choice"])
@pytest.mark.parametrize(("word", "token"), [("M", "M"), ("yield", "Y"), ("Merge first", "M")])
def test_a_decision_is_a_member_of_an_object(key, word, token):
    text = f'{{"{key}": "{word}", "plan": {LIST}}}'
    for reply in (text, f"```json\n{text}\n```", text.replace('"', "'")):
        parsed = parse_reply(reply, N)
        assert (parsed.tactical, parsed.plan) == (token, PLAN)


@given(st.text(st.characters(blacklist_characters="[]`")), st.sampled_from("MY"))
def test_whatever_is_below_a_letter_changes_nothing_of_it(prose, letter):
    assert parse_reply(f"{letter}\n{prose}", N).tactical == letter


@pytest.mark.parametrize("minus", "\u2010\u2011\u2012\u2013\u2014\u2212\ufe63\uff0d")
@pytest.mark.parametrize("space", " \u00a0\u202f\u2009")
def test_another_character_for_the_minus_or_a_space_is_read(minus, space):
    code = LIST.replace("-", minus).replace(" ", space)
    assert parse_reply(fenced(code), N).plan == PLAN


@pytest.mark.parametrize("invisible", "\u200b\u200c\u200d\u2060\ufeff")
def test_a_character_that_nobody_sees_is_nothing_within_a_plan(invisible):
    code = LIST.replace("0.", f"{invisible}0.{invisible}").replace(",", invisible + ",")
    assert parse_reply(fenced(code), N).plan == PLAN


def test_the_rationale_holds_all_prose_and_no_list():
    before, after = "I am ahead.", "I check again in a second."
    fenced_between = f"M\n{before}\n```\n{LIST}\n```\n{after}"
    assert parse_reply(fenced_between, N).rationale == f"{before}\n{after}"
    assert parse_reply(f"M\n{before}\n{LIST}", N).rationale == before


def test_token_and_rationale_survive_an_invalid_plan():
    parsed = parse_reply(fenced("[0.1]"), N)
    assert (parsed.plan, parsed.failure) == (None, "wrong_length")
    assert (parsed.tactical, parsed.rationale) == ("M", "I go first because I am ahead.")


@given(st.lists(st.floats(-1, 1), min_size=N, max_size=N))
def test_a_plan_that_is_written_out_in_full_survives_exactly(plan):
    parsed = parse_reply(fenced(repr(plan)), N)
    # By their spelling, since 0.0 == -0.0.
    assert list(map(repr, parsed.plan)) == list(map(repr, plan))
