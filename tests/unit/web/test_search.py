"""What is marked in a text in which something is looked for, and in a prompt that changed."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from merge_runner_analysis.web.search import BEFORE, LONGEST_QUERY, SHOWN, pieces_of, terms_of
from merge_runner_analysis.web.trial.prompt_parts import parts_of
from tests.support.cases import cases


@settings(max_examples=50)
@given(
    text=st.text("abAB <>&\"'\nİ", max_size=60),
    terms=st.lists(st.text("ab<&", min_size=1, max_size=3), max_size=4),
)
def test_every_match_is_marked_and_nothing_else(text, terms):
    pieces = pieces_of(text, terms)
    marked = [piece for piece, matches in pieces if matches]
    assert len(marked) == sum(1 for _ in matches_in(text, terms))
    assert {piece.lower() for piece in marked} <= set(terms)
    assert "".join(piece for piece, _ in pieces).removeprefix("… ") in text


def matches_in(text, terms):
    """The matches that do not overlap, the longest of those that begin at one place."""
    at = 0
    while at < len(text):
        found = [term for term in terms if text[at : at + len(term)].lower() == term]
        at += max(map(len, found), default=1)
        if found:
            yield found


def test_a_line_break_is_a_space_of_a_phrase():
    assert ("gap\nis", True) in pieces_of("The gap\nis small", ["gap is"])


def test_of_a_long_text_the_part_with_the_first_match_is_shown():
    assert pieces_of(f"{'-' * SHOWN}brake{'+' * SHOWN}", ["brake"]) == [
        ("… " + BEFORE * "-", False),
        ("brake", True),
        ("+" * (SHOWN - BEFORE - len("brake")) + " …", False),
    ]


@pytest.mark.parametrize("case", cases("explorer", "terms"))
def test_a_query_is_some_words_and_phrases(case):
    assert terms_of(case["query"]) == tuple(case["terms"])
    assert terms_of("a " * 200) == ("a",)
    assert terms_of("x" * (LONGEST_QUERY + 1)) == ("x" * LONGEST_QUERY,)


WORDS = st.lists(st.sampled_from(["give", "way", ",", "3.5", "\n", "m/s"])).map(" ".join)


@settings(max_examples=30)
@given(WORDS, WORDS)
def test_a_compared_prompt_holds_the_prompt_in_order(before, now):
    pieces = [piece for part in parts_of(now, before) for piece in part.pieces]
    kept = "".join(text for change, text in pieces if change != "gone")
    assert kept.split() == now.split()


def test_only_what_changed_is_marked_in_a_line_of_many_equal_words():
    many = "I see a car. " * 500
    (part,) = parts_of(f"{many}It is 7 m ahead.", f"{many}It is 9 m ahead.")
    assert [(c, t.strip()) for c, t in part.pieces if c != "same"] == [("gone", "9"), ("new", "7")]
