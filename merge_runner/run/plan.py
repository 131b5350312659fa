"""What a sweep consists of: its trials in order, their ids and what their hash covers."""

from __future__ import annotations

import hashlib
import math
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainSerializer,
    computed_field,
    field_serializer,
    model_validator,
)

from merge_runner.config import (
    MOST_REPETITIONS,
    REHEARSAL,
    ModelEntry,
    ScenarioConfig,
    both_sides,
    endpoint_identity,
    pair_name,
)
from merge_runner.drivers.pace import model_pace
from merge_runner.drivers.registry import PROGRAMS, HumanTrials, Program
from merge_runner.errors import UsageError
from merge_runner.llm.content_hashes import SPEC_VERSION, canonical_json, spec_hash
from merge_runner.llm.formats import FORMATS
from merge_runner.llm.models import load_models
from merge_runner.prompts.blocks import VARIANTS, block_digests, blocks_of
from merge_runner.records import SIDES, Side, TrialSpec
from merge_runner.results.database import read_database
from merge_runner.scenarios.merge.conditions import (
    CONDITIONS,
    HUMAN_CONDITIONS,
    MEAN_SPEED_MPS,
)
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner.scenarios.merge.world import World
from merge_runner.study.crossing import (
    OPPONENT,
    PERCEPTION,
    PROMPT,
    SET_BY,
    Arm,
    chosen_models,
    cross,
    file_prompts,
    listed_levels,
)
from merge_runner.study.file import (
    EVERY_CONDITION,
    EVERY_PROMPT,
    BudgetTerms,
    StudyFile,
    StudySource,
)
from merge_runner.study.parts import load_study
from merge_runner.text_safety import in_a_name

# A trial takes about 10 s at 10 m/s over the last 100 m: 10 or 11 prompts a driver.
_PROMPTS_PER_DRIVER = 10.5
DRIVERS_SHOWN = 3


@dataclass(frozen=True, slots=True)
class Options:
    """How a sweep runs; nothing here changes a result.

    ``rpm`` and ``tpm`` override the registry's. ``max_cost_usd`` is a cap over ``ledgers``, too,
    those of other sweeps.
    ``dask`` names the cluster that plays the trials; if None, this process plays them.
    A ``dry_run`` sends nothing, a ``quiet`` run shows no progress, and one that is to
    ``keep_going`` asks a model on that gives no valid decision. In a ``batch`` run all trials ask
    together, at a lower price.
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


def _stored_study(study: StudySource) -> dict[str, object]:
    return {"name": study.name, "text": study.text, "plugins": study.plugins}


def _study_of(stored: object) -> object:
    """Return a stored study as it was read; it has no path any more."""
    if not isinstance(stored, dict):
        return stored
    file = StudyFile.model_validate(tomllib.loads(stored["text"]))
    return StudySource(file=file, path=Path(f"{stored['name']}.toml"), **stored)


class Plan(BaseModel):
    """A sweep before it runs: the arms of its study, each played in all conditions.

    The column ``sweeps.config`` holds it as JSON, from which it is read again. ``entries`` are the
    language models of all arms by what an arm's ``asked`` calls them, and ``endpoints`` the
    identities of their endpoints (see ``config.Endpoint``). ``mirror``: its pairs are played both
    ways round whatever its file says. ``seat`` is ``first`` where only the first situations are
    asked (see ``run.seat``), and empty in a sweep.
    """

    model_config = ConfigDict(frozen=True, serialize_by_alias=True)

    name: str
    study: Annotated[StudySource, BeforeValidator(_study_of), PlainSerializer(_stored_study)]
    drivers: tuple[str, ...]
    arms: tuple[Arm, ...]
    entries: dict[str, ModelEntry] = Field(serialization_alias="models")
    endpoints: dict[str, str]
    conditions: tuple[str, ...]
    sample_set: int
    order_seed: int
    seat: Literal["", "first"] = ""
    mirror: bool = False

    @model_validator(mode="before")
    @classmethod
    def _give_arms_their_entries(cls, stored: Any) -> Any:  # noqa: ANN401 # anything that is stored
        """Read a stored plan, where an arm names its models and holds none."""
        if not isinstance(stored, dict) or "models" not in stored:
            return stored
        entries = stored["models"]
        arms = [
            {**arm, "entries": {n: entries[n] for n in arm["asked"].values() if n in entries}}
            for arm in stored["arms"]
        ]
        return {**stored, "entries": entries, "arms": arms}

    @field_serializer("arms")
    def _arms_without_entries(self, arms: tuple[Arm, ...]) -> list[dict[str, object]]:
        return [asdict(replace(arm, entries={})) for arm in arms]

    @computed_field  # type: ignore[prop-decorator] # https://github.com/python/mypy/issues/14461
    @property
    def model(self) -> str:
        """Who drives but for opponents, as ids of sweeps say, with a comma between models."""
        pairs = (both_sides(name).values() for name in self.drivers)
        return ",".join("+".join(dict.fromkeys(pair)) for pair in pairs)

    @property
    def ledger(self) -> str:
        """The name of the ledger that holds the sweep's spending over all its runs.

        A study with a budget of its own has one ledger over all its models and samples.
        """
        if self.study.file.budget != BudgetTerms():
            return self.study.name
        models = ",".join(sorted(self.model.split(",")))
        seat = f"/{self.seat}" if self.seat else ""
        return f"{self.study.name}/{models}/set{self.sample_set}{seat}"

    @property
    def registered(self) -> dict[str, str]:
        """The names in the registry of the models of ``entries``, whatever their parameters."""
        return {arm.asked[side]: arm.sides[side] for arm in self.arms for side in SIDES}

    @property
    def scenario(self) -> ScenarioConfig:
        """The first arm's."""
        return self.arms[0].scenario

    @computed_field  # type: ignore[prop-decorator] # as above
    @property
    def repetitions(self) -> dict[str, int]:
        """Prompt variant to repetitions."""
        return {arm.variant: arm.repetitions for arm in self.arms}

    @computed_field  # type: ignore[prop-decorator] # as above
    @property
    def levels(self) -> dict[str, list[str]]:
        """The levels of each factor of its file, a factor's reference first."""
        models = (arm.model_level for arm in self.arms)
        return listed_levels(self.study.file, models, self.repetitions)

    @computed_field  # type: ignore[prop-decorator] # as above
    @property
    def description(self) -> str:
        """What the study's file says of it."""
        return self.study.file.description

    @property
    def trials(self) -> int:
        """The number of trials."""
        return sum(arm.repetitions for arm in self.arms) * len(self.conditions)

    @property
    def calls_of_a_trial(self) -> float:
        """How many calls a trial usually takes, on the average over the arms."""
        calls = sum(
            arm.repetitions
            * usual_prompts(arm)
            * sum(name in arm.entries for name in arm.asked.values())
            for arm in self.arms
        )
        return calls / sum(arm.repetitions for arm in self.arms)

    @property
    def scripted(self) -> bool:
        """Whether the emulator takes part."""
        return any(map(_is_scripted, self.arms))

    @property
    def is_rehearsal(self) -> bool:
        """Whether the emulator takes the place of the providers."""
        return REHEARSAL in self.endpoints.values()

    @property
    def replays_humans(self) -> bool:
        """Whether imported human trials are replayed, which only this process has read."""
        return any(map(_replayed, self.arms))

    @property
    def driver(self) -> str:
        """The drivers with their endpoints; see ``pair_name``."""
        pairs = (pair_name(arm.names, self.endpoints) for arm in self.arms)
        names = list(dict.fromkeys(pairs))
        more = f" and {len(names) - DRIVERS_SHOWN} more" if len(names) > DRIVERS_SHOWN else ""
        return ", ".join(names[:DRIVERS_SHOWN]) + more

    def within_budget(self, options: Options) -> Options:
        """Return the options with the cap of the study's budget; ``--max-cost`` goes before it."""
        if options.max_cost_usd is not None:
            return options
        return replace(options, max_cost_usd=self.study.file.budget.total_usd)

    def notes(self) -> Iterator[str]:
        """What a user may have meant otherwise."""
        if self.is_rehearsal:
            yield (
                f"REHEARSAL: the emulator answers as {self.driver}, ten times as fast as the "
                "model; nothing is sent to the provider, and nobody charges"
            )
        prompts = self.study.file.prompts
        used = {*self.repetitions, *(prompt.based_on for prompt in prompts.values())}
        if unused := [name for name in prompts if name not in used]:
            yield f"note: not played, though {self.study.path} has them: {', '.join(unused)}"
        yield from dict.fromkeys(filter(None, map(self._finer_world, self.arms)))
        levels = {str(each) for name in SET_BY for each in self.study.file.factors.get(name, ())}
        if unused := [name for name in self.study.file.perception if name not in levels]:
            yield (
                f"note: no level of the factor {PERCEPTION}, though {self.study.path} has them: "
                + ", ".join(unused)
            )

    def _finer_world(self, arm: Arm) -> str:
        """A note where the drivers of an arm need a finer world than the study's own."""
        step_s = arm.scenario.step_s
        if step_s == self.study.file.scenario.step_s or "step_s" in arm.factors:
            return ""
        return f"note: {arm.model} is driven in steps of {step_s:g} s, as its drivers need"

    @property
    def capped_by(self) -> str:
        """Where a user raises what may be spent."""
        own = self.study.file.budget != BudgetTerms()
        return f"[budget] of {self.study.path}, or --max-cost," if own else "--max-cost"

    def by_label(self) -> dict[str, Arm]:
        """The arms by the labels that their trials carry."""
        return {arm.label: arm for arm in self.arms}

    def with_entries(self, entries: dict[str, ModelEntry]) -> Plan:
        """The same with other entries for the same names, in its arms too."""
        arms = (
            replace(arm, entries={name: entries[name] for name in arm.entries}) for arm in self.arms
        )
        return self.model_copy(update={"arms": tuple(arms), "entries": entries})

    def specs(self) -> dict[str, str]:
        """Spec hash to the canonical JSON that it covers."""
        texts = (self.spec(arm, name) for arm in self.arms for name in self.conditions)
        return {spec_hash(text): text for text in texts}

    def spec(self, arm: Arm, condition: str) -> str:
        """What determines a trial of an arm, but for its condition's headway and relative velocity.

        These stand in its row, where a change of them is refused; another mean speed does not.
        """
        mean_speed_mps = CONDITIONS[condition].mean_speed_mps
        return canonical_json(
            {
                "spec_version": SPEC_VERSION,
                "scenario": arm.scenario.model_dump(),
                "prompt_blocks": block_digests(arm.variant) if arm.entries else {},
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
        hashes = {
            (arm.label, name): spec_hash(self.spec(arm, name))
            for arm in self.arms
            for name in self.conditions
        }
        cells = [
            (repetition, arm, condition)
            for repetition in range(1, max(arm.repetitions for arm in self.arms) + 1)
            for arm in self.arms
            if repetition <= arm.repetitions
            for condition in self.conditions
        ]
        cells.sort(
            key=lambda cell: (cell[0], _lot(self.order_seed, cell[0], cell[1].label, cell[2]))
        )
        return [
            TrialSpec(
                trial_id=self.trial_id_of(arm, condition, repetition),
                spec_hash=hashes[arm.label, condition],
                source="seat" if self.seat else "llm" if arm.entries else "driver",
                model_left=arm.sides["left"],
                model_right=arm.sides["right"],
                variant=arm.variant,
                condition=condition,
                repetition=repetition,
                sample_set=self.sample_set,
                order=order,
                scripted=_is_scripted(arm),
                factors=tuple(arm.factors.items()),
                arm=arm.label,
            )
            for order, (repetition, arm, condition) in enumerate(cells)
        ]

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
        return f"{seat}{arm.model}/{arm.variant}/{condition}/rep{repetition:02d}{set_}{levels}"

    def _driver(self, arm: Arm, side: Side) -> dict[str, object]:
        name = arm.asked[side]
        entry = arm.entries.get(name)
        if entry is None:
            return PROGRAMS[name].in_spec(name)
        sent = FORMATS[entry.format].request(entry, "")
        return {
            "endpoint": self.endpoints[name],
            "path": sent.path,
            "headers": sent.headers,
            "body": sent.body,
        }


def most_prompts(arm: Arm) -> int:
    """How many prompts a trial of an arm takes a language model at most: up to the timeout."""
    return math.ceil(arm.scenario.timeout_steps / model_pace(arm.scenario).interval_steps)


def usual_prompts(arm: Arm) -> float:
    """How many prompts it usually takes a language model."""
    return min(_PROMPTS_PER_DRIVER, most_prompts(arm))


def _is_scripted(arm: Arm) -> bool:
    return any(entry.provider == "emulator" for entry in arm.entries.values())


def _lot(*what: object) -> str:
    """A sort key that orders trials randomly, but the same way on every machine."""
    return hashlib.sha256("/".join(map(str, what)).encode()).hexdigest()


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
    trust: bool = False,
) -> Plan:
    """The plan of a study's file and what a user asks for; None or nothing keeps the file's value.

    Uses the study's catalogue (``study.parts.load_study``, which ``trust`` is for), and the human
    trials of ``db`` where they are to be replayed. Raises UsageError.
    """
    asked = (models,) if isinstance(models, str) else tuple(models)
    study = load_study(sweep, asked, trust=trust)
    registry = load_models(study.path.parent)
    if sample_set < 0:
        raise UsageError("--sample-set is a whole number from 0")
    drivers = chosen_models(study.file, asked)
    wanted = _repetitions(study, variants, repetitions)
    names = _conditions(study.file, conditions)
    arms = cross(
        study.file, drivers, wanted, registry, only or {}, conditions=len(names), mirror=mirror
    )
    if db is not None:
        _read_humans(arms, db)
    _check_conditions(names, arms)
    entries = {name: entry for arm in arms for name, entry in arm.entries.items()}
    return Plan(
        name=study.name,
        study=study,
        drivers=drivers,
        arms=tuple(arms),
        entries=entries,
        endpoints={name: endpoint_identity(entry) for name, entry in entries.items()},
        conditions=names,
        sample_set=sample_set,
        order_seed=order_seed,
        mirror=mirror,
    )


def _replayed(arm: Arm) -> list[tuple[Program, HumanTrials]]:
    """Return the programs of an arm that replay human trials, with these."""
    programs = (PROGRAMS[name] for name in {*arm.asked.values()} - {*arm.entries})
    return [(program, program.data) for program in programs if program.data is not None]


def _read_humans(arms: Iterable[Arm], db: Path) -> None:
    """Read the human trials of a database where a program replays them."""
    if replayed := {humans for arm in arms for _, humans in _replayed(arm)}:
        with read_database(db) if db.is_file() else nullcontext() as connection:
            for humans in replayed:
                humans.read(connection)


def _conditions(file: StudyFile, chosen: Sequence[str] | None) -> tuple[str, ...]:
    wanted = next(c for c in (chosen, file.conditions, HUMAN_CONDITIONS) if c is not None)
    conditions = tuple(
        dict.fromkeys(
            name
            for each in wanted
            for name in (HUMAN_CONDITIONS if each == EVERY_CONDITION else (each,))
        )
    )
    if not conditions:
        raise UsageError(f"no condition is left; valid: {', '.join(CONDITIONS)}")
    return conditions


def _check_conditions(conditions: Sequence[str], arms: Sequence[Arm]) -> None:
    """Raise UsageError for a condition that an arm cannot be played in."""
    for name in conditions:
        for arm in arms:
            World(arm.scenario, CONDITIONS.require(name), TRACK)
            for program, humans in _replayed(arm):
                humans.check(program, arm.scenario, name, arm.repetitions)


def _repetitions(
    study: StudySource, variants: Sequence[str] | None, chosen: int | None
) -> dict[str, int]:
    """The wanted prompts with their repetitions per condition; raises UsageError."""
    if chosen is not None and not 1 <= chosen <= MOST_REPETITIONS:
        raise UsageError(f"--reps is a whole number from 1 to {MOST_REPETITIONS}")
    given = dict(study.file.repetitions)
    for_all = given.pop(EVERY_PROMPT, None)
    listed = file_prompts(study.file)
    for variant in (*given, *listed, *(variants or ())):
        blocks_of(variant)
    for name in given:
        if name not in {*listed, *(variants or ())}:
            raise UsageError(
                f"{study.path} has repetitions for {name}, which is never played: name it in the "
                f"factor {PROMPT}, which has {', '.join(listed)}"
            )
    wanted: dict[str, int] = {}
    for variant in listed if variants is None else variants:
        repetitions = chosen or given.get(variant, for_all)
        if repetitions is None:
            raise UsageError(
                f"the sweep {study.name} has no variant {variant}; it has {', '.join(given)}. "
                "With --reps N any variant can be run."
            )
        wanted[variant] = repetitions
    if not wanted:
        raise UsageError(f"the sweep {study.name} has no variant; valid: {', '.join(VARIANTS)}")
    return wanted
