"""What is shown of a text in which something is looked for."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from merge_runner_analysis.explorer.search import (
    BEFORE,
    LONGEST_QUERY,
    MOST_TERMS,
    SHOWN,
    pieces_of,
    terms_of,
)


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


@pytest.mark.parametrize(
    ("query", "terms"),
    [
        ("", ()),
        ("  brake   gap ", ("brake", "gap")),
        ('"collision  course" brake', ("collision course", "brake")),
        ('"never closed', ("never closed",)),
        ('brake "" brake', ("brake",)),
        ("a " * 200, ("a",)),
        ("abcdefghijklm", ("abcdefghijklm",)),
        (" ".join("abcdefghijklmnop"), tuple("abcdefghijklmnop"[:MOST_TERMS])),
        ("x" * (LONGEST_QUERY + 1), ("x" * LONGEST_QUERY,)),
    ],
    ids=lambda value: str(value)[:20],
)
def test_a_query_is_some_words_and_phrases(query, terms):
    assert terms_of(query) == terms
