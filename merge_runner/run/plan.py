"""What a sweep consists of: its trials in order, their ids and what their hash covers."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from decimal import Decimal
from itertools import chain, product
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, InstanceOf, computed_field

from merge_runner.config import ScenarioConfig, validated
from merge_runner.driver_names import both_sides, pair_name
from merge_runner.drivers.pace import model_pace
from merge_runner.drivers.registry import PROGRAMS, Program
from merge_runner.errors import UsageError
from merge_runner.llm.formats import FORMATS, WireFormat
from merge_runner.llm.models import load_models
from merge_runner.prompts.blocks import VARIANTS, Prompt, blocks_of, decomposed, prompt_of
from merge_runner.providers import ModelEntry, endpoint_identity
from merge_runner.records import MOST_REPETITIONS, SIDES, Side, canonical_json
from merge_runner.registry import Catalogue, Registry, require, using
from merge_runner.results.database import read_database
from merge_runner.scenarios.merge.conditions import (
    CONDITIONS,
    HUMAN_CONDITIONS,
    MEAN_SPEED_MPS,
    NUMBER,
    Condition,
    condition_name,
)
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner.scenarios.merge.world import World
from merge_runner.study.arms import FOCAL, OPPONENT, PROMPT, Arm
from merge_runner.study.crossing import chosen_models, cross, file_prompts, listed_levels
from merge_runner.study.file import (
    EVERY_CONDITION,
    EVERY_PROMPT,
    MEASURES,
    StudyFile,
    StudySource,
)
from merge_runner.study.parts import load_study
from merge_runner.text_safety import in_a_name
from merge_runner.trial_records import SPEC_VERSION, TrialSpec, spec_hash

if TYPE_CHECKING:
    from collections.abc import Iterable

    from duckdb import DuckDBPyConnection

USUAL_GRID = "h=-6:6:2,dv=-1.6:1.6:0.4"
"""Projected headways in m and relative velocities in m/s, left minus right: FROM:TO:STEP."""
MOST_VALUES = 100  # of an axis
_AXIS = re.compile(
    f"(?P<name>h|dv)=(?P<first>{NUMBER})(:(?P<last>{NUMBER}):(?P<step>{NUMBER}))?", re.ASCII
)
# A trial takes about 10 s at 10 m/s over the last 100 m: 10 or 11 prompts a driver.
_PROMPTS_PER_DRIVER = 10.5


@dataclass(frozen=True, slots=True)
class Options:
    """How a sweep runs; nothing here changes a result.

    ``rpm`` and ``tpm`` override the registry's. ``max_cost_usd`` is a cap over ``ledgers``, too,
    those of other sweeps. ``dask`` names the cluster that plays the trials; None: this process. A
    ``dry_run`` sends nothing, a ``quiet`` run shows no progress, and one that is to ``keep_going``
    asks a model on that gives no valid decision. In a ``batch`` run all trials ask together, at a
    lower price. ``typed`` are the command's words after the program's name, with which it goes on.
    ``name`` is what its user calls the run.
    """

    db: Path
    cache: Path
    in_flight: int = 200
    rpm: int | None = None
    tpm: int | None = None
    max_cost_usd: float | None = None
    ledgers: Sequence[str] = ()
    replay: bool = False
    recordings: Sequence[Path] = ()
    strict_model: bool = False
    keep_going: bool = False
    quiet: bool = False
    dask: str | None = None
    dry_run: bool = False
    batch: bool = False
    typed: Sequence[str] = ()
    name: str = ""

    @property
    def connections(self) -> int:
        """How many connections a model may need: both drivers of a trial may ask at once."""
        return 2 * self.in_flight

    @property
    def sends_nothing(self) -> bool:
        """Whether no model may be asked."""
        return self.replay or self.dry_run

    def rates(self, entry: ModelEntry) -> tuple[int | None, int | None]:
        """The requests and tokens a minute that a model may get; None: no limit."""
        return self.rpm or entry.rpm, self.tpm or entry.tpm


@dataclass(frozen=True, eq=False)
class Parts:
    """What the names in a plan stand for.

    It is found when the plan is made, and not looked up again: another study may give the same
    names to other things. ``prompts`` are by variant; ``programs``, and the wire ``formats`` of
    models, are those of its arms. The ``catalogue`` is all that its study adds.
    """

    conditions: Mapping[str, Condition] = field(default_factory=dict)
    prompts: Mapping[str, Prompt] = field(default_factory=dict)
    programs: Mapping[str, Program] = field(default_factory=dict)
    formats: Mapping[str, WireFormat] = field(default_factory=dict)
    catalogue: Catalogue = field(default_factory=Catalogue)

    @property
    def replays_humans(self) -> bool:
        """Whether a program replays imported human trials."""
        return any(program.data is not None for program in self.programs.values())

    def with_code(self, arms: Iterable[Arm], catalogue: Catalogue, hint: str = "") -> Parts:
        """The same with the programs and wire formats of arms; raises UsageError, with a hint."""
        asked = {name: arm.entries.get(name) for arm in arms for name in arm.asked.values()}
        with using(catalogue):
            return replace(
                self,
                programs={n: PROGRAMS.require(n, hint) for n, entry in asked.items() if not entry},
                formats={e.format: FORMATS[e.format] for e in asked.values() if e},
                catalogue=catalogue,
            )

    def without_code(self) -> Parts:
        """The same without what is in a study's plug-ins, which are not everywhere."""
        return Parts(self.conditions, self.prompts)

    def with_humans(self, connection: DuckDBPyConnection | None) -> Parts:
        """The same with the human trials of a database, which are replayed; None: it has none."""
        programs = {name: each.replaying(connection) for name, each in self.programs.items()}
        return replace(self, programs=programs)


def find_parts(
    arms: Sequence[Arm], conditions: Iterable[str], catalogue: Catalogue, hint: str = ""
) -> Parts:
    """What the names in arms and conditions stand for where a catalogue is in use.

    Raises UsageError, with a ``hint``, where that is not known.
    """
    with using(catalogue):
        parts = Parts(
            {name: CONDITIONS.require(name, hint) for name in conditions},
            {
                name: prompt_of(name)
                for name in dict.fromkeys(chain.from_iterable(map(_read, arms)))
            },
        )
    return parts.with_code(arms, catalogue, hint)


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


def _read(arm: Arm) -> list[str]:
    """The variants of the prompts that language models read in an arm."""
    return [arm.prompt(side) for side in SIDES if arm.asked[side] in arm.entries]


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
    study, catalogue = load_study(sweep, asked, trust=trust, registered=own)
    file = study.file
    drivers = chosen_models(file, asked)
    pairs = (dict.fromkeys(both_sides(name).values()) for name in drivers)
    with using(catalogue):
        metrics = [item for each in Registry.made if each.kind == "metric" for item in each.items()]
        tested = [name for name, metric in metrics if metric.estimator != "median"]
        hint = "as the study's primary one; a median is not tested"
        require(dict.fromkeys([*MEASURES, *tested]), "measure", file.primary, hint)
        registry = load_models(study.path.parent)
        wanted = _repetitions(study, variants, repetitions)
        names = _conditions(file, conditions)
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


def grid_conditions(text: str) -> list[str]:
    """The names of the conditions of a grid such as USUAL_GRID, or ``usual``.

    ``h`` or ``dv`` may be one number, or be left out for that of the usual grid. Raises UsageError.
    """
    parts = USUAL_GRID if text == "usual" else f"{USUAL_GRID},{text}"
    points = list(product(*dict(map(_axis, parts.split(","))).values()))
    for point in points:
        Condition(*point)  # raises where a vehicle would not drive forwards
    return [condition_name(*point) for point in points]


def _axis(text: str) -> tuple[str, list[float]]:
    """Name and values of a part of a grid, computed in decimals: 3 * 0.4 is 1.2."""
    if axis := _AXIS.fullmatch(text.strip()):
        first = Decimal(axis["first"])
        last, step = Decimal(axis["last"] or first), Decimal(axis["step"] or 1)
        if step > 0 and 0 <= (last - first) / step < MOST_VALUES:
            count = int((last - first) / step) + 1
            return axis["name"], [float(first + i * step) for i in range(count)]
    raise UsageError(
        f"--grid: {text!r} is no axis of 1 to {MOST_VALUES} values; write --grid usual, or --grid "
        f"{USUAL_GRID}: FROM:TO:STEP or one number for each, with at most four decimals"
    )


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


def _conditions(file: StudyFile, chosen: Sequence[str] | None) -> tuple[str, ...]:
    wanted = next(c for c in (chosen, file.conditions, HUMAN_CONDITIONS) if c is not None)
    names = (HUMAN_CONDITIONS if each == EVERY_CONDITION else (each,) for each in wanted)
    if conditions := tuple(dict.fromkeys(chain.from_iterable(names))):
        return conditions
    raise UsageError(f"no condition is left; valid: {', '.join(CONDITIONS)}")


def _repetitions(
    study: StudySource, variants: Sequence[str] | None, chosen: int | None
) -> dict[str, int]:
    """The wanted prompts with their repetitions per condition; raises UsageError."""
    if chosen is not None and not 1 <= chosen <= MOST_REPETITIONS:
        raise UsageError(f"--reps is a whole number from 1 to {MOST_REPETITIONS}")
    given, wanted = study.file.repetitions, {}
    for variant in file_prompts(study.file) if variants is None else variants:
        VARIANTS.require(variant)
        blocks_of(variant)  # raises where it names a block that there is not
        wanted[variant] = chosen or given.get(variant, given.get(EVERY_PROMPT, 0))
    if wanted and all(wanted.values()):
        return wanted
    lacking = "".join(f" {variant}" for variant, repetitions in wanted.items() if not repetitions)
    raise UsageError(
        f"the sweep {study.name} has no variant{lacking}; valid: {', '.join(VARIANTS)}. With "
        "--reps N any variant can be run."
    )
