"""The program: its commands in the order of ``--help``, and its exit codes."""

from __future__ import annotations

import errno
import io
import os
import sys
from copy import copy
from importlib import import_module
from typing import Annotated

import typer

from merge_runner import __version__
from merge_runner.cli.help import Program
from merge_runner.cli.inspect import audit, digest, forget, sql
from merge_runner.cli.models import emulate, models
from merge_runner.cli.money import ledger
from merge_runner.cli.options import flag, print_out
from merge_runner.cli.recording import recording_app
from merge_runner.cli.run import init, replay, sweep
from merge_runner.errors import MergeRunnerError, UsageError
from merge_runner.text_safety import say

# A full disk, a limit of file sizes, and a device that fails.
OUTPUT_ERRORS = (errno.ENOSPC, errno.EFBIG, errno.EIO)
# An error of Click, whose name Typer keeps to itself.
USAGE: type[typer.BadParameter] = typer.BadParameter.__mro__[2]
# Errors that _code_and_line describes if a user can act on them.
EXPECTED = (MergeRunnerError, ModuleNotFoundError, OSError, RuntimeError)
GROUP = "merge_runner.commands"  # of the entry points that name modules with commands
COMPLETION = "_MERGE_RUNNER_COMPLETE"  # set by the shell's script that typer installs


def common(
    debug: Annotated[bool, flag("--debug", "Show a traceback on errors.")] = False,
    version: Annotated[bool, flag("--version", "Print the version.")] = False,
) -> None:
    """Print the version if the option asks for it."""
    if version:
        print_out(f"merge-runner {__version__}")
        raise typer.Exit


app = Program(
    name="merge-runner",
    help="Finds out whether a language model drives like a human.\n\n"
    "Example: merge-runner sweep baseline",
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
)
app.callback(invoke_without_command=True)(common)
# Groups of the commands in --help; the analysis has commands, too.
PLAY, LOOK, KEEP, CHECK = "Play", "Look", "Keep", "Check"
for _panel, _commands in {
    PLAY: (sweep, replay, init, models, emulate),
    LOOK: (sql,),
    KEEP: (forget,),
    CHECK: (audit, digest, ledger),
}.items():
    for _command in _commands:
        app.command(rich_help_panel=_panel)(_command)
app.add_typer(recording_app, name="recording", rich_help_panel=KEEP)
# To run one of these, the commands of other packages are not looked up.
BUILT_IN = {info.callback.__name__ for info in app.registered_commands if info.callback}
BUILT_IN |= {str(info.name) for info in app.registered_groups}


def complete_app() -> typer.Typer:
    """Return the program with the commands of all installed packages.

    Each module of the group adds its commands to ``app``. One that is missing is left out: the
    analysis need not be installed.
    """
    from importlib.metadata import entry_points  # not imported for a built-in command

    for module in sorted({point.module for point in entry_points(group=GROUP)}):
        try:
            import_module(module)
        except ModuleNotFoundError as exc:
            if not f"{module}.".startswith(f"{exc.name}."):
                raise
    return app


def app_with_one_command(command: str | None) -> typer.Typer:
    """Return the program with the options of one command, in half the time that all would take.

    The other commands have only a name and a help text, and the other groups no commands.
    """
    light = copy(app)
    light.registered_commands = [copy(info) for info in app.registered_commands]
    for info in light.registered_commands:
        assert info.callback is not None
        name = info.name or info.callback.__name__
        if name != command:
            info.name, info.help, info.callback = name, info.callback.__doc__, lambda: None
    light.registered_groups = [copy(info) for info in app.registered_groups]
    for group in light.registered_groups:
        assert group.typer_instance is not None
        if group.name != command:
            group.typer_instance = copy(group.typer_instance)
            group.typer_instance.registered_commands = []
    return light


def main() -> None:
    """Run the command line and exit with its exit code."""
    if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.encoding.lower() != "utf-8":
        sys.stdout.reconfigure(errors="replace")
    debug = "--debug" in sys.argv
    sys.argv = [argument for argument in sys.argv if argument != "--debug"]
    completing = COMPLETION in os.environ  # a shell asks, whose words are not in argv
    words = (argument for argument in sys.argv[1:] if not argument.startswith("-"))
    try:
        command = next(words, None)
        if completing or sys.argv[1:2] != [command] or command not in BUILT_IN:
            complete_app()
        run = app if completing else app_with_one_command(command)
        sys.exit(run(prog_name="merge-runner", standalone_mode=False))
    except typer.Abort:
        say("Aborted!")
        sys.exit(1)
    except USAGE as exc:
        exc.show()  # in plain lines: in Typer's boxes a script could not find them
        sys.exit(exc.exit_code)
    except EXPECTED as exc:
        code, line = _code_and_line(exc)
        if debug or not line:
            raise
        say(line)
        sys.exit(code)


def _code_and_line(exc: Exception) -> tuple[int, str]:
    """Return the exit code and the line of an error that a user can act on; no line for others."""
    match exc:
        case MergeRunnerError():
            return exc.exit_code, f"error: {exc}"
        case ModuleNotFoundError(name="fcntl" | "resource"):
            text = "error: merge-runner runs on Linux and macOS; on Windows it runs within WSL"
            return UsageError.exit_code, text
        case ModuleNotFoundError(name=str(name)) if not name.startswith("merge_runner"):
            text = f"error: this needs {name}, which is not installed: pip install {name}"
            return UsageError.exit_code, text
        case OSError() if exc.errno in OUTPUT_ERRORS:
            return 1, f"error: the output cannot be written: {exc.strerror}"
        case RuntimeError() if str(exc) == "Query interrupted":  # what DuckDB raises on Ctrl-C
            return 130, "interrupted: run the same command again"
    return 1, ""
