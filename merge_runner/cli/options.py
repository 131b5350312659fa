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


def _studies() -> list[str]:
    from merge_runner.study.file import study_files

    return sorted(study_files())


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


MirrorOption = Annotated[
    bool,
    typer.Option(
        "--mirror", help="Also play two different drivers with their sides changed, as LEFT+RIGHT."
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


SampleSetOption = Annotated[
    int,
    typer.Option("--sample-set", metavar="N", help="Another number draws a fresh set of samples."),
]


InFlightOption = Annotated[
    int, typer.Option("--in-flight", metavar="N", help="Trials at once, over all workers.", min=1)
]


RpmOption = Annotated[
    int | None, typer.Option("--rpm", metavar="N", help="Requests a minute.", min=1)
]


TpmOption = Annotated[
    int | None, typer.Option("--tpm", metavar="N", help="Tokens a minute.", min=1)
]


MaxCostOption = Annotated[
    float | None,
    typer.Option(
        "--max-cost", metavar="USD", help="Never spend more on this, over all its runs.", min=0
    ),
]


BatchOption = Annotated[
    bool,
    typer.Option(
        "--batch",
        help="Ask in the provider's batches, one decision of all trials a round, at a lower price.",
    ),
]


StrictModelOption = Annotated[
    bool, typer.Option("--strict-model", help="Stop when another model answers.")
]


KeepGoingOption = Annotated[
    bool,
    typer.Option("--keep-going", help="Go on with a model that gives no valid decision."),
]


DryRunOption = Annotated[bool, typer.Option("--dry-run", help="Only estimate.")]


YesOption = Annotated[bool, typer.Option("--yes", help="Do not ask before spending.")]


ReplayOption = Annotated[bool, typer.Option("--replay", help="From recorded replies alone.")]


JsonOption = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]


QuietOption = Annotated[bool, typer.Option("--quiet", help="Show no progress.")]


StudiesArgument = Annotated[
    list[str],
    typer.Argument(
        metavar="NAME...",
        autocompletion=_studies,
        help="experiments/NAME.toml, or a path. Several are played one after the other.",
    ),
]


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


RecordingFile = Annotated[Path, typer.Argument(metavar="FILE", help="A recording (.parquet).")]


ImportedFile = Annotated[
    Path, typer.Argument(metavar="FILE", help="A recording (.parquet), or a cache folder.")
]


RecordingOption = Annotated[
    list[Path] | None,
    typer.Option(
        "--recording",
        metavar="FILE",
        help="Also replay from this file, without importing it; may be repeated.",
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
