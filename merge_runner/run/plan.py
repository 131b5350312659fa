"""What a sweep consists of: its trials in order, their readable ids, and what their hash covers."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from merge_runner.config import (
    MOST_REPETITIONS,
    ModelEntry,
    ScenarioConfig,
    SweepFile,
    both_sides,
    load_sweep,
    pair_name,
)
from merge_runner.drivers.pace import pace_of
from merge_runner.drivers.registry import PROGRAMS
from merge_runner.errors import UsageError
from merge_runner.llm.content_hashes import SPEC_VERSION, canonical_json, spec_hash
from merge_runner.llm.formats import FORMATS
from merge_runner.llm.models import load_models
from merge_runner.prompts.blocks import VARIANTS, block_digests, blocks_of
from merge_runner.records import Side, TrialSpec
from merge_runner.scenarios.base import World
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner.scenarios.registry import SCENARIOS, task_of

# It stands in ids, lists and names of files.
# A trial takes about 10 s at 10 m/s over the last 100 m: 10 or 11 prompts a driver.
PROMPTS_PER_DRIVER = 10.5


@dataclass(frozen=True, slots=True)
class Choice:
    """What a user asks for on top of the sweep's file; None keeps the file's value."""

    sweep: str
    model: str
    repetitions: int | None = None
    conditions: Sequence[str] | None = None
    variants: Sequence[str] | None = None
    sample_set: int = 0
    order_seed: int = 0


@dataclass(frozen=True, slots=True)
class Limits:
    """What bounds the calls; ``rpm`` and ``tpm`` replace those of the registry."""

    rpm: int | None = None
    tpm: int | None = None
    max_cost_usd: float | None = None
    connections: int = 400


@dataclass(frozen=True, slots=True)
class Plan:
    """A sweep before it runs. ``entries`` are the language models on either side."""

    name: str
    model: str
    sides: dict[Side, str]
    entries: dict[str, ModelEntry]
    scenario: ScenarioConfig
    repetitions: dict[str, int]
    conditions: tuple[str, ...]
    sample_set: int
    order_seed: int

    @property
    def ledger(self) -> str:
        """Under what name the sweep's spending is kept, over all its runs."""
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

    def world(self, condition: str) -> World:
        """The world of a new trial."""
        return SCENARIOS[self.scenario.name].world(self.scenario, CONDITIONS[condition])

    def driver(self, endpoints: Mapping[str, str]) -> str:
        """The drivers with their endpoints; see ``pair_name``."""
        return pair_name(self.sides.values(), endpoints)

    def specs(self, endpoints: Mapping[str, str]) -> dict[str, str]:
        """Variant to the canonical JSON that its spec hash covers."""
        return {
            variant: canonical_json(
                {
                    "spec_version": SPEC_VERSION,
                    **task_of(self.scenario),
                    "prompt_blocks": block_digests(variant) if self.entries else {},
                    "left": self._driver(self.sides["left"], endpoints),
                    "right": self._driver(self.sides["right"], endpoints),
                    "sample_set": self.sample_set,
                }
            )
            for variant in self.repetitions
        }

    def trial_specs(self, endpoints: Mapping[str, str]) -> list[TrialSpec]:
        """All trials, repetition by repetition, so that what is finished is balanced.

        Within a repetition the order is random, by the order seed, so that no condition or variant
        is always asked first: a service that drifts over hours does so for all alike.
        """
        hashes = {variant: spec_hash(text) for variant, text in self.specs(endpoints).items()}
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

    def config(self, endpoints: Mapping[str, str]) -> dict[str, object]:
        """The sweep's configuration for its row in the database."""
        entries = {name: entry.model_dump(mode="json") for name, entry in self.entries.items()}
        prompt_blocks = {variant: block_digests(variant) for variant in self.repetitions}
        return {
            "model": self.model,
            "models": entries,
            "endpoints": dict(endpoints),
            "scenario": self.scenario.model_dump(),
            "repetitions": dict(self.repetitions),
            "conditions": list(self.conditions),
            "sample_set": self.sample_set,
            "order_seed": self.order_seed,
            "prompt_blocks": prompt_blocks,
        }

    def _driver(self, name: str, endpoints: Mapping[str, str]) -> dict[str, object]:
        entry = self.entries.get(name)
        if entry is None:
            return PROGRAMS[name].told(name)
        sent = FORMATS[entry.format].request(entry, "")
        return {
            "endpoint": endpoints[name],
            "path": sent.path,
            "headers": sent.headers,
            "body": sent.body,
        }


def _lot(*what: object) -> str:
    """A random place in a row that is the same on every machine."""
    return hashlib.sha256("/".join(map(str, what)).encode()).hexdigest()


def make_plan(choice: Choice) -> Plan:
    """Resolve a choice against the sweep's file and the registry; raises UsageError."""
    name, file = load_sweep(choice.sweep)
    models = load_models()
    sides = both_sides(choice.model)
    valid = (*models, *PROGRAMS)
    for driver in sides.values():
        _require(driver, valid, "model", "two joined by + drive left and right")
    for driver in {*sides.values()} - {*models}:
        pace_of(file.scenario, PROGRAMS[driver].told(driver))
    if choice.sample_set < 0:
        raise UsageError("--sample-set is a whole number from 0")
    scenario = SCENARIOS.require(file.scenario.name)
    if file.scenario.collision_rule not in scenario.collision_rules:
        raise UsageError(
            f"the scenario {file.scenario.name} has no collision_rule "
            f"{file.scenario.collision_rule!r}; valid: {', '.join(scenario.collision_rules)}"
        )
    return Plan(
        name=name,
        model="+".join(dict.fromkeys(sides.values())),
        sides=sides,
        entries={driver: models[driver] for driver in sides.values() if driver in models},
        scenario=file.scenario,
        repetitions=_repetitions(name, file, choice),
        conditions=_conditions(file, choice),
        sample_set=choice.sample_set,
        order_seed=choice.order_seed,
    )


def _conditions(file: SweepFile, choice: Choice) -> tuple[str, ...]:
    scenario = SCENARIOS[file.scenario.name]
    wanted = choice.conditions if choice.conditions is not None else file.conditions
    conditions = tuple(dict.fromkeys(scenario.conditions if wanted is None else wanted))
    if not conditions:
        raise UsageError(f"no condition is left; valid: {', '.join(CONDITIONS)}")
    for name in conditions:
        condition = CONDITIONS.require(name)
        scenario.world(file.scenario, condition)  # raises where it cannot be played
    return conditions


def _repetitions(name: str, file: SweepFile, choice: Choice) -> dict[str, int]:
    for variant in (*file.repetitions, *(choice.variants or ())):
        blocks_of(variant)
    if choice.repetitions is not None and not 1 <= choice.repetitions <= MOST_REPETITIONS:
        raise UsageError(f"--reps is a whole number from 1 to {MOST_REPETITIONS}")
    wanted: dict[str, int] = {}
    for variant in file.repetitions if choice.variants is None else choice.variants:
        repetitions = choice.repetitions or file.repetitions.get(variant)
        if repetitions is None:
            raise UsageError(
                f"the sweep {name} has no variant {variant}; it has {', '.join(file.repetitions)}. "
                "With --reps N any variant can be run."
            )
        wanted[variant] = repetitions
    if not wanted:
        raise UsageError(f"the sweep {name} has no variant; valid: {', '.join(VARIANTS)}")
    return wanted


def _require(name: str, valid: Sequence[str], what: str, hint: str = "") -> None:
    if name not in valid:
        listed = ", ".join(valid) + (f" ({hint})" if hint else "")
        raise UsageError(f"unknown {what} {name!r}; valid: {listed}")
