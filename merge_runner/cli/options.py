"""Options of several commands, the output of the command line, and its questions."""

from __future__ import annotations

import shutil
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from merge_runner.errors import UsageError
from merge_runner.paths import home_of
from merge_runner.text_safety import printable, say


def option(metavar: str, text: str, *names: str, **more: Any) -> Any:  # noqa: ANN401 # as typer's
    """Return an option with a value, named as its parameter unless ``names`` are given."""
    return typer.Option(*names, metavar=metavar, help=text, **more)


def flag(name: str, text: str, **more: Any) -> Any:  # noqa: ANN401 # as typer's
    """Return an option without a value."""
    return typer.Option(name, help=text, metavar="", **more)


# The groups in which a command's help shows its options.
PLAYED = {"rich_help_panel": "What is played"}
PACE = {"rich_help_panel": "Money and pace"}
FAULTS = {"rich_help_panel": "When a model fails"}
REPLAY = {"rich_help_panel": "Replay"}
FILES = {"rich_help_panel": "Files"}
ASKED = {"rich_help_panel": "Questions and output"}


def beside_study(ctx: typer.Context, param: typer.CallbackParam, path: Path) -> Path:
    """Return the default path next to the study's file; a path that is given stays."""
    source = ctx.get_parameter_source(str(param.name))
    if source is None or source.name != "DEFAULT":
        return path
    study = next(filter(None, map(ctx.params.get, ("studies", "name", "study", "study_file"))), "")
    homes = {home_of(name) for name in ([study] if isinstance(study, str) else study)}
    if len(homes) > 1:
        raise UsageError(
            f"{', '.join(study)} have their results in different folders: play them one at a time, "
            "or name one place for all with --db and --cache"
        )
    return homes.pop() / path


DB = "The results database. With a study's file, the default is below the file's folder."
CACHE = "The folder of stored replies. With a study's file, the default is below the file's folder."
DbOption = Annotated[Path, option("FILE", DB, "--db", callback=beside_study, **FILES)]
CacheOption = Annotated[Path, option("DIR", CACHE, "--cache", callback=beside_study, **FILES)]
MODEL = (
    "A model or program of `merge-runner models`, or a pair LEFT+RIGHT; may be repeated. Default: "
    "the models of the study's file, or the emulator."
)
ONLY = (
    "Only trials at this level of a factor, such as hurry=yes, model=o3 or prompt=A1; may be "
    "repeated."
)
CONDITIONS = "Conditions, separated by commas, such as N_0_0,L_4_8."
PROMPTS = "Prompts, separated by commas, such as baseline,A1."
REPS = "Trials of each combination of levels in each condition. Default: the study's number."
ModelOption = Annotated[list[str] | None, option("NAME", MODEL, "--model", **PLAYED)]
OnlyOption = Annotated[list[str] | None, option("FACTOR=LEVEL", ONLY, "--only", **PLAYED)]
RepsOption = Annotated[int | None, option("N", REPS, "--reps", **PLAYED)]
ConditionsOption = Annotated[str | None, option("A,B", CONDITIONS, "--conditions", **PLAYED)]
VariantsOption = Annotated[str | None, option("A,B", PROMPTS, "--variants", **PLAYED)]
YES = "Do not ask before money is spent or something is removed."
TRUST = (
    "Agree to the study's code, and to the servers in its models.toml that get keys or prompts. "
    "Default: the command shows them and asks. A script, which cannot answer, needs this option: "
    "merge-runner sweep study.toml --trust."
)
STUDY = "Only trials of this study. A command that needs the study's plug-ins runs them."
JsonOption = Annotated[bool, flag("--json", "Print the result as JSON.", **ASKED)]
YesOption = Annotated[bool, flag("--yes", YES, **ASKED)]
TrustOption = Annotated[bool, flag("--trust", TRUST, **ASKED)]
StudyOption = Annotated[str | None, option("FILE", STUDY, "--study", **FILES)]
NOT_BOTH = "--sweep names a run, --study all runs of a study: leave one of them out"


def use_study(file: str | None, *, trust: bool) -> None:
    """Use the parts of the study of ``--study``, once the user agrees to its code."""
    if file is not None:
        from merge_runner.registry import use
        from merge_runner.study.parts import load_study

        _, catalogue = load_study(file, trust=trust)
        use(catalogue)


def runs_of_study(file: str | None, db: Path) -> list[str] | None:
    """Return the ids of the runs of ``--study``, whose code does not run; None without it."""
    if file is None:
        return None
    from merge_runner.study.file import read_study
    from merge_runner.study.runs import runs_of

    return runs_of(db, read_study(file))


def levels(given: Sequence[str], option: str) -> dict[str, list[str]]:
    """Return the levels of each factor that an option names; raises UsageError."""
    levels: dict[str, list[str]] = {}
    for text in given:
        factor, equals, level = text.partition("=")
        if not equals:
            raise UsageError(f"{option} {text}: write FACTOR=LEVEL, as in {option} temperature=0.2")
        levels.setdefault(factor.strip(), []).append(level.strip())
    return levels


def listed(text: str | None) -> list[str] | None:
    """Return the parts of an option that takes several names; None where it is not given."""
    return None if text is None else [part.strip() for part in text.split(",") if part.strip()]


def print_out(text: str) -> None:
    """Print a result."""
    print(printable(text), flush=True)  # noqa: T201 # the command line's output


def terminal_width() -> int | None:
    """Return the width of the terminal in columns; None where the output is a file or a pipe."""
    return shutil.get_terminal_size().columns if sys.stdout.isatty() else None


def agree(what: str, question: str, *, otherwise: str, yes: bool) -> None:
    """Show an action and ask for agreement; raise UsageError(``otherwise``) without it."""
    say(what)
    if yes:
        return
    if not sys.stdin.isatty():
        raise UsageError(f"there is no terminal to ask at, so {otherwise}: add --yes")
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:  # Ctrl-C is an answer too, also where asyncio handles it otherwise
        agreed = typer.confirm(question, err=True)
    finally:
        signal.signal(signal.SIGINT, before)
    if not agreed:
        raise UsageError(otherwise)
