"""What the command line prints, and what it asks."""

from __future__ import annotations

import shutil
import sys

import typer

from merge_runner.errors import UsageError
from merge_runner.text_safety import printable


def print_out(text: str) -> None:
    """Print a result."""
    print(printable(text), flush=True)  # noqa: T201 # the command line's output


def terminal_width() -> int | None:
    """How many columns the result may take; None where it goes into a file or a pipe."""
    return shutil.get_terminal_size().columns if sys.stdout.isatty() else None


def say(text: str) -> None:
    """Print a message beside the result."""
    print(printable(text), file=sys.stderr, flush=True)  # noqa: T201 # the command line's messages


def agree(what: str, question: str, *, otherwise: str, yes: bool) -> None:
    """Say what is about to be done, and ask once; ``otherwise`` says that it was not done."""
    say(what)
    if yes:
        return
    if not sys.stdin.isatty():
        raise UsageError(f"there is no terminal to ask at, so {otherwise}: add --yes")
    if not typer.confirm(question, err=True):
        raise UsageError(otherwise)
