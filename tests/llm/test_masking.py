from hypothesis import given
from hypothesis import strategies as st

from merge_runner.llm.http import MASK, Mask

KEY = "sk-proj-AbC/d+9xYz_01=23.~"
KEYS = st.text(st.characters(min_codepoint=33, max_codepoint=126), min_size=8, max_size=40)


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


@given(st.text())
def test_nothing_else_is_changed(text):
    assert Mask([KEY, "another-key"])(text) == text
    assert Mask([])(text) == text


def test_each_of_several_keys_is_masked_wherever_it_stands():
    mask = Mask([KEY, "another-key"])
    assert mask(f"{KEY}another-key {KEY}") == f"{MASK}{MASK} {MASK}"
