"""Format of a study file: drivers, factors, conditions and budget."""

from __future__ import annotations

import shutil
from functools import cached_property
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BeforeValidator, ConfigDict, Field, JsonValue, model_validator

from merge_runner.config import (
    Count,
    Frozen,
    NotNegative,
    Perception,
    Positive,
    ScenarioConfig,
    experiments,
    read_text,
    toml_of,
    validated,
)
from merge_runner.errors import UsageError, unknown_name
from merge_runner.planted_effect import Number
from merge_runner.prompts.blocks import BASELINE
from merge_runner.records import MOST_REPETITIONS
from merge_runner.scenarios.merge.conditions import Condition

EVERY_PROMPT = "every prompt"
"""Key of a single number of repetitions in ``StudyFile.repetitions``."""
EVERY_CONDITION = "all"
"""In the list of conditions: all conditions of the scenario."""
GivenTo = Literal["both", "ego", "other"]
"""Drivers with a level: both, the ego (the focal driver), or its opponent."""
MEASURES = (
    "goes_first",
    "collided",
    "gap_m",
    "left_first_percent",
    "collided_percent",
    "collided_boxes_percent",
    "rmse_mps",
    "joint_percent",
    "valid_percent",
    "cost_usd",
)
"""Values of ``StudyFile.primary`` in addition to metrics of plug-ins: the measures of an ``Effect``
and the tested metrics of the analysis, which the runner does not import."""
ONE_OF_EACH = "give it a block, a text, or merge and straight"
TEMPLATE = Path(__file__).with_name("template")
PLUGIN = "plugin.py"
IGNORED = "gitignore"  # with a dot, git would apply it to the template


def _by_name(value: object) -> object:
    """Return a list of conditions (names, or tables with name and numbers) as a dict by name."""
    by_name: dict[str, object] = {}
    for row in value if isinstance(value, list) else [None]:
        numbers = dict(row) if isinstance(row, dict) else {"name": row}
        name = numbers.pop("name", None)
        if not isinstance(name, str):
            raise ValueError(
                "it should be a list of names, or of tables with a name of their own: "
                'conditions = ["N_0_0"], or ["all"], as without the key'
            )
        by_name[name] = numbers or None
    return by_name


def _for_every_prompt(value: object) -> object:
    return {EVERY_PROMPT: value} if isinstance(value, int) else value


class RoadTexts(Frozen):
    """Templates of a paragraph before and after the merge point; None: no paragraph there.

    In a file, a text or the key ``text`` sets both. ``prompts.blocks`` has the template variables.
    """

    merge: str | None = None
    straight: str | None = None

    @model_validator(mode="before")
    @classmethod
    def _of_both_roads(cls, value: object) -> object:
        table = {"text": value} if isinstance(value, str) else value
        if not isinstance(table, dict) or "text" not in table:
            return table
        if table.keys() & {"block", "merge", "straight"}:
            raise ValueError(ONE_OF_EACH)
        rest = {key: item for key, item in table.items() if key != "text"}
        return {"merge": table["text"], "straight": table["text"], **rest}


class AddedText(RoadTexts):
    """Paragraph that a prompt adds ``before`` or ``after`` a block, by default at the end.

    ``block`` names a registered block, which has a default position.
    """

    block: str | None = None
    before: str | None = None
    after: str | None = None

    @model_validator(mode="after")
    def _one_of_each(self) -> AddedText:
        if (self.block is not None) == (self.merge is not None or self.straight is not None):
            raise ValueError(ONE_OF_EACH)
        if self.before is not None and self.after is not None:
            raise ValueError("before or after, not both")
        return self


class StudyPrompt(Frozen):
    """Prompt of a study, based on another one: removals, replacements, additions, in this order.

    Tables show the ``title``.
    """

    based_on: str = BASELINE
    remove: tuple[str, ...] = ()
    replace: dict[str, RoadTexts] = Field(default_factory=dict)
    add: tuple[AddedText, ...] = ()
    title: str = ""


class PlantedWords(Frozen):
    """Effect of a text on the emulator, which reads no texts, for a rehearsal.

    ``own_first`` is added to its log-odds of going first, ``gap_m`` to the gap that both drivers
    aim at.
    """

    own_first: Number = 0.0
    gap_m: Number = 0.0


class StudyText(Frozen):
    """Text level of a factor: its changes of any prompt, and the drivers that get them."""

    add: tuple[AddedText, ...] = ()
    remove: tuple[str, ...] = ()
    replace: dict[str, RoadTexts] = Field(default_factory=dict)
    given_to: GivenTo = "both"
    emulator: PlantedWords = PlantedWords()

    @model_validator(mode="after")
    def _does_something(self) -> StudyText:
        if not (self.remove or self.replace or self.add):
            raise ValueError("it changes no word: give it add, replace or remove, or leave it out")
        if self.emulator.own_first and self.given_to == "both":
            raise ValueError(
                "of two drivers with the same words neither goes first more often: own_first needs "
                'given_to = "ego" or "other"'
            )
        return self


class StudyDriver(Frozen):
    """Driver of a study: a ``program`` with other parameters or another clock.

    It holds each action for ``clock`` seconds. Every other key is a parameter of the program.
    """

    model_config = ConfigDict(frozen=True, extra="allow")

    program: str
    clock: Positive | None = None


class Effect(Frozen):
    """Assumed effect of a level of a factor, for a power analysis.

    Additions to the share of trials in which its driver goes first, to the coefficients of the
    merge order, to the gap in m, and to the share of collisions.
    """

    goes_first: Annotated[float, Field(ge=-1, le=1)] = 0.0
    intercept: float = 0.0
    projected_headway: float = 0.0
    relative_velocity: float = 0.0
    gap_m: float = 0.0
    collided: Annotated[float, Field(ge=-1, le=1)] = 0.0


class StudyFile(Frozen):
    """One study.

    ``repetitions`` are per condition, for each prompt or for all of them. ``conditions`` are by
    name; one without numbers is registered already. ``factors``, ``models`` and conditions form a
    full factorial design; each row of ``skip`` excludes a combination of levels, or of lists of
    them. Tables compare the levels of a factor with the first one, or with its ``reference``;
    ``effect`` has the assumed effects by factor, for ``merge-runner power``. ``primary`` is the
    measure that is tested separately, one of ``MEASURES`` or a plug-in's metric: all others are
    corrected together.

    ``mirror`` counterbalances the positions of two different drivers. ``perception`` has the
    observation models by name, as levels of the factors perception, perception_left and
    perception_right. ``texts`` have the text of a factor by level; a level without a text does not
    change the prompt. ``given_to`` names the driver with the levels of a parameter or of the
    perception, by default both. ``budget`` is the spending cap in USD over all models, runs and
    days. ``plugins`` are Python files in the study's folder that register drivers, prompt blocks,
    metrics and other parts.
    """

    description: str = ""
    models: tuple[str, ...] = ()
    repetitions: Annotated[
        dict[str, Annotated[Count, Field(le=MOST_REPETITIONS)]], BeforeValidator(_for_every_prompt)
    ]
    conditions: Annotated[dict[str, Condition | None], BeforeValidator(_by_name)] | None = None
    scenario: ScenarioConfig = ScenarioConfig()
    factors: dict[str, tuple[JsonValue, ...]] = Field(default_factory=dict)
    skip: tuple[dict[str, JsonValue], ...] = ()
    reference: dict[str, JsonValue] = Field(default_factory=dict)
    effect: dict[str, Effect] = Field(default_factory=dict)
    primary: Annotated[str, Field(min_length=1)] = "goes_first"
    mirror: bool = False
    prompts: dict[str, StudyPrompt] = Field(default_factory=dict)
    texts: dict[str, dict[str, StudyText]] = Field(default_factory=dict)
    given_to: dict[str, GivenTo] = Field(default_factory=dict)
    drivers: dict[str, StudyDriver] = Field(default_factory=dict)
    perception: dict[str, Perception] = Field(default_factory=dict)
    budget: dict[Literal["total_usd"], NotNegative] = Field(default_factory=dict)
    plugins: dict[Literal["files"], tuple[str, ...]] = Field(default_factory=dict)


class StudySource(Frozen):
    """Text of a study file, with the source of its plug-ins by file name.

    ``path`` is the study's file, or the recording that holds it; a study from a database has none.
    """

    name: str
    text: str
    plugins: dict[str, str]
    path: Path = Field(default=Path(), exclude=True)

    @cached_property
    def file(self) -> StudyFile:
        """Parsed text; raises UsageError."""
        return validated(StudyFile, toml_of(self.text, str(self.path)), str(self.path))


def study_files() -> dict[str, Path]:
    """Return the study files by name, of the working directory and shipped ones."""
    files = [file for folder in reversed(experiments()) for file in folder.glob("*.toml")]
    return {file.stem: file for file in files if file.stem != "models"}


def read_study(name: str) -> StudySource:
    """Return the study ``experiments/NAME.toml``, or that at a path; raises UsageError."""
    path = Path(name)
    if path.suffix != ".toml":
        files = study_files()
        if name not in files:
            raise unknown_name("sweep", name, sorted(files), "or a path")
        path = files[name]
    study, sources = StudySource(name=path.stem, text=read_text(path), plugins={}, path=path), {}
    for file_name in study.file.plugins.get("files", ()):
        plugin = path.parent / file_name
        if not plugin.resolve().is_relative_to(path.parent.resolve()):
            raise UsageError(f"{path}: the plug-in {file_name} lies outside of the study's folder")
        sources[file_name] = read_text(plugin)
    return study.model_copy(update={"plugins": sources})


def write_folder(folder: Path) -> list[Path]:
    """Write a new folder with a complete study; raises UsageError if it is not empty."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if any(folder.iterdir()):
            raise UsageError(f"{folder} is not empty: name a new folder")
        named = {file: file.name for file in TEMPLATE.iterdir() if file.is_file()}
        named[TEMPLATE / IGNORED] = f".{IGNORED}"
        return [shutil.copyfile(ours, folder / name) for ours, name in named.items()]
    except OSError as exc:
        raise UsageError(f"{folder} cannot be written: {exc.strerror}") from exc
