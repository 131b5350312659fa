"""Parser of replies into validated plans; ambiguous replies fail, and no code is evaluated.

A reply should "contain a length-N array" (arXiv 2604.09609): one valid array is enough, with any
other lists in the reply. The parser searches the code blocks; without a valid array there, it
searches the prose. Different valid arrays in one of the two are ambiguous; equal ones are one.

Failures: ``no_array``, ``several_arrays`` (different valid ones) or, without a valid array, the
fault of the array nearest to a plan, arrays of the expected length first: ``out_of_range``,
``wrong_length``, ``not_finite`` and ``not_a_number`` (an entry is no number literal).

The tactical decision is read at the head of the reply, as a letter or in words (Merge first,
Yield), perhaps after a label (Decision:). Without one there, it is read from the lines that have
only such a label with a choice, or from members of a JSON object of that name; these must agree.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from typing import NamedTuple

from merge_runner.records import Tactical

_ARRAY = re.compile(r"\[([^\[\]]*)\]")
_NUMBER = re.compile(r"[+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:e[+-]?\d+)?", re.ASCII | re.IGNORECASE)
# Possessive, so that the time is linear in the amount of space.
_NUMBERS = re.compile(
    rf"(?:\s*+{_NUMBER.pattern}\s*+,)*+\s*+{_NUMBER.pattern}\s*+(?:,\s*+)?", _NUMBER.flags
)
_NOT_FINITE = re.compile(
    r"[+-]?(?:(?:np|numpy|math)\.)?(?:nan|inf|infinity)"
    r"|float\((['\"])[+-]?(?:nan|inf|infinity)\1\)",
    re.IGNORECASE,
)
# From the array nearest to a plan to the farthest.
_FAILURES = ("out_of_range", "wrong_length", "not_finite", "not_a_number")
_SIGN_APART = re.compile(r"^([+-])\s+")
_COMMENT = re.compile(r"#[^\n]*")
_TOKEN_LINE = re.compile(
    r"[\W_]*(?:(?:tactical|decision|choice|plan|token|letter)[\W_]+)*([MY])(?![^\W_])[\W_]*"
    r"(merge first|merge|yield)?[\W_]*",
    re.IGNORECASE,
)
_LABEL = (
    r"(?:(?:my )?(?:tactical|decision|choice)(?: ?\((?:M ?(?:/|or) ?Y|merge first or yield)\))?"
    r"[\W_]++(?:is[\W_]++)?(?:to[\W_]++)?)"
)
_MERGE = r"merge first|go first|merge(?![^\w.]*(?:behind|after|second)(?![^\W_]))"
_CHOICE = (
    r"(?:(?P<letter>[MY])(?![^\W_])(?:[\W_]++(?P<word>merge first|merge|yield)(?![^\W_]))?+"
    rf"|(?:(?P<merge>{_MERGE})|yield(?: to the other (?:car|driver|vehicle))?)"
    r"(?![^\W_])(?:[\W_]++(?P<same>[MY])(?![^\W_]))?+)"
)
# Texts, which re compiles at the first use and keeps: few replies need them.
# Some replies number their parts like the output format; a brace begins a JSON object.
_HEAD = r"(?:[^\w{]|_)*+(?:1[\W_]++)?"
_CHOICE_LINE = rf"(?i){_HEAD}(?P<label>{_LABEL}*+){_CHOICE}[\W_]*+"
_CHOICE_WITH_REASON = (
    rf"(?i){_HEAD}{_LABEL}++{_CHOICE}[*_`\"')\]]*+ ?"
    r"(?P<reason>[.,:;(\u2013\u2014-]|(?=because|since)) ?"
)
_HEADING = rf"(?i){_HEAD}{_LABEL}++"
_MEMBER = (
    r"""(?i)[{,]\s*+["'](?:tactical|decision|tactical[ _]decision|choice)["']\s*+:\s*+"""
    rf"""["']{_CHOICE}["']"""
)
# Text after a choice that revokes it: another choice, as in "M, Y" and "yield; no, merge first".
_CONTRARY = {
    "M": re.compile(r"[,;]\W*(?:(?:no|or)\W+)?(?:Y|yield)(?![^\W_])", re.IGNORECASE),
    "Y": re.compile(r"[,;]\W*(?:(?:no|or)\W+)?(?:M|merge first|go first)(?![^\W_])", re.IGNORECASE),
}
# A line with a choice is short; the limit also bounds the time for a hostile line.
_LONGEST_LINE = 80
_LEADING_TOKEN = re.compile(r"[*_`#>\s\"'(\[]{0,20}([MY])(?=[\s*_`\"'):.,;\]\u2013\u2014-]|$)")
# Variants of the ASCII minus sign in models' replies.
_MINUSES = dict.fromkeys("\u2010\u2011\u2012\u2013\u2014\u2212\ufe63\uff0d", "-")
# Invisible characters in some models' replies.
_INVISIBLE = dict.fromkeys("\u200b\u200c\u200d\u2060\ufeff", "")
_AS_ASCII = str.maketrans(_MINUSES | _INVISIBLE)


class ParsedReply(NamedTuple):
    """Parsed reply; ``plan`` is None if it is invalid, for the reason ``failure``."""

    plan: tuple[float, ...] | None
    tactical: Tactical | None
    rationale: str
    failure: str | None


def parse_reply(text: str, plan_actions: int) -> ParsedReply:
    """Parse a reply that should contain a list of ``plan_actions`` numbers in [-1, 1]."""
    # JSON can contain half a surrogate pair, which no table can store.
    if not text.isascii():
        text = text.encode(errors="replace").decode()
    text = text.replace("\r\n", "\n")
    prose, places = _split(text)
    plan, failure = _plan(places, plan_actions)
    tactical, rationale = _tactical(prose.strip())
    if tactical is None:
        tactical, rationale = _in_words(prose.strip(), text)
    return ParsedReply(plan, tactical, rationale, failure)


def _split(text: str) -> tuple[str, tuple[str, ...]]:
    """Return the prose, and the texts to search for a plan, in order."""
    parts = text.split("```")
    if len(parts) > 1:
        prose = "\n".join(part.strip() for part in parts[0::2]).strip()
        return prose, ("\n".join(parts[1::2]), prose)
    return _ARRAY.sub("", text), (text,)


def _plan(places: Iterable[str], plan_actions: int) -> tuple[tuple[float, ...] | None, str | None]:
    failures: list[tuple[bool, int]] = []
    for place in places:
        arrays = set(map(_entries, dict.fromkeys(_ARRAY.findall(_COMMENT.sub("", place)))))
        valid = []
        for array in arrays:
            numbers = tuple([entry for entry in array if isinstance(entry, float)])
            failure = _failure(array, numbers, plan_actions)
            if failure is None:
                valid.append(numbers)
            else:
                failures.append((len(array) != plan_actions, _FAILURES.index(failure)))
        if valid:
            return (valid[0], None) if len(valid) == 1 else (None, "several_arrays")
    if not failures:
        return None, "no_array"
    return None, _FAILURES[min(failures)[1]]


def _failure(
    array: tuple[float | str, ...], numbers: tuple[float, ...], plan_actions: int
) -> str | None:
    """Return why an array with these numbers is no valid plan; None for a valid one."""
    if len(array) == len(numbers) == plan_actions and -1 <= min(numbers) <= max(numbers) <= 1:
        return None
    words = [entry for entry in array if isinstance(entry, str)]
    # A literal can be too large for a float.
    if any(_NOT_FINITE.fullmatch(word) for word in words) or not all(map(math.isfinite, numbers)):
        return "not_finite"
    if words:
        return "not_a_number"
    return "wrong_length" if len(numbers) != plan_actions else "out_of_range"


def _entries(inside: str) -> tuple[float | str, ...]:
    """Return the entries of an array: numbers, and the text of an entry that is no number."""
    if not inside.isascii():
        inside = inside.translate(_AS_ASCII)
    if _NUMBERS.fullmatch(inside):
        return tuple(map(float, inside.rstrip().removesuffix(",").split(",")))
    entries = [_SIGN_APART.sub(r"\1", entry.strip()) for entry in inside.split(",")]
    if entries[-1] == "":
        entries.pop()
    return tuple(float(e) if _NUMBER.fullmatch(e) else e for e in entries)


def _tactical(prose: str) -> tuple[Tactical | None, str]:
    """Return the M/Y token at the head of the reply, and the prose without it."""
    first_line, _, rest = prose.partition("\n")
    whole = _TOKEN_LINE.fullmatch(first_line) if len(first_line) <= _LONGEST_LINE else None
    if whole and (whole[2] or whole[1])[0].upper() == _token(whole):
        return _token(whole), rest.strip()
    leading = None if whole else _LEADING_TOKEN.match(first_line)
    if leading and not _CONTRARY[_token(leading)].match(first_line, leading.end()):
        return _token(leading), prose[leading.end() :].lstrip(
            "*_`\"'):.,;] \n\u2013\u2014-"
        ).strip()
    return None, prose


def _in_words(prose: str, text: str) -> tuple[Tactical | None, str]:
    """Return the decision of a reply without a letter at its head, and the prose without it."""
    lines = [line for line in prose.split("\n") if line.strip()]
    short = [line for line in lines if len(line) <= _LONGEST_LINE]
    heads = [line for line in lines[:2] if len(line) <= _LONGEST_LINE]
    # A label may be a heading, above the choice.
    count = 2 if len(heads) == 2 and re.fullmatch(_HEADING, f"{heads[0]} ") else 1
    whole = re.fullmatch(_CHOICE_LINE, " ".join(heads[:count]))
    if whole and (choice := _choice(whole)):
        return choice, "\n".join(lines[count:]).strip()
    begin = re.match(_CHOICE_WITH_REASON, prose[: 2 * _LONGEST_LINE])
    if begin and (choice := _choice(begin)):
        is_taken_back = _CONTRARY[choice].match(prose, begin.start("reason"))
        return (None, prose) if is_taken_back else (choice, prose[begin.end() :].strip())
    matches = [match for line in short if (match := re.fullmatch(_CHOICE_LINE, line))]
    choices = {*map(_choice, [match for match in matches if match["label"]])}
    choices = choices or {*map(_choice, re.finditer(_MEMBER, text))}
    return (choices.pop() if len(choices) == 1 else None), prose


def _choice(match: re.Match[str]) -> Tactical | None:
    """Return the choice of a match; None if its words and its letter disagree."""
    if letter := match["letter"]:
        letter = letter.upper()
        if (match["word"] or letter)[0].upper() != letter:
            return None
        return "M" if letter == "M" else "Y"
    choice: Tactical = "M" if match["merge"] else "Y"
    return choice if (match["same"] or choice).upper() == choice else None


def _token(match: re.Match[str]) -> Tactical:
    return "M" if match.group(1).upper() == "M" else "Y"
