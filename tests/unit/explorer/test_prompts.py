"""What is marked in a prompt."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st

from merge_runner_analysis.explorer.prompts import parts_of

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
