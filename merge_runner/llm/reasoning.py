"""Separate the reasoning in a reply's text from the answer after it, in any wire format.

Servers without a reasoning parser send a model's thoughts within the content, between tags or as
channels of the harmony format. A tag in quotes is a mention and is ignored. A reply that begins
with an opening tag is reasoning up to the last closing tag with text after it, or if none has, up
to the last closing tag. Without a closing tag all of it is reasoning, truncated before the answer.
In any other reply the text before the last closing tag with text after it is reasoning, since chat
templates may write the opening tag themselves; a tag within a line, after a space, is a word of
that line. Any other text is an answer.
"""

from __future__ import annotations

import re
from typing import NamedTuple

_NAMES = "(?:think|thinking|thought|reasoning)"
_OPENING = re.compile(
    rf"[\s\u200b\ufeff]*+(?:<{_NAMES}>|\[THINK\]|\u25c1think\u25b7"
    r"|(?:<\|start\|>assistant)?<\|channel\|>(?!\s*final\b)(?:[^<]{0,40}<\|message\|>)?"
    r"|(?:analysis|commentary)<\|message\|>)",
    re.IGNORECASE,
)
_CLOSING = re.compile(
    rf"</{_NAMES}>|\[/THINK\]|\u25c1/think\u25b7"
    r"|(?P<final>(?:<\|end\|>)?(?:<\|start\|>assistant)?<\|channel\|>\s*final\b[^<]{0,40}"
    r"(?:<\|constrain\|>[^<]{0,40})?<\|message\|>)",
    re.IGNORECASE,
)
# Each closing tag contains one of these. Most replies have none, and this check is far faster.
_IN_A_CLOSING = ("<", "[/", "\u25c1")
# The channels of a server that leaves out the special tokens.
_BARE_FINAL = "assistantfinal"
_BARE_CHANNELS = re.compile(rf"\s*(?:analysis|commentary).*{_BARE_FINAL}", re.DOTALL)
_TEXT = re.compile(r"\S")
_END_OF_CHANNEL = re.compile(r"<\|(?:end|return|call|start)\|>")
_QUOTES = {"`": "`", '"': '"', "'": "'", "(": ")", "\u201c": "\u201d", "\u2018": "\u2019"}
_FENCE = "```"
# Characters of a line that are checked on both sides of a tag.
_NEARBY = 80


class SplitText(NamedTuple):
    """Parts of a reply's text; ``cut``: it ends within the reasoning."""

    reasoning: str
    answer: str
    cut: bool = False


def split_reasoning(text: str) -> SplitText:
    """Return the reasoning and the answer of a reply's text, without the tags."""
    opening = _OPENING.match(text)
    if opening is None:
        return _without_opening(text)
    rest = text[opening.end() :]
    ends = _ends(rest)
    if not ends:
        return SplitText(rest, "", cut=True)
    end = next((tag for tag in ends if _is_followed(rest, tag)), ends[0])
    thoughts, answer = rest[: end.start()], _answer(rest, end)
    if again := _OPENING.match(answer):  # and no closing tag follows that
        return SplitText(thoughts + answer[again.end() :], "", cut=True)
    return SplitText(thoughts, answer)


def _without_opening(text: str) -> SplitText:
    if bare := _BARE_CHANNELS.match(text):
        return SplitText(bare[0].removesuffix(_BARE_FINAL), text[bare.end() :])
    for end in _ends(text):
        if _is_followed(text, end) and not _is_a_word(text, end):
            return SplitText(text[: end.start()], _answer(text, end))
    return SplitText("", text)


def _ends(text: str) -> list[re.Match[str]]:
    """Return the closing tags that are not mentions, the last one first."""
    if not any(part in text for part in _IN_A_CLOSING):
        return []
    return [end for end in reversed([*_CLOSING.finditer(text)]) if not _is_quoted(text, end)]


def _answer(text: str, end: re.Match[str]) -> str:
    answer = text[end.end() :]
    return _END_OF_CHANNEL.split(answer, maxsplit=1)[0] if end["final"] else answer


def _is_followed(text: str, tag: re.Match[str]) -> bool:
    return _TEXT.search(text, tag.end()) is not None


def _is_quoted(text: str, tag: re.Match[str]) -> bool:
    begin, end = tag.span()
    before, after = text[max(0, begin - 1) : begin], text[end : end + 1]
    return bool(after) and _QUOTES.get(before) == after and not text.endswith(_FENCE, 0, begin)


def _is_a_word(text: str, tag: re.Match[str]) -> bool:
    before = text[max(0, tag.start() - _NEARBY) : tag.start()].rpartition("\n")[2]
    after = text[tag.end() : tag.end() + _NEARBY].partition("\n")[0]
    return before[-1:].isspace() and bool(before.strip() and after.strip())
