"""A study's file: who drives, what varies, in which conditions, and what it may cost."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from pydantic import BeforeValidator, ConfigDict, Field, model_validator

from merge_runner.config import (
    MOST_REPETITIONS,
    Count,
    Frozen,
    Json,
    NotNegative,
    Perception,
    Positive,
    Rate,
    ScenarioConfig,
    experiments,
    read_toml,
    validated,
)
from merge_runner.errors import UsageError, unknown_name
from merge_runner.scenarios.merge.conditions import MEAN_SPEED_MPS

BASELINE = "baseline"
EVERY_PROMPT = "every prompt"
"""Stands for a single number of repetitions in ``StudyFile.repetitions``."""
EVERY_CONDITION = "all"
"""In the list of conditions: the scenario's own ones."""


def _texts(value: object) -> object:
    return {"merge": value, "straight": value} if isinstance(value, str) else value


def _named(value: object) -> object:
    if not isinstance(value, list):
        return value
    return tuple({"name": each} if isinstance(each, str) else each for each in value)


def _for_every_prompt(value: object) -> object:
    return {EVERY_PROMPT: value} if isinstance(value, int) else value


class RoadTexts(Frozen):
    """The templates of a paragraph before and after the merge point; where one is left out, none.

    What they may name in braces: ``prompts.fields``.
    """

    merge: str | None = None
    straight: str | None = None


class AddedText(RoadTexts):
    """A paragraph that a prompt adds ``before`` or ``after`` a block; else it stands last.

    ``text`` stands for both roads. ``block`` names a registered one, which has a place of its own.
    """

    block: str | None = None
    text: str | None = None
    before: str | None = None
    after: str | None = None

    @model_validator(mode="after")
    def _one_of_each(self) -> AddedText:
        of_roads = self.merge is not None or self.straight is not None
        if (self.block is not None) + (self.text is not None) + of_roads != 1:
            raise ValueError("give it a block, a text, or merge and straight")
        if self.before is not None and self.after is not None:
            raise ValueError("before or after, not both")
        return self

    @property
    def texts(self) -> RoadTexts:
        """Its templates where it is no registered block."""
        if self.text is None:
            return self
        return RoadTexts(merge=self.text, straight=self.text)


class StudyPrompt(Frozen):
    """A prompt that a study makes from another one: it removes, replaces and adds, in this order.

    Tables show the ``title``.
    """

    based_on: str = BASELINE
    remove: tuple[str, ...] = ()
    replace: dict[str, Annotated[RoadTexts, BeforeValidator(_texts)]] = Field(default_factory=dict)
    add: tuple[AddedText, ...] = ()
    title: str = ""


class StudyCondition(Frozen):
    """A condition: by its name alone one that is known, else one of the study's own."""

    name: str
    projected_headway_m: Annotated[float, Field(allow_inf_nan=False)] | None = None
    relative_velocity_mps: Annotated[float, Field(allow_inf_nan=False)] | None = None
    mean_speed_mps: Rate = MEAN_SPEED_MPS

    @property
    def numbers(self) -> dict[str, float]:
        """Those of a condition of the study's own; empty for one that is known."""
        return self.model_dump(exclude={"name"}, exclude_unset=True)

    @model_validator(mode="after")
    def _whole(self) -> StudyCondition:
        numbers = self.projected_headway_m, self.relative_velocity_mps
        if self.numbers and None in numbers:
            raise ValueError(
                "a condition of your own needs projected_headway_m and relative_velocity_mps"
            )
        return self


class BudgetTerms(Frozen):
    """What a study may cost, in USD over all models, runs and days."""

    total_usd: NotNegative | None = None


class StudyDriver(Frozen):
    """A driver that a study makes of a ``program``: with other parameters, or with a slower clock.

    It holds each action for ``clock`` seconds. Every other key is a parameter of the program.
    """

    model_config = ConfigDict(frozen=True, extra="allow")

    program: str
    clock: Positive | None = None

    @property
    def parameters(self) -> dict[str, object]:
        """The parameters that it sets."""
        return dict(self.model_extra or {})


class Plugins(Frozen):
    """Python files that register drivers, prompt blocks, metrics and so on, beside the study."""

    files: tuple[str, ...] = ()


class StudyFile(Frozen):
    """One study. ``repetitions`` are per condition, for each prompt or for all of them.

    ``factors`` are crossed with each other, with the ``models`` and with the conditions; ``skip``
    leaves crossings out: each row names levels, or lists of them. Tables compare the levels of a
    factor with its first one, or with that which ``reference`` names. With ``mirror`` two different
    drivers are played both ways round. ``perception`` holds by name what the levels of the factors
    perception, perception_left and perception_right stand for.
    """

    description: str = ""
    models: tuple[str, ...] = ()
    repetitions: Annotated[
        dict[str, Annotated[Count, Field(le=MOST_REPETITIONS)]], BeforeValidator(_for_every_prompt)
    ]
    conditions: Annotated[tuple[StudyCondition, ...], BeforeValidator(_named)] | None = None
    scenario: ScenarioConfig = ScenarioConfig()
    factors: dict[str, tuple[Json, ...]] = Field(default_factory=dict)
    skip: tuple[dict[str, Json], ...] = ()
    reference: dict[str, Json] = Field(default_factory=dict)
    mirror: bool = False
    prompts: dict[str, StudyPrompt] = Field(default_factory=dict)
    drivers: dict[str, StudyDriver] = Field(default_factory=dict)
    perception: dict[str, Perception] = Field(default_factory=dict)
    budget: BudgetTerms = BudgetTerms()
    plugins: Plugins = Plugins()


@dataclass(frozen=True, slots=True)
class StudySource:
    """A study's file as it was read, with the source of its plug-ins by file name."""

    name: str
    file: StudyFile
    text: str
    path: Path
    plugins: dict[str, str]

    @property
    def is_own(self) -> bool:
        """Whether it holds more than names of what there is."""
        file = self.file
        own_conditions = any(condition.numbers for condition in file.conditions or ())
        own_parts = file.prompts or file.drivers or file.plugins.files or own_conditions
        return bool(file.factors or own_parts)


def study_files() -> dict[str, Path]:
    """The studies that a name stands for: those of the working directory, and those that ship."""
    return {
        file.stem: file
        for folder in reversed(experiments())
        for file in folder.glob("*.toml")
        if file.stem != "models"
    }


def read_study(name: str) -> StudySource:
    """The study ``experiments/NAME.toml``, or that of a path; raises UsageError."""
    path = Path(name)
    if path.suffix != ".toml":
        files = study_files()
        if name not in files:
            raise unknown_name("sweep", name, sorted(files), "or a path")
        path = files[name]
    file = validated(StudyFile, read_toml(path), str(path))
    return StudySource(
        name=path.stem,
        file=file,
        text=path.read_text(encoding="utf-8"),
        path=path,
        plugins={each: _source(path, each) for each in file.plugins.files},
    )


def _source(study: Path, file: str) -> str:
    path = study.parent / file
    if not path.resolve().is_relative_to(study.parent.resolve()):
        raise UsageError(f"{study}: the plug-in {file} lies outside of the study's folder: move it")
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as exc:
        raise UsageError(f"{study}: the plug-in {file} cannot be read: {exc}") from exc
