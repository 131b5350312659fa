"""Safe forms of foreign texts for terminals, names, CSV and SQL."""

from __future__ import annotations

import re
import sys
from types import SimpleNamespace
from typing import Any, TextIO


def printable(text: str, kept: str = "\n\t") -> str:
    """Return a text without control codes for a terminal: a model or server may write any code."""
    if text.translate(dict.fromkeys(map(ord, kept))).isprintable():
        return text  # the usual case, without a copy
    return "".join(c if c.isprintable() or c in kept else "?" for c in text)


def say(line: str) -> None:
    """Print a message to stderr; results go to stdout."""
    print(printable(line), file=sys.stderr, flush=True)  # noqa: T201 # progress and messages


def one_line(text: str) -> str:
    """Return a printable text on one line: a foreign name may hold any character."""
    return printable(text, kept="")


_NOT_IN_A_NAME = re.compile(r"[^A-Za-z0-9_.+-]")
LONGEST_IN_A_NAME = 40


def in_a_name(text: str) -> str:
    """Return a text as a part of a trial's id; a changed text gets a hash at its end."""
    import hashlib  # loads OpenSSL

    plain = _NOT_IN_A_NAME.sub("_", text)[:LONGEST_IN_A_NAME]
    return plain if plain == text else f"{plain}-{hashlib.sha256(text.encode()).hexdigest()[:8]}"


def in_spreadsheet(value: object) -> object:
    """Return a value for a CSV cell; a text that a spreadsheet would run gets an apostrophe."""
    if isinstance(value, str) and value.startswith(("=", "+", "-", "@", "\t", "\r", "\n")):
        return f"'{value}"
    return value


def csv_writer(file: TextIO) -> Any:  # noqa: ANN401 # the library does not name its type
    """Return a CSV writer whose lines end with LF, as in all our files.

    With that line end the csv module itself would leave a CR within a value unquoted.
    """
    import csv

    lines = SimpleNamespace(write=lambda row: file.write(row.removesuffix("\r\n") + "\n"))
    return csv.writer(lines)


def first_line(exc: BaseException) -> str:
    """Return an error's first line: DuckDB adds a stack trace to its internal errors."""
    return str(exc).partition("\n")[0]


def quoted(text: object) -> str:
    """Return a text as a SQL literal."""
    return "'" + str(text).replace("'", "''") + "'"


def first_of(texts: list[str], others: str, shown: int = 10) -> list[str]:
    """Return the first texts, and the number of ``others``."""
    left_out = len(texts) - shown
    return [*texts[:shown], f"{left_out} {others}"] if left_out > 0 else texts
