"""The options that several commands share."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from merge_runner.errors import UsageError
from merge_runner.paths import home_of


def beside_study(ctx: typer.Context, param: typer.CallbackParam, path: Path) -> Path:
    """Put a default beside the study's file, from wherever it is started."""
    source = ctx.get_parameter_source(str(param.name))
    if source is None or source.name != "DEFAULT":
        return path
    study = next(filter(None, map(ctx.params.get, ("studies", "name", "study", "study_file"))), "")
    homes = {home_of(each) for each in ([study] if isinstance(study, str) else study)}
    if len(homes) > 1:
        raise UsageError(
            f"{', '.join(study)} have their results in different folders: play them one at a time, "
            "or name one place for all with --db and --cache"
        )
    return homes.pop() / path


DbOption = Annotated[
    Path,
    typer.Option(
        "--db",
        metavar="FILE",
        callback=beside_study,
        help="The results database; that of a study's file lies beside it.",
    ),
]
CacheOption = Annotated[
    Path,
    typer.Option(
        "--cache",
        metavar="DIR",
        callback=beside_study,
        help="The folder of recorded replies; that of a study's file lies beside it.",
    ),
]


def _drivers() -> list[str]:
    from merge_runner.drivers.registry import PROGRAMS
    from merge_runner.llm.models import load_models

    return [*load_models(), *PROGRAMS]


ModelOption = Annotated[
    list[str] | None,
    typer.Option(
        "--model",
        metavar="NAME",
        autocompletion=_drivers,
        help="A model of the registry, a program, or LEFT+RIGHT; may be given more than once. "
        "Else those of the study's file, or the emulator.",
    ),
]
OnlyOption = Annotated[
    list[str] | None,
    typer.Option(
        "--only",
        metavar="FACTOR=LEVEL",
        help="A part of the study: a level of a factor, or of model or prompt; may be given more "
        "than once.",
    ),
]
RepsOption = Annotated[
    int | None,
    typer.Option("--reps", metavar="N", help="Repetitions per condition, for every variant."),
]
ConditionsOption = Annotated[
    str | None,
    typer.Option("--conditions", metavar="A,B", help="Conditions, separated by commas."),
]
VariantsOption = Annotated[
    str | None,
    typer.Option("--variants", metavar="A,B", help="Prompt variants, separated by commas."),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
TrustOption = Annotated[
    bool,
    typer.Option(
        "--trust",
        help="Run the study's code and send keys where its models.toml says, unasked.",
    ),
]
StudyOption = Annotated[
    str | None,
    typer.Option(
        "--study",
        metavar="FILE",
        help="A study's file: tables, figures and reports are of its trials alone, its plug-ins "
        "run, and its prompts, conditions, drivers and metrics are known.",
    ),
]


def use_study(file: str | None, *, trust: bool) -> None:
    """Use what the study of ``--study`` adds, once the user agrees to its code."""
    if file is not None:
        from merge_runner.study.parts import load_study

        load_study(file, trust=trust)


def levels(given: Sequence[str], option: str) -> dict[str, list[str]]:
    """The levels of each factor that an option names; raises UsageError."""
    found: dict[str, list[str]] = {}
    for each in given:
        factor, equals, level = each.partition("=")
        if not equals:
            raise UsageError(f"{option} {each}: write FACTOR=LEVEL, as in {option} temperature=0.2")
        found.setdefault(factor.strip(), []).append(level.strip())
    return found


def listed(text: str | None) -> list[str] | None:
    """The parts of an option that takes several names, None where it is not given."""
    return None if text is None else [part.strip() for part in text.split(",") if part.strip()]
