"""Foreign texts, made safe to show or to put into a statement."""

from __future__ import annotations

import csv
import hashlib
import re
import sys
from types import SimpleNamespace
from typing import Any, TextIO


def printable(text: str, kept: str = "\n\t") -> str:
    """A text that cannot speak to a terminal: what a model or a server wrote may hold any code."""
    if text.translate(dict.fromkeys(map(ord, kept))).isprintable():
        return text  # as most are, and some are long
    return "".join(c if c.isprintable() or c in kept else "?" for c in text)


def say(line: str) -> None:
    """Print a message beside the results."""
    print(printable(line), file=sys.stderr, flush=True)  # noqa: T201 # progress and messages


def one_line(text: str) -> str:
    """A printable text on one line: a name that somebody else chose may hold any character."""
    return printable(text, kept="")


_NOT_IN_A_NAME = re.compile(r"[^A-Za-z0-9_.+-]")
LONGEST_IN_A_NAME = 40


def in_a_name(text: str) -> str:
    """A text as a part of a trial's id; one that must be changed for that has a hash at its end."""
    plain = _NOT_IN_A_NAME.sub("_", text)[:LONGEST_IN_A_NAME]
    return plain if plain == text else f"{plain}-{hashlib.sha256(text.encode()).hexdigest()[:8]}"


def in_spreadsheet(value: object) -> object:
    """A value for a cell of CSV, with an apostrophe before a text that a spreadsheet would run."""
    if isinstance(value, str) and value.startswith(("=", "+", "-", "@", "\t", "\r", "\n")):
        return f"'{value}"
    return value


def csv_writer(file: TextIO) -> Any:  # noqa: ANN401 # the library does not name its kind
    """A writer of CSV, whose lines end as those of all our files do: with LF alone.

    The csv module can do so by itself, but would then leave a CR within a value unquoted.
    """
    lines = SimpleNamespace(write=lambda row: file.write(row.removesuffix("\r\n") + "\n"))
    return csv.writer(lines)


def first_line(exc: BaseException) -> str:
    """What an error says: DuckDB adds a stack trace to what it takes for its own fault."""
    return str(exc).partition("\n")[0]


def quoted(text: object) -> str:
    """A text as a literal of SQL."""
    return "'" + str(text).replace("'", "''") + "'"


def first_of(texts: list[str], others: str, shown: int = 10) -> list[str]:
    """The first texts, and how many ``others`` there are."""
    left_out = len(texts) - shown
    return [*texts[:shown], f"{left_out} {others}"] if left_out > 0 else texts
