"""What a sweep consists of: its trials in order, their ids and what their hash covers."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, InstanceOf, computed_field

from merge_runner.config import (
    ModelEntry,
    ScenarioConfig,
    both_sides,
    endpoint_identity,
    pair_name,
    validated,
)
from merge_runner.drivers.pace import model_pace
from merge_runner.errors import UsageError
from merge_runner.llm.models import load_models
from merge_runner.prompts.blocks import decomposed
from merge_runner.records import (
    SIDES,
    SPEC_VERSION,
    Side,
    TrialSpec,
    canonical_json,
    spec_hash,
)
from merge_runner.registry import Catalogue, Registry, require, using
from merge_runner.results.database import read_database
from merge_runner.run.parts import Parts, find_parts
from merge_runner.run.selection import grid_conditions, selected_conditions, selected_repetitions
from merge_runner.scenarios.merge.conditions import (
    MEAN_SPEED_MPS,
)
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner.scenarios.merge.world import World
from merge_runner.study.crossing import (
    FOCAL,
    OPPONENT,
    PROMPT,
    Arm,
    chosen_models,
    cross,
    listed_levels,
)
from merge_runner.study.file import (
    MEASURES,
    StudySource,
)
from merge_runner.study.parts import load_study
from merge_runner.text_safety import in_a_name

if TYPE_CHECKING:
    pass

# A trial takes about 10 s at 10 m/s over the last 100 m: 10 or 11 prompts a driver.
_PROMPTS_PER_DRIVER = 10.5


class Plan(BaseModel):
    """A sweep before it runs: the arms of its study, each played in all conditions.

    The column ``sweeps.config`` holds it as JSON, from which it is read again. ``model`` says who
    drives but for opponents, as ids of sweeps do, with a comma between models. ``levels`` are those
    of each factor of its file, a factor's reference first. ``entries`` are the language models of
    all arms by what an arm's ``asked`` calls them, and ``endpoints`` the identities of their
    endpoints (see ``config.Endpoint``). ``seat`` is ``first`` where only first decisions are asked,
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
    seat: Literal["", "first"] = ""
    parts: Annotated[InstanceOf[Parts], Field(exclude=True)] = Parts()

    @property
    def ledger(self) -> str:
        """The name of the ledger that holds the sweep's spending over all its runs.

        A study with a budget of its own has one ledger over all its models and samples.
        """
        if self.study.file.budget:
            return self.study.name
        models = ",".join(sorted(self.model.split(",")))
        seat = f"/{self.seat}" if self.seat else ""
        return f"{self.study.name}/{models}/set{self.sample_set}{seat}"

    @property
    def registered(self) -> dict[str, str]:
        """The names in the registry of the models of ``entries``, whatever their parameters."""
        return {arm.asked[side]: arm.sides[side] for arm in self.arms for side in SIDES}

    @computed_field  # type: ignore[prop-decorator] # https://github.com/python/mypy/issues/14461
    @property
    def repetitions(self) -> dict[str, int]:
        """Prompt variant to repetitions."""
        return {arm.variant: arm.repetitions for arm in self.arms}

    @property
    def trials(self) -> int:
        """The number of trials."""
        return sum(arm.repetitions for arm in self.arms) * len(self.conditions)

    @property
    def usual_calls(self) -> dict[str, float]:
        """How many calls all trials usually take, by the model's name in ``entries``."""
        calls = dict.fromkeys(self.entries, 0.0)
        for arm in self.arms:
            for name in arm.asked.values():
                if name in arm.entries:
                    calls[name] += arm.repetitions * usual_prompts(arm) * len(self.conditions)
        return calls

    @property
    def scripted(self) -> bool:
        """Whether the emulator takes part."""
        return any(arm.is_scripted for arm in self.arms)

    @property
    def is_free(self) -> bool:
        """Whether no model costs anything."""
        return all(entry.price == "free" for entry in self.entries.values())

    @property
    def replays_humans(self) -> bool:
        """Whether imported human trials are replayed, which only this process has read."""
        return self.parts.replays_humans

    @property
    def driver(self) -> str:
        """The drivers with their endpoints; see ``pair_name``."""
        pairs = (pair_name(arm.names, self.endpoints) for arm in self.arms)
        return ", ".join(dict.fromkeys(pairs))

    def by_label(self) -> dict[str, Arm]:
        """The arms by the labels that their trials carry."""
        return {arm.label: arm for arm in self.arms}

    def specs(self) -> dict[str, str]:
        """Spec hash to the canonical JSON that it covers."""
        texts = (self.spec(arm, name) for arm in self.arms for name in self.conditions)
        return {spec_hash(text): text for text in texts}

    def spec(self, arm: Arm, condition: str) -> str:
        """What determines a trial of an arm, but for its condition's headway and relative velocity.

        These stand in its row, where a change of them is refused; another mean speed does not.
        """
        mean_speed_mps = self.parts.conditions[condition].mean_speed_mps
        return canonical_json(
            {
                "spec_version": SPEC_VERSION,
                "scenario": arm.scenario.model_dump(),
                "prompt_blocks": self._prompt_blocks(arm),
                "left": self._driver(arm, "left"),
                "right": self._driver(arm, "right"),
                "sample_set": self.sample_set,
                **({} if mean_speed_mps == MEAN_SPEED_MPS else {"mean_speed_mps": mean_speed_mps}),
            }
        )

    def trial_specs(self) -> list[TrialSpec]:
        """All trials, repetition by repetition, so that an unfinished sweep is balanced, too.

        Within a repetition the order is random, by the order seed, so that no condition or arm
        always comes first: a service that drifts over hours affects all of them alike.
        """
        specs = [
            TrialSpec(
                trial_id=self.trial_id_of(arm, condition, repetition),
                spec_hash=hashed,
                source="first_decision" if self.seat else "llm" if arm.entries else "driver",
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
            for hashed in (spec_hash(self.spec(arm, condition)),)
            for repetition in range(1, arm.repetitions + 1)
        ]

        def place(spec: TrialSpec) -> tuple[int, str]:
            # The same way on every machine.
            drawn_for = f"{self.order_seed}/{spec.repetition}/{spec.arm}/{spec.condition}"
            return spec.repetition, hashlib.sha256(drawn_for.encode()).hexdigest()

        return [replace(spec, order=order) for order, spec in enumerate(sorted(specs, key=place))]

    def trial_id_of(self, arm: Arm, condition: str, repetition: int) -> str:
        """The id of a trial of an arm."""
        seat = "seat/" if self.seat else ""
        set_ = f"/set{self.sample_set}" if self.sample_set else ""
        # The prompt and the opponent stand in it already.
        levels = "".join(
            f"/{name}={in_a_name(level)}"
            for name, level in sorted(arm.factors.items())
            if name not in (PROMPT, OPPONENT)
        )
        prompt, _ = decomposed(arm.variant)
        focal = f"/{FOCAL}={arm.focal}" if arm.focal else ""
        return f"{seat}{arm.model}/{prompt}/{condition}/rep{repetition:02d}{set_}{levels}{focal}"

    def _prompt_blocks(self, arm: Arm) -> dict[str, str]:
        """The digests of the prompt's blocks; one that a single driver is told names its side."""
        left, right = (
            self.parts.prompts[arm.prompt(side)].digests if arm.asked[side] in arm.entries else None
            for side in SIDES
        )
        if left is None or right is None:
            return left or right or {}
        both = left.items() & right.items()
        return dict(both) | {
            f"{name}@{side}": digest
            for side, digests in (("left", left), ("right", right))
            for name, digest in digests.items() - both
        }

    def _driver(self, arm: Arm, side: Side) -> dict[str, object]:
        name = arm.asked[side]
        entry = arm.entries.get(name)
        if entry is None:
            return self.parts.programs[name].in_spec(name)
        sent = self.parts.formats[entry.format].request(entry, "")
        return {
            "endpoint": self.endpoints[name],
            "path": sent.path,
            "headers": sent.headers,
            "body": sent.body,
        }


def usual_prompts(arm: Arm) -> float:
    """How many prompts a trial of an arm usually takes a language model."""
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
    own: Catalogue | None = None,
) -> Plan:
    """The plan of a study's file and what a user asks for; None or nothing keeps the file's value.

    ``first``: only the first situations, in the conditions or on a ``grid`` (``grid_conditions``).
    ``own`` are parts beside those that the study itself adds (``study.parts.load_study``, which
    ``trust`` is for); ``db`` has the human trials that are to be replayed. Raises UsageError.
    """
    if grid is not None:
        if conditions is not None or not first:
            raise UsageError("a grid takes the place of the conditions, with --first alone")
        conditions = grid_conditions(grid)
    if sample_set < 0:
        raise UsageError("--sample-set is a whole number from 0")
    asked = (models,) if isinstance(models, str) else tuple(models)
    study, catalogue = load_study(sweep, asked, trust=trust, own=own)
    file = study.file
    drivers = chosen_models(file, asked)
    pairs = (dict.fromkeys(both_sides(name).values()) for name in drivers)
    with using(catalogue):
        metrics = [item for each in Registry.made if each.kind == "metric" for item in each.items()]
        tested = [name for name, metric in metrics if metric.estimator != "median"]
        hint = "as the study's primary one; a median is not tested"
        require(dict.fromkeys([*MEASURES, *tested]), "measure", file.primary, hint)
        registry = load_models(study.path.parent)
        wanted = selected_repetitions(study, variants, repetitions)
        names = selected_conditions(file, conditions)
        arms = cross(
            file, drivers, wanted, registry, only or {}, conditions=len(names), mirror=mirror
        )
        entries = {name: entry for arm in arms for name, entry in arm.entries.items()}
        endpoints = {name: endpoint_identity(entry) for name, entry in entries.items()}
    parts = find_parts(arms, names, catalogue)
    if parts.replays_humans and db is not None:
        with read_database(db) if db.is_file() else nullcontext() as connection:
            parts = parts.with_humans(connection)
    _check_arms(arms, parts, first=first)
    if first:
        arms = list(map(_first_decision, arms))
    return Plan(
        name=f"{study.name}-first" if first else study.name,
        study=study,
        model=",".join(map("+".join, pairs)),
        levels=listed_levels(file, (arm.model_level for arm in arms), wanted),
        description=file.description,
        arms=tuple(arms),
        entries=entries,
        endpoints=endpoints,
        conditions=names,
        sample_set=sample_set,
        order_seed=order_seed,
        seat="first" if first else "",
        parts=parts,
    )


def _first_decision(arm: Arm) -> Arm:
    """The arm in trials whose time is up before their drivers would decide again.

    Such a trial is planned, played, kept and checked as any other; its calls have the texts and the
    slots, and so the keys, of the first decisions of the study's sweep. Its source is
    ``first_decision``, which tables of trials that were driven to their end leave out
    (``merge_runner_analysis.frames.TRIALS``).
    """
    given = arm.scenario.model_dump(exclude_unset=True)
    given["timeout_s"] = 1 / arm.scenario.prompt_rate_hz
    return replace(arm, scenario=validated(ScenarioConfig, given, "scenario"))


def _check_arms(arms: Sequence[Arm], parts: Parts, *, first: bool) -> None:
    """Check all crossings of arms and conditions.

    Raises UsageError for a condition that an arm cannot be played in, or both drivers of which
    cannot be asked ``first``.
    """
    for arm, (name, condition) in product(arms, parts.conditions.items()):
        world = World(arm.scenario, condition, TRACK)
        if first and not all(map(world.in_control, SIDES)):
            raise UsageError(
                f"{name}: a vehicle is in its tunnel yet when the first driver decides. First "
                'situations need control_start = "both_exits"'
            )
        for asked in {*arm.asked.values()} - {*arm.entries}:
            program = parts.programs[asked]
            if program.data is not None:
                program.data.check(program, arm.scenario, name, arm.repetitions)
