"""A reply's text as a validated plan; what is ambiguous is refused by name, nothing is evaluated.

A reply should "contain a length-N array" (arXiv 2604.09609): one valid array is enough, whatever
other lists stand beside it. It is looked for in the code blocks, and where none there is valid, in
the prose. Different valid arrays in the same of these two are ambiguous; equal ones are one.

The reasons: ``no_array``, ``several_arrays`` (different valid ones) or, where none is valid, what
is wrong with the array that comes nearest to a plan, one of the wanted length before any other:
``out_of_range``, ``wrong_length``, ``not_finite`` and ``not_a_number`` (an entry is no number
literal).
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass

from merge_runner.records import Tactical

_ARRAY = re.compile(r"\[([^\[\]]*)\]")
_NUMBER = re.compile(r"[+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:e[+-]?\d+)?", re.ASCII | re.IGNORECASE)
# Possessive, so that the time stays linear however much space there is.
_NUMBERS = re.compile(
    rf"(?:\s*+{_NUMBER.pattern}\s*+,)*+\s*+{_NUMBER.pattern}\s*+(?:,\s*+)?", _NUMBER.flags
)
_NOT_FINITE = re.compile(
    r"[+-]?(?:(?:np|numpy|math)\.)?(?:nan|inf|infinity)"
    r"|float\((['\"])[+-]?(?:nan|inf|infinity)\1\)",
    re.IGNORECASE,
)
# From the array that comes nearest to a plan to the one that is farthest from it.
_FAILURES = ("out_of_range", "wrong_length", "not_finite", "not_a_number")
_SIGN_APART = re.compile(r"^([+-])\s+")
_COMMENT = re.compile(r"#[^\n]*")
_TOKEN_LINE = re.compile(
    r"[\W_]*(?:(?:tactical|decision|choice|plan|token|letter)[\W_]+)*([MY])(?![^\W_])[\W_]*"
    r"(?:merge first|merge|yield)?[\W_]*",
    re.IGNORECASE,
)
_LEADING_TOKEN = re.compile(r"[*_`#>\s\"'(\[]{0,20}([MY])(?=[\s*_`\"'):.,;\]\u2013\u2014-]|$)")
# Models write these for the ASCII minus sign.
_MINUSES = str.maketrans(dict.fromkeys("\u2212\u2012\u2013\ufe63\uff0d", "-"))


@dataclass(frozen=True, slots=True)
class ParsedReply:
    """What a reply says. ``plan`` is None where it is invalid, and ``failure`` says why."""

    plan: tuple[float, ...] | None
    tactical: Tactical | None
    rationale: str
    failure: str | None


def parse_reply(text: str, plan_actions: int) -> ParsedReply:
    """Read a reply that should hold a list of ``plan_actions`` numbers in [-1, 1]."""
    # Half a surrogate pair, which JSON can spell, is a character that no table can hold.
    text = text.encode(errors="replace").decode().replace("\r\n", "\n")
    prose, places = _split(text)
    plan, failure = _plan(places, plan_actions)
    tactical, rationale = _tactical(prose.strip())
    return ParsedReply(plan, tactical, rationale, failure)


def _split(text: str) -> tuple[str, tuple[str, ...]]:
    """The prose, and where to look for a plan, one place after the other."""
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
            failure = _failure(array, plan_actions)
            if failure is None:
                valid.append(tuple(map(float, array)))
            else:
                failures.append((len(array) != plan_actions, _FAILURES.index(failure)))
        if valid:
            return (valid[0], None) if len(valid) == 1 else (None, "several_arrays")
    if not failures:
        return None, "no_array"
    return None, _FAILURES[min(failures)[1]]


def _failure(array: tuple[float | str, ...], plan_actions: int) -> str | None:
    """Why an array is no plan; None: it is one."""
    if len(array) == plan_actions and all(map(_is_action, array)):
        return None
    numbers = [entry for entry in array if isinstance(entry, float)]
    words = [entry for entry in array if isinstance(entry, str)]
    # A literal can be too large for a float.
    if any(_NOT_FINITE.fullmatch(word) for word in words) or not all(map(math.isfinite, numbers)):
        return "not_finite"
    if words:
        return "not_a_number"
    return "wrong_length" if len(numbers) != plan_actions else "out_of_range"


def _is_action(entry: float | str) -> bool:
    return isinstance(entry, float) and -1 <= entry <= 1


def _entries(inside: str) -> tuple[float | str, ...]:
    """The entries of an array: numbers, and as it is spelled what is not a number."""
    if not inside.isascii():
        inside = inside.translate(_MINUSES)
    if _NUMBERS.fullmatch(inside):
        return tuple(map(float, inside.rstrip().removesuffix(",").split(",")))
    entries = [_SIGN_APART.sub(r"\1", entry.strip()) for entry in inside.split(",")]
    if entries[-1] == "":
        entries.pop()
    return tuple(float(e) if _NUMBER.fullmatch(e) else e for e in entries)


def _tactical(prose: str) -> tuple[Tactical | None, str]:
    """The M/Y token at the head of the reply, and the prose without it."""
    first_line, _, rest = prose.partition("\n")
    # A token line is short; the limit also bounds the time that a hostile line can take.
    whole = _TOKEN_LINE.fullmatch(first_line) if len(first_line) <= 80 else None
    if whole:
        return _token(whole), rest.strip()
    leading = _LEADING_TOKEN.match(first_line)
    if leading:
        return _token(leading), prose[leading.end() :].lstrip(
            "*_`\"'):.,;] \n\u2013\u2014-"
        ).strip()
    return None, prose


def _token(match: re.Match[str]) -> Tactical:
    return "M" if match.group(1).upper() == "M" else "Y"
