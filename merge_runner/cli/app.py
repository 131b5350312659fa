"""The program: its commands in the order of ``--help``, and what becomes of an error."""

from __future__ import annotations

import errno
import gc
import os
import sys
from collections.abc import Callable
from copy import copy
from typing import Annotated, Any

import typer

from merge_runner import __version__
from merge_runner.cli.ledger import ledger
from merge_runner.cli.models import models
from merge_runner.cli.output import print_out, say
from merge_runner.cli.recording import recording_app
from merge_runner.cli.results import audit, digest, forget, sql
from merge_runner.cli.stand_in import emulate
from merge_runner.cli.sweep import init, replay, sweep
from merge_runner.errors import MergeRunnerError, UsageError

# A full disk, a limit of file sizes, and a device that fails.
OUTPUT_ERRORS = (errno.ENOSPC, errno.EFBIG, errno.EIO)
COMPLETION = "_MERGE_RUNNER_COMPLETE"  # set by the shell's script that typer installs


def _print_version(wanted: bool) -> None:
    if wanted:
        print_out(f"merge-runner {__version__}")
        raise typer.Exit


def common(
    debug: Annotated[
        bool, typer.Option("--debug", help="Show a traceback on errors.")
    ] = False,  # typer's way to declare a flag
    version: Annotated[
        bool,
        typer.Option(
            "--version", help="Print the version.", callback=_print_version, is_eager=True
        ),
    ] = False,
) -> None:
    """Finds out whether a language model drives like a human."""


app = typer.Typer(
    name="merge-runner",
    help="Finds out whether a language model drives like a human.",
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)
app.callback()(common)
for _command in (init, sweep, replay, sql, digest, audit, ledger, forget, models, emulate):
    app.command()(_command)
app.add_typer(recording_app, name="recording")


def alone(command: str | None) -> typer.Typer:
    """The program with the options of one command, since making those of all takes as long again.

    The others are there by their names and by what they say of themselves.
    """
    light = copy(app)
    light.registered_commands = [copy(info) for info in app.registered_commands]
    for info in light.registered_commands:
        if info.callback is not None and command != (info.name or info.callback.__name__):
            info.callback = _without_options(info.callback)
    light.registered_groups = [copy(info) for info in app.registered_groups]
    for group in light.registered_groups:
        if group.typer_instance is not None and command != group.name:
            group.typer_instance = copy(group.typer_instance)
            group.typer_instance.registered_commands = []
    return light


def _without_options(command: Callable[..., Any]) -> Callable[[], None]:
    def bare() -> None:
        raise AssertionError("unreachable: the command that runs has its options")

    bare.__name__, bare.__doc__ = command.__name__, command.__doc__
    return bare


def main() -> None:
    """Run the command line and exit with the contract's code."""
    # A trial's objects live until it ends, so frequent garbage collections would find almost none.
    gc.set_threshold(20_000, 10, 100)
    debug = "--debug" in sys.argv
    sys.argv = [argument for argument in sys.argv if argument != "--debug"]
    completing = COMPLETION in os.environ  # a shell asks, whose words are not in argv
    words = (argument for argument in sys.argv[1:] if not argument.startswith("-"))
    try:
        (app if completing else alone(next(words, None)))(prog_name="merge-runner")
    except MergeRunnerError as exc:
        if debug:
            raise
        say(f"error: {exc}")
        sys.exit(exc.exit_code)
    except ModuleNotFoundError as exc:
        if debug or str(exc.name).startswith(("merge_runner", "analysis")):
            raise
        say(f"error: this needs {exc.name}, which is not installed: pip install {exc.name}")
        sys.exit(UsageError.exit_code)
    except RuntimeError as exc:
        if debug or str(exc) != "Query interrupted":  # what DuckDB raises on Ctrl-C
            raise
        say("interrupted: run the same command again")
        sys.exit(130)
    except OSError as exc:
        if debug or exc.errno not in OUTPUT_ERRORS:
            raise
        say(f"error: the output cannot be written: {exc.strerror}")
        sys.exit(1)
