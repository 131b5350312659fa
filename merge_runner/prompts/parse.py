"""A reply's text as a validated plan; what is ambiguous is refused by name, nothing is evaluated.

The reasons: ``no_array``, ``several_arrays`` (different ones), ``wrong_length``,
``not_a_number`` (an entry is no number literal), ``not_finite`` and ``out_of_range``.
"""

from __future__ import annotations

import math
import re
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
    """Read a reply that should hold one list of ``plan_actions`` numbers in [-1, 1]."""
    # Half a surrogate pair, which JSON can spell, is a character that no table can hold.
    text = text.encode(errors="replace").decode().replace("\r\n", "\n")
    prose, code = _split(text)
    plan, failure = _plan(code, plan_actions)
    tactical, rationale = _tactical(prose.strip())
    return ParsedReply(plan, tactical, rationale, failure)


def _split(text: str) -> tuple[str, str]:
    """Prose and code; a reply without a code fence is searched for an array as a whole."""
    parts = text.split("```")
    if len(parts) > 1:
        return "\n".join(part.strip() for part in parts[0::2]).strip(), "\n".join(parts[1::2])
    return _ARRAY.sub("", text), text


def _plan(code: str, plan_actions: int) -> tuple[tuple[float, ...] | None, str | None]:
    arrays = {_entries(inside) for inside in dict.fromkeys(_ARRAY.findall(_COMMENT.sub("", code)))}
    if not arrays:
        return None, "no_array"
    if len(arrays) > 1:
        return None, "several_arrays"
    entries = arrays.pop()
    numbers = tuple(entry for entry in entries if isinstance(entry, float))
    words = [entry for entry in entries if isinstance(entry, str)]
    # A literal can be too large for a float.
    if any(_NOT_FINITE.fullmatch(word) for word in words) or not all(map(math.isfinite, numbers)):
        return None, "not_finite"
    if words:
        return None, "not_a_number"
    if len(numbers) != plan_actions:
        return None, "wrong_length"
    if not all(-1 <= number <= 1 for number in numbers):
        return None, "out_of_range"
    return numbers, None


def _entries(inside: str) -> tuple[float | str, ...]:
    """The entries of an array: numbers, and what is none as it is spelled."""
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
