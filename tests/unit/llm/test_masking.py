import json

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from merge_runner.llm.masking import MASK, Mask

KEY = "sk-proj-AbC/d+9xYz_01=23.~"
KEYS = st.text(st.characters(min_codepoint=33, max_codepoint=126), min_size=8, max_size=40)


@settings(max_examples=50)
@given(KEYS.filter(lambda key: len(key) >= 12), st.data(), st.text("ab.", max_size=3))
def test_no_12_characters_in_a_row_of_a_key_are_left(key, data, around):
    begin = data.draw(st.integers(0, len(key) - 12))
    end = data.draw(st.integers(begin + 12, len(key)))
    text = f"{around}{key[begin:end]}{around}{key[begin : begin + 12]}{around}"
    left = Mask([key])(text)
    assert not {key[at : at + 12] for at in range(len(key) - 11)} & {
        left[at : at + 12] for at in range(len(left) - 11)
    }


def test_fewer_than_12_characters_of_a_key_and_all_around_more_of_them_stay():
    assert Mask([KEY])(f"({KEY[5:16]}) ({KEY[5:17]})") == f"({KEY[5:16]}) ({MASK})"
    assert Mask([KEY])(f"ends in {KEY[-4:]}, begins with {KEY[:8]}") == (
        f"ends in {KEY[-4:]}, begins with {KEY[:8]}"
    )


@given(st.text() | st.text('\\\\u0073/"nk-'))
def test_nothing_else_is_changed(text):
    assert Mask([KEY, "another-key"])(text) == text
    assert Mask([])(text) == text


def escaped(text, data):
    """The text with some of its characters as escapes of JSON, as it stands between quotes."""
    spelled = ""
    for character in text:
        code = data.draw(st.sampled_from(["", "04x", "04X"]))
        spelled += f"\\u{ord(character):{code}}" if code else json.dumps(character)[1:-1]
    return spelled


@settings(max_examples=40)
@given(KEYS.filter(lambda key: len(key) >= 12), st.data(), st.integers(0, 3))
def test_no_key_is_left_however_json_spells_it(key, data, nested):
    spelled = escaped(key, data)
    for _ in range(nested):
        spelled = json.dumps(spelled)[1:-1]
    left = Mask([key])(f'{{"a\\n": "\\u00e4 {spelled}.", "b": "\\"{spelled}"}}')
    assert left == f'{{"a\\n": "\\u00e4 {MASK}.", "b": "\\"{MASK}"}}'


@pytest.mark.parametrize(
    ("spelled", "left"),
    [
        (r"\u0073k-proj-AbC\/d+9xYz_01=23.~", MASK),
        (r"\\u0073k-proj-AbC\\/d+9xYz_01=23.~", MASK),
        (r"\u0061bc \u0073k-proj-AbC\u002Fd\n", rf"\u0061bc {MASK}\n"),
        (r"\u0073k-proj", r"\u0073k-proj"),  # fewer than 12 characters
        (rf"\ud83d\ude00 {KEY} \x", rf"\ud83d\ude00 {MASK} \x"),
    ],
)
def test_of_a_key_with_escapes_its_whole_spelling_is_masked(spelled, left):
    assert Mask([KEY])(spelled) == left


@pytest.mark.parametrize("text", ["\\" * 100_000, "\\u0073" * 15_000, "\\n" * 50_000])
def test_many_escapes_are_read_in_no_time(text):
    assert Mask([KEY])(text + KEY) == text + MASK


def test_each_of_several_keys_is_masked_wherever_it_stands():
    mask = Mask([KEY, "another-key"])
    assert mask(f"{KEY}another-key {KEY}") == f"{MASK}{MASK} {MASK}"


def test_a_key_of_plain_characters_is_found_in_its_escapes():
    """Nothing but a code can stand for these."""
    mask = Mask(["sk-plain-0123456789"])
    assert mask(r"\"\u0073k-plain-0123456789\"") == rf"\"{MASK}\""
    assert mask(r"\u005cu0073k-plain-0123456789 \/ \n") == rf"{MASK} \/ \n"
