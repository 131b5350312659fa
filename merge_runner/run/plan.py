"""What a sweep consists of: its trials in order, their ids and what their hash covers."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Literal

from merge_runner.config import (
    MOST_REPETITIONS,
    ModelEntry,
    ScenarioConfig,
    SweepFile,
    both_sides,
    endpoint_identity,
    load_sweep,
    pair_name,
)
from merge_runner.drivers.pace import pace_of
from merge_runner.drivers.registry import PROGRAMS
from merge_runner.errors import UsageError
from merge_runner.llm.content_hashes import SPEC_VERSION, canonical_json, spec_hash
from merge_runner.llm.formats import FORMATS
from merge_runner.llm.ledger import Caps
from merge_runner.llm.models import load_models
from merge_runner.prompts.blocks import VARIANTS, block_digests, blocks_of
from merge_runner.records import Side, TrialSpec
from merge_runner.registry import require
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner.scenarios.registry import SCENARIOS, new_world, task_of

# A trial takes about 10 s at 10 m/s over the last 100 m: 10 or 11 prompts a driver.
PROMPTS_PER_DRIVER = 10.5


@dataclass(frozen=True, slots=True)
class Options:
    """How a sweep runs; nothing here changes a result.

    ``rpm`` and ``tpm`` override the registry's. ``split_usd`` caps what single models cost.
    ``dask`` names the cluster that plays the trials; if None, this process plays them.
    ``faults_identity`` keeps the answers of an emulator that was told to misbehave apart from those
    of the usual one. From ``until`` on no trial begins.
    """

    db: Path
    cache: Path
    in_flight: int = 200
    rpm: int | None = None
    tpm: int | None = None
    max_cost_usd: float | None = None
    split_usd: Mapping[str, float] = field(default_factory=dict)
    replay: bool = False
    recording: Path | None = None
    emulator_options: Sequence[str] = ()
    faults_identity: str = ""
    strict_model: bool = False
    dask: str | None = None
    until: datetime | None = None

    @property
    def caps(self) -> Caps:
        """What may be spent over all runs."""
        return Caps(self.max_cost_usd, self.split_usd)

    @property
    def connections(self) -> int:
        """How many connections a model may need: both drivers of a trial may ask at once."""
        return 2 * self.in_flight

    def rates(self, entry: ModelEntry) -> tuple[int | None, int | None]:
        """The requests and tokens a minute that a model may get; None: no limit."""
        return self.rpm or entry.rpm, self.tpm or entry.tpm


@dataclass(frozen=True, slots=True)
class Plan:
    """A sweep before it runs.

    ``entries`` are the language models on either side, ``endpoints`` the identities of their
    endpoints (see ``config.Endpoint``).
    """

    name: str
    model: str
    sides: dict[Side, str]
    entries: dict[str, ModelEntry]
    endpoints: dict[str, str]
    scenario: ScenarioConfig
    repetitions: dict[str, int]
    conditions: tuple[str, ...]
    sample_set: int
    order_seed: int

    @property
    def ledger(self) -> str:
        """The name of the ledger that holds the sweep's spending over all its runs."""
        return f"{self.name}/{self.model}/set{self.sample_set}"

    @property
    def trials(self) -> int:
        """The number of trials."""
        return sum(self.repetitions.values()) * len(self.conditions)

    @property
    def llm_sides(self) -> int:
        """How many of the two drivers are language models."""
        return sum(name in self.entries for name in self.sides.values())

    @property
    def source(self) -> Literal["llm", "driver"]:
        """Whether any language model takes part."""
        return "llm" if self.entries else "driver"

    @property
    def scripted(self) -> bool:
        """Whether the emulator takes part."""
        return any(entry.provider == "emulator" for entry in self.entries.values())

    @property
    def driver(self) -> str:
        """The drivers with their endpoints; see ``pair_name``."""
        return pair_name(self.sides.values(), self.endpoints)

    def specs(self) -> dict[str, str]:
        """Variant to the canonical JSON that its spec hash covers."""
        return {
            variant: canonical_json(
                {
                    "spec_version": SPEC_VERSION,
                    **task_of(self.scenario),
                    "prompt_blocks": block_digests(variant) if self.entries else {},
                    "left": self._driver(self.sides["left"]),
                    "right": self._driver(self.sides["right"]),
                    "sample_set": self.sample_set,
                }
            )
            for variant in self.repetitions
        }

    def trial_specs(self) -> list[TrialSpec]:
        """All trials, repetition by repetition, so that an unfinished sweep is balanced, too.

        Within a repetition the order is random, by the order seed, so that no condition or variant
        always comes first: a service that drifts over hours affects all of them alike.
        """
        hashes = {variant: spec_hash(text) for variant, text in self.specs().items()}
        cells = [
            (repetition, variant, condition)
            for repetition in range(1, max(self.repetitions.values()) + 1)
            for variant, wanted in self.repetitions.items()
            if repetition <= wanted
            for condition in self.conditions
        ]
        cells.sort(key=lambda cell: (cell[0], _lot(self.order_seed, *cell)))
        suffix = f"/set{self.sample_set}" if self.sample_set else ""
        return [
            TrialSpec(
                trial_id=f"{self.model}/{variant}/{condition}/rep{repetition:02d}{suffix}",
                spec_hash=hashes[variant],
                source=self.source,
                model_left=self.sides["left"],
                model_right=self.sides["right"],
                variant=variant,
                condition=condition,
                repetition=repetition,
                sample_set=self.sample_set,
                order=order,
                scripted=self.scripted,
            )
            for order, (repetition, variant, condition) in enumerate(cells)
        ]

    def config(self) -> dict[str, object]:
        """The sweep's configuration for its row in the database."""
        entries = {name: entry.model_dump(mode="json") for name, entry in self.entries.items()}
        prompt_blocks = {variant: block_digests(variant) for variant in self.repetitions}
        return {
            "model": self.model,
            "models": entries,
            "endpoints": self.endpoints,
            "scenario": self.scenario.model_dump(),
            "repetitions": self.repetitions,
            "conditions": list(self.conditions),
            "sample_set": self.sample_set,
            "order_seed": self.order_seed,
            "prompt_blocks": prompt_blocks,
        }

    def _driver(self, name: str) -> dict[str, object]:
        entry = self.entries.get(name)
        if entry is None:
            return PROGRAMS[name].in_spec(name)
        sent = FORMATS[entry.format].request(entry, "")
        return {
            "endpoint": self.endpoints[name],
            "path": sent.path,
            "headers": sent.headers,
            "body": sent.body,
        }


def _lot(*what: object) -> str:
    """A sort key that orders trials randomly, but the same way on every machine."""
    return hashlib.sha256("/".join(map(str, what)).encode()).hexdigest()


def make_plan(
    sweep: str,
    model: str,
    repetitions: int | None = None,
    conditions: Sequence[str] | None = None,
    variants: Sequence[str] | None = None,
    *,
    sample_set: int = 0,
    order_seed: int = 0,
) -> Plan:
    """The plan of a sweep's file and what a user asks for; None keeps the file's value.

    Raises UsageError.
    """
    name, file = load_sweep(sweep)
    models = load_models()
    sides = both_sides(model)
    for driver in sides.values():
        require({**models, **PROGRAMS}, "model", driver, "two joined by + drive left and right")
    for driver in {*sides.values()} - {*models}:
        pace_of(file.scenario, PROGRAMS[driver].in_spec(driver))
    if sample_set < 0:
        raise UsageError("--sample-set is a whole number from 0")
    scenario = SCENARIOS.require(file.scenario.name)
    if file.scenario.collision_rule not in scenario.collision_rules:
        raise UsageError(
            f"the scenario {file.scenario.name} has no collision_rule "
            f"{file.scenario.collision_rule!r}; valid: {', '.join(scenario.collision_rules)}"
        )
    entries = {driver: models[driver] for driver in sides.values() if driver in models}
    return Plan(
        name=name,
        model="+".join(dict.fromkeys(sides.values())),
        sides=sides,
        entries=entries,
        endpoints={driver: endpoint_identity(entry) for driver, entry in entries.items()},
        scenario=file.scenario,
        repetitions=_repetitions(name, file, variants, repetitions),
        conditions=_conditions(file, conditions),
        sample_set=sample_set,
        order_seed=order_seed,
    )


def _conditions(file: SweepFile, chosen: Sequence[str] | None) -> tuple[str, ...]:
    scenario = SCENARIOS[file.scenario.name]
    wanted = next(c for c in (chosen, file.conditions, scenario.conditions) if c is not None)
    conditions = tuple(dict.fromkeys(wanted))
    if not conditions:
        raise UsageError(f"no condition is left; valid: {', '.join(CONDITIONS)}")
    for name in conditions:
        new_world(file.scenario, name)  # raises where the condition cannot be played
    return conditions


def _repetitions(
    name: str, file: SweepFile, variants: Sequence[str] | None, chosen: int | None
) -> dict[str, int]:
    for variant in (*file.repetitions, *(variants or ())):
        blocks_of(variant)
    if chosen is not None and not 1 <= chosen <= MOST_REPETITIONS:
        raise UsageError(f"--reps is a whole number from 1 to {MOST_REPETITIONS}")
    wanted: dict[str, int] = {}
    for variant in file.repetitions if variants is None else variants:
        repetitions = chosen or file.repetitions.get(variant)
        if repetitions is None:
            raise UsageError(
                f"the sweep {name} has no variant {variant}; it has {', '.join(file.repetitions)}. "
                "With --reps N any variant can be run."
            )
        wanted[variant] = repetitions
    if not wanted:
        raise UsageError(f"the sweep {name} has no variant; valid: {', '.join(VARIANTS)}")
    return wanted
