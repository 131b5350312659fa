"""A sweep before it runs: its arms, its conditions, and its trials in order."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, InstanceOf, computed_field

from merge_runner.config import ScenarioConfig, validated
from merge_runner.driver_names import both_sides, pair_name
from merge_runner.drivers.pace import model_pace
from merge_runner.errors import UsageError
from merge_runner.llm.models import load_models
from merge_runner.providers import ModelEntry, endpoint_identity
from merge_runner.records import SIDES
from merge_runner.registry import Catalogue, Registry, require, using
from merge_runner.run.parts import Parts, find_parts
from merge_runner.run.selection import grid_conditions, selected_conditions, selected_repetitions
from merge_runner.run.spec import spec_text, trial_id
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner.scenarios.merge.world import World
from merge_runner.study.arms import Arm
from merge_runner.study.crossing import chosen_models, cross, listed_levels
from merge_runner.study.file import MEASURES, StudySource
from merge_runner.study.parts import load_study
from merge_runner.trial_records import TrialSpec, spec_hash

# A trial takes about 10 s at 10 m/s over the last 100 m: 10 or 11 prompts a driver.
_PROMPTS_PER_DRIVER = 10.5


class Plan(BaseModel):
    """A sweep before it runs: the arms of its study, each played in all conditions.

    The column ``sweeps.config`` holds it as JSON, from which it is read again. ``model`` names
    the drivers except opponents, separated by commas, as ids of sweeps do. ``levels`` has the
    levels of each factor of its file, the reference first. ``entries`` are the language models of
    all arms by their names in an arm's ``full_names``, and ``endpoints`` the identities of their
    endpoints (``providers.Endpoint``). ``first`` is ``first`` where only first decisions are asked,
    and empty in a sweep. ``parts`` are no part of the JSON: a plan that is read has none.
    """

    model_config = ConfigDict(frozen=True, serialize_by_alias=True, validate_by_name=True)

    name: str
    study: StudySource
    model: str
    levels: dict[str, list[str]]
    description: str
    arms: tuple[Arm, ...]
    entries: dict[str, ModelEntry] = Field(validation_alias="models", serialization_alias="models")
    endpoints: dict[str, str]
    conditions: tuple[str, ...]
    sample_set: int
    order_seed: int
    first: Literal["", "first"] = Field("", validation_alias="seat", serialization_alias="seat")
    parts: Annotated[InstanceOf[Parts], Field(exclude=True)] = Parts()

    @property
    def ledger(self) -> str:
        """The name of the ledger that holds the sweep's spending over all its runs.

        A study with a budget of its own has one ledger over all its models and samples.
        """
        if self.study.file.budget:
            return self.study.name
        models = ",".join(sorted(self.model.split(",")))
        first = f"/{self.first}" if self.first else ""
        return f"{self.study.name}/{models}/set{self.sample_set}{first}"

    @property
    def registered(self) -> dict[str, str]:
        """Names in the registry, of models and programs, by an arm's ``full_names``."""
        return {arm.full_names[side]: arm.sides[side] for arm in self.arms for side in SIDES}

    @computed_field  # type: ignore[prop-decorator] # https://github.com/python/mypy/issues/14461
    @property
    def repetitions(self) -> dict[str, int]:
        """Repetitions by prompt variant."""
        return {arm.variant: arm.repetitions for arm in self.arms}

    @property
    def trials(self) -> int:
        """The number of trials."""
        return sum(arm.repetitions for arm in self.arms) * len(self.conditions)

    @property
    def scripted(self) -> bool:
        """True where the emulator, a mock model, takes part."""
        return any(arm.is_scripted for arm in self.arms)

    @property
    def is_free(self) -> bool:
        """True where no model costs anything."""
        return all(entry.price == "free" for entry in self.entries.values())

    @property
    def driver(self) -> str:
        """The drivers with their endpoints, as text."""
        pairs = (pair_name(arm.names, self.endpoints) for arm in self.arms)
        return ", ".join(dict.fromkeys(pairs))

    def by_label(self) -> dict[str, Arm]:
        """Return the arms by the labels that their trials carry."""
        return {arm.label: arm for arm in self.arms}

    def specs(self) -> dict[str, str]:
        """Return the canonical JSON that each spec hash covers."""
        texts = (spec_text(self, *crossed) for crossed in product(self.arms, self.conditions))
        return {spec_hash(text): text for text in texts}

    def trial_specs(self) -> list[TrialSpec]:
        """Return all trials, repetition by repetition: an unfinished sweep is balanced, too.

        Within a repetition the order is random, by the order seed, so that no condition or arm
        always comes first: a service that drifts over hours affects all of them alike.
        """
        specs = [
            TrialSpec(
                trial_id=trial_id(self, arm, condition, repetition),
                spec_hash=hashed,
                source="first_decision" if self.first else "llm" if arm.entries else "driver",
                model_left=arm.sides["left"],
                model_right=arm.sides["right"],
                variant=arm.variant,
                condition=condition,
                repetition=repetition,
                sample_set=self.sample_set,
                order=0,
                scripted=arm.is_scripted,
                factors=tuple(arm.factors.items()),
                words=frozenset(self.study.file.texts),
                focal=arm.focal,
                prompts=arm.prompts,
                arm=arm.label,
                kinematics=self.parts.conditions[condition],
            )
            for arm, condition in product(self.arms, self.conditions)
            for hashed in (spec_hash(spec_text(self, arm, condition)),)
            for repetition in range(1, arm.repetitions + 1)
        ]

        def shuffle_key(spec: TrialSpec) -> tuple[int, str]:
            # The same order on every machine.
            drawn_for = f"{self.order_seed}/{spec.repetition}/{spec.arm}/{spec.condition}"
            return spec.repetition, hashlib.sha256(drawn_for.encode()).hexdigest()

        specs.sort(key=shuffle_key)
        return [replace(spec, order=order) for order, spec in enumerate(specs)]


def usual_prompts(arm: Arm) -> float:
    """Return the usual number of prompts to a language model in a trial of an arm."""
    most = math.ceil(arm.scenario.timeout_steps / model_pace(arm.scenario).interval_steps)
    return min(_PROMPTS_PER_DRIVER, most)


def make_plan(
    sweep: str,
    models: str | Sequence[str] = (),
    repetitions: int | None = None,
    conditions: Sequence[str] | None = None,
    variants: Sequence[str] | None = None,
    *,
    sample_set: int = 0,
    order_seed: int = 0,
    only: Mapping[str, Sequence[str]] | None = None,
    db: Path | None = None,
    mirror: bool = False,
    first: bool = False,
    grid: str | None = None,
    trust: bool = False,
    registered: Catalogue | None = None,
) -> Plan:
    """Return the plan of a study's file and a user's choices; an empty choice keeps the file's.

    ``first``: only the first decisions, in the conditions or on a ``grid`` (``grid_conditions``).
    ``registered`` are parts beside those that the study itself adds; ``trust`` agrees to run its
    code. ``db`` has the human trials that are to be replayed. Raises UsageError.
    """
    if grid is not None:
        if conditions is not None or not first:
            raise UsageError("a grid takes the place of the conditions, with --first alone")
        conditions = grid_conditions(grid)
    if sample_set < 0:
        raise UsageError("--sample-set is a whole number from 0")
    chosen = (models,) if isinstance(models, str) else tuple(models)
    study, catalogue = load_study(sweep, chosen, trust=trust, registered=registered)
    file = study.file
    drivers = chosen_models(file, chosen)
    pairs = (dict.fromkeys(both_sides(name).values()) for name in drivers)
    with using(catalogue):
        _check_primary(file.primary)
        registry = load_models(study.path.parent)
        selected = selected_repetitions(study, variants, repetitions)
        names = selected_conditions(file, conditions)
        arms = cross(
            file, drivers, selected, registry, only or {}, conditions=len(names), mirror=mirror
        )
        entries = {name: entry for arm in arms for name, entry in arm.entries.items()}
        endpoints = {name: endpoint_identity(entry) for name, entry in entries.items()}
    parts = find_parts(arms, names, catalogue).with_humans_of(db)
    _check_arms(arms, parts, first=first)
    if first:
        arms = list(map(_first_decision, arms))
    return Plan(
        name=f"{study.name}-first" if first else study.name,
        study=study,
        model=",".join(map("+".join, pairs)),
        levels=listed_levels(file, (arm.model_level for arm in arms), selected),
        description=file.description,
        arms=tuple(arms),
        entries=entries,
        endpoints=endpoints,
        conditions=names,
        sample_set=sample_set,
        order_seed=order_seed,
        first="first" if first else "",
        parts=parts,
    )


def _check_primary(measure: str) -> None:
    """Raise UsageError unless a study's primary measure can be tested."""
    metrics = [item for parts in Registry.made if parts.kind == "metric" for item in parts.items()]
    tested = [name for name, metric in metrics if metric.estimator != "median"]
    hint = "as the study's primary one; a median is not tested"
    require(dict.fromkeys([*MEASURES, *tested]), "measure", measure, hint)


def _first_decision(arm: Arm) -> Arm:
    """Return the arm with a timeout before its drivers would decide a second time.

    Such a trial is planned, played, kept and checked as any other; its calls have the texts and the
    slots, and so the keys, of the first decisions of the study's sweep. Its source is
    ``first_decision``, which tables of whole trials leave out.
    """
    given = arm.scenario.model_dump(exclude_unset=True)
    given["timeout_s"] = 1 / arm.scenario.prompt_rate_hz
    return replace(arm, scenario=validated(ScenarioConfig, given, "scenario"))


def _check_arms(arms: Sequence[Arm], parts: Parts, *, first: bool) -> None:
    """Check all crossings of arms and conditions.

    Raises UsageError if an arm cannot be played in a condition, or if ``first`` decisions are asked
    and one of its drivers cannot make any.
    """
    for arm, (name, condition) in product(arms, parts.conditions.items()):
        world = World(arm.scenario, condition, TRACK)
        if first and not all(map(world.in_control, SIDES)):
            raise UsageError(
                f"{name}: a vehicle is in its tunnel yet when the first driver decides. First "
                'situations need control_start = "both_exits"'
            )
        for driver in {*arm.full_names.values()} - {*arm.entries}:
            program = parts.programs[driver]
            if program.data is not None:
                program.data.check(program, arm.scenario, name, arm.repetitions)
