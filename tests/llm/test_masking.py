from base64 import b64encode, urlsafe_b64encode

import pytest
from hypothesis import given
from hypothesis import strategies as st

from merge_runner.llm.masking import MASK, Mask

KEY = "sk-proj-AbC/d+9xYz_01=23.~"
KEYS = st.text(st.characters(min_codepoint=33, max_codepoint=126), min_size=8, max_size=40)
SPELLINGS = (
    lambda c: c,
    lambda c: f"\\u{ord(c):04x}",
    lambda c: f"\\\\u{ord(c):04X}",
    lambda c: f"%{ord(c):02x}",
    lambda c: f"%{ord(c):02X}",
    lambda c: f"&#{ord(c)};",
    lambda c: f"&#x{ord(c):x};",
    lambda c: f"%25{ord(c):02x}",
    lambda c: f"&amp;#{ord(c)};",
    lambda c: f"\\u0026#{ord(c)};",
    lambda c: f"{c}\0",
    lambda c: f"\u200b{c}",
    lambda c: f"\\{c}" if c == "/" else c,
)


def mixed(key, chosen):
    return "".join(SPELLINGS[n % len(SPELLINGS)](c) for c, n in zip(key, chosen, strict=False))


@given(KEYS, st.lists(st.integers(0, 12), min_size=40, max_size=40))
def test_a_key_is_found_with_any_of_its_characters_escaped(key, chosen):
    spelt = mixed(key, chosen)
    masked = Mask([key])(f'{{"got": "{spelt}"}} ')
    assert masked.translate(dict.fromkeys(map(ord, "\0\u200b"))) == f'{{"got": "{MASK}"}} '


@given(KEYS, st.binary(max_size=20), st.binary(max_size=20))
@pytest.mark.parametrize("code", [b64encode, urlsafe_b64encode])
def test_no_part_of_a_key_is_left_in_what_is_base64(code, key, before, after):
    coded = code(before + key.encode() + after).decode()
    left = Mask([key])(f'"{coded}"')
    assert MASK in left
    # What is left says of the key not one whole character.
    ahead, behind = left.strip('"').split(MASK)
    assert len(ahead) <= -(-len(before) * 8 // 6)
    assert len(behind.rstrip("=")) <= -(-len(after) * 8 // 6)


def test_slashes_of_base64_are_found_escaped_too():
    key = "sk???>>>???>>>"
    coded = b64encode(key.encode()).decode()
    assert "/" in coded
    assert "Pz8" not in Mask([key])(coded.replace("/", "\\/"))


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
