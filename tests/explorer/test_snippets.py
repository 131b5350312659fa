"""What is shown of a text in which something is looked for."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from markupsafe import Markup, escape

from merge_runner_analysis.explorer.snippets import (
    LONGEST_QUERY,
    MOST_MATCHES,
    MOST_TERMS,
    snippet,
    terms_of,
)

TEXTS = st.text(st.sampled_from("abAB <>&\"'\n") | st.characters(), max_size=600)
TERMS = st.lists(st.text(st.sampled_from("ab <&"), min_size=1, max_size=3), max_size=4)


def fold(text):
    return "".join(c.lower() if len(c.lower()) == 1 else c for c in text)


@given(text=TEXTS, terms=TERMS)
def test_every_match_is_shown_or_counted_and_nothing_else_is_marked(text, terms):
    found = snippet(text, fold(text), terms)
    marked = [piece for piece, matches in found.pieces if matches]
    folded = fold(text)
    covered = {
        place
        for term in terms
        for begin in range(len(text))
        if folded.startswith(term, begin)
        for place in range(begin, begin + len(term))
    }
    assert len(marked) <= MOST_MATCHES
    if not found.more:
        assert sum(map(len, marked)) == len(covered)
    for piece in marked:
        assert any(term in fold(piece) for term in terms)


@given(text=TEXTS, terms=TERMS)
def test_the_pieces_stand_in_the_text_in_this_order_and_none_is_html(text, terms):
    at = 0
    html = Markup()
    for piece, matches in snippet(text, fold(text), terms).pieces:
        html += Markup("<mark>%s</mark>") % piece if matches else escape(piece)
        if piece not in {"… ", " … ", " …"} or matches:
            assert piece in text[at:]
            at = text.index(piece, at) + len(piece)
    assert html.count("<mark>") == html.count("<") - html.count("</mark>")


def test_of_many_matches_the_first_are_shown_and_the_rest_is_counted():
    text = "brake. " * (MOST_MATCHES + 3)
    found = snippet(text, text, ["brake"])
    assert [sum(matches for _, matches in found.pieces), found.more] == [MOST_MATCHES, 3]


def test_a_long_text_is_cut_around_its_matches():
    text = f"{'x' * 500}brake{'y' * 500}"
    pieces = snippet(text, text, ["brake"]).pieces
    assert pieces == [
        ("… ", False), ("x" * 70, False), ("brake", True), ("y" * 70, False), (" …", False)
    ]  # fmt: skip


def test_what_stands_around_a_match_begins_and_ends_with_whole_words():
    text = f"{'carefully ' * 20}brake {'carefully ' * 20}"
    before, word, after = (piece for piece in snippet(text, text, ["brake"]).pieces if "…" not in
                           piece[0])  # fmt: skip
    assert word == ("brake", True)
    assert before == ("carefully " * 7, False)
    assert after == (" carefully" * 7, False)


@pytest.mark.parametrize(
    ("query", "terms"),
    [
        ("", []),
        ("  brake   gap ", ["brake", "gap"]),
        ('"collision  course" brake', ["collision course", "brake"]),
        ('"never closed', ["never closed"]),
        ('brake "" brake', ["brake"]),
        ("a " * 200, ["a"]),
    ],
)
def test_a_query_is_words_and_phrases(query, terms):
    assert terms_of(query) == terms


@given(st.text(max_size=2 * LONGEST_QUERY))
def test_a_query_is_bounded(query):
    terms = terms_of(query)
    assert len(terms) <= MOST_TERMS
    assert sum(map(len, terms)) <= LONGEST_QUERY
    assert all(terms)
