"""Arms of a study: one combination of levels each, with its drivers, scenario and prompts."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction

from pydantic import JsonValue

from merge_runner.config import PERFECT, ScenarioConfig, validated
from merge_runner.driver_names import both_sides, ego_side
from merge_runner.drivers.pace import pace_of
from merge_runner.drivers.registry import EMULATOR, PROGRAMS, Program
from merge_runner.errors import UsageError
from merge_runner.llm.models import with_parameter
from merge_runner.prompts.blocks import composed
from merge_runner.providers import ModelEntry
from merge_runner.records import SIDES, Side, other_side
from merge_runner.registry import require
from merge_runner.study.file import GivenTo, StudyFile, StudyText

MODEL, PROMPT, OPPONENT, SELF, DEFAULT = "model", "prompt", "opponent", "self", "default"
FOCAL = "focal"
PERCEPTION, PERFECT_ONE = "perception", "perfect"
FINEST = 1_000_000  # steps a second: decimals such as 0.05 become exact fractions
Levels = Mapping[str, JsonValue]


@dataclass(frozen=True, slots=True)
class Arm:
    """Arm of a study: one combination of levels, played in all conditions.

    ``model`` is a part of trial ids. ``sides`` are the drivers by their names in the registry;
    ``full_names`` are their names with parameters, the keys of ``entries``. ``names`` has the same,
    the ego's first, without the effects that text factors plant in the emulator.
    ``factors`` are the levels as texts; ``label`` has the levels in which the arms differ. ``ego``
    is the side of the focal driver (``ego_side``). ``focal`` is the same if the two drivers have
    different texts, parameters or perceptions, else None. ``prompts`` are by side if not both have
    the ``variant``.
    """

    model: str
    sides: dict[Side, str]
    full_names: dict[Side, str]
    names: tuple[str, str]
    entries: dict[str, ModelEntry]
    scenario: ScenarioConfig
    variant: str
    repetitions: int
    factors: dict[str, str] = field(default_factory=dict)
    label: str = ""
    ego: Side = "left"
    focal: Side | None = None
    prompts: dict[Side, str] = field(default_factory=dict)

    def prompt(self, side: Side) -> str:
        """Return the prompt variant of a side."""
        return self.prompts.get(side, self.variant)

    @property
    def read_prompts(self) -> dict[Side, str]:
        """The prompt variants that language models read, by side."""
        return {s: self.prompt(s) for s in SIDES if self.full_names[s] in self.entries}

    @property
    def is_mixed(self) -> bool:
        """True if the two drivers differ."""
        return self.sides["left"] != self.sides["right"]

    @property
    def is_scripted(self) -> bool:
        """True if the emulator takes part."""
        return any(entry.provider == EMULATOR for entry in self.entries.values())

    @property
    def model_level(self) -> str:
        """Level of the factor ``model`` in results: both models for a pair without an opponent."""
        ego, other = self.sides[self.ego], self.sides[other_side(self.ego)]
        alone = not self.is_mixed or self.factors.get(OPPONENT, SELF) != SELF
        return ego if alone else f"{ego}+{other}"


def level_text(level: JsonValue) -> str:
    """Return a level as in results: a string unchanged, any other value as JSON."""
    return level if isinstance(level, str) else json.dumps(level, separators=(",", ":"))


@dataclass
class ArmDrivers:
    """Drivers of an arm by side: names in the registry, names with parameters, and model entries.

    ``one_sided`` is true if they have different texts, parameters or perceptions.
    """

    sides: dict[Side, str]
    ego: Side
    full_names: dict[Side, str]
    entries: dict[Side, ModelEntry]
    one_sided: bool = False

    @classmethod
    def of(
        cls, texts: Mapping[str, str], registry: Mapping[str, ModelEntry], *, mirrored: bool
    ) -> ArmDrivers:
        """Return the drivers of these levels, without parameters; raises UsageError."""
        model, opponent = texts[MODEL], texts.get(OPPONENT, SELF)
        if opponent != SELF and "+" in model:
            raise UsageError(f"{model} is a pair already, and has no other opponent than {SELF}")
        sides = both_sides(model if opponent == SELF else f"{model}+{opponent}")
        for name in sides.values():
            require({**registry, **PROGRAMS}, "model", name, "two joined by + drive left and right")
        ego = ego_side(sides, registry, opponent)
        if mirrored:
            sides, ego = {side: sides[other_side(side)] for side in SIDES}, other_side(ego)
        entries = {side: registry[name] for side, name in sides.items() if name in registry}
        return cls(sides, ego, dict(sides), entries)

    def receivers(self, given_to: GivenTo) -> list[Side]:
        """Return the sides that ``given_to`` names."""
        return {"both": [*SIDES], "ego": [self.ego], "other": [other_side(self.ego)]}[given_to]

    def set_parameters(self, file: StudyFile, levels: Levels, texts: Mapping[str, str]) -> None:
        """Give the models the parameters of these levels; raises UsageError."""
        others = {MODEL, PROMPT, OPPONENT, PERCEPTION, *ScenarioConfig.model_fields, *file.texts}
        changed = {*both_sides(texts[MODEL]).values()}
        for parameter in (n for n, x in levels.items() if n not in others and x != DEFAULT):
            given_to = file.given_to.get(parameter, "both")
            receivers = self.receivers(given_to)
            if given_to == "both":  # an opponent keeps its own parameters
                receivers = [side for side in receivers if self.sides[side] in changed]
            if not self.entries.keys() & {*receivers}:
                name = texts[MODEL] if given_to == "both" else self.sides[receivers[0]]
                raise UsageError(f"{name} is a program and takes no {parameter}, only {DEFAULT!r}")
            for side in [side for side in receivers if side in self.entries]:
                is_set = self._set(side, parameter, levels[parameter], texts[parameter])
                self.one_sided |= is_set and given_to != "both"

    def words(self, file: StudyFile, texts: Mapping[str, str]) -> dict[str, StudyText]:
        """Return the text levels by factor; raises UsageError where no model would read one."""
        words = {n: file.texts[n][t] for n, t in texts.items() if t in file.texts.get(n, ())}
        for name, word in words.items():
            receivers = self.receivers(word.given_to)
            if not self.entries.keys() & {*receivers}:
                raise UsageError(
                    f"{self.sides[receivers[0]]} is a program and reads no words: leave "
                    f"{name}={texts[name]} out there, by skip"
                )
            self.one_sided |= word.given_to != "both"
        return words

    def plant(self, words: Iterable[StudyText]) -> None:
        """Plant the effects of text levels in the emulator, on both sides.

        Both sides act on one plan: an effect that makes one driver go first makes the other yield.
        """
        scripted = [s for s, entry in self.entries.items() if entry.provider == EMULATOR]
        own_first = {side: _number(self.entries[side], "x_own_first") for side in scripted}
        gap_m = 0.0
        for word in words:
            gap_m += word.emulator.gap_m
            for side in own_first.keys() & {*self.receivers(word.given_to)}:
                own_first[side] += word.emulator.own_first
        for side in scripted:
            planted = {
                "x_own_first": own_first[side],
                "x_other_first": own_first.get(other_side(side), 0.0),
                "x_gap_m": gap_m + _number(self.entries[side], "x_gap_m"),
            }
            for parameter, number in planted.items():
                if number != _number(self.entries[side], parameter):
                    self._set(side, parameter, number, f"{number:g}")

    def _set(self, side: Side, parameter: str, value: JsonValue, text: str) -> bool:
        """Set a parameter of a side's model; return whether that changes the model."""
        before = self.entries[side]
        self.entries[side] = with_parameter(self.sides[side], before, parameter, value)
        if self.entries[side] == before:
            return False
        self.full_names[side] += f" {parameter}={text}"
        return True


def make_arm(
    file: StudyFile,
    levels: Levels,
    repetitions: int,
    registry: Mapping[str, ModelEntry],
    varying: Sequence[str],
    *,
    mirrored: bool = False,
) -> Arm:
    """Return the arm of these levels; with ``mirrored`` the drivers swap sides.

    Its label has the levels of the ``varying`` factors. Raises UsageError.
    """
    texts = {name: level_text(level) for name, level in levels.items()}
    drivers = ArmDrivers.of(texts, registry, mirrored=mirrored)
    drivers.set_parameters(file, levels, texts)
    words, ego = drivers.words(file, texts), drivers.ego
    names = drivers.full_names[ego], drivers.full_names[other_side(ego)]
    drivers.plant(words.values())

    def prompt(names: Iterable[str]) -> str:
        return composed(texts[PROMPT], [f"{name}={texts[name]}" for name in names])

    variant = prompt(words)
    prompts = {
        side: prompt(n for n, word in words.items() if side in drivers.receivers(word.given_to))
        for side in SIDES
    }
    scenario = _scenario(file, levels, drivers)
    if file.given_to.get(PERCEPTION, "both") != "both":
        drivers.one_sided |= scenario.perception_left != scenario.perception_right
    parts = (texts[n] if n in (MODEL, PROMPT) else f"{n}={texts[n]}" for n in varying)
    label = " ".join(parts) or texts[PROMPT]
    return Arm(
        model="+".join(dict.fromkeys(drivers.sides.values())),
        sides=drivers.sides,
        full_names=drivers.full_names,
        names=names,
        entries={drivers.full_names[side]: entry for side, entry in drivers.entries.items()},
        scenario=scenario,
        variant=variant,
        repetitions=repetitions,
        factors={
            n: t for n, t in texts.items() if n in file.factors or (n == PROMPT and file.texts)
        },
        label=f"{label} mirrored" if mirrored else label,
        ego=ego,
        focal=ego if drivers.one_sided else None,
        prompts={} if {*prompts.values()} == {variant} else prompts,
    )


def _number(entry: ModelEntry, parameter: str) -> float:
    """Return a parameter of the emulator, by default 0."""
    number = entry.parameters.get(parameter)
    return number if isinstance(number, int | float) else 0.0


def _scenario(file: StudyFile, levels: Levels, drivers: ArmDrivers) -> ScenarioConfig:
    programs = {n: PROGRAMS[n] for s, n in drivers.sides.items() if s not in drivers.entries}
    sides = [f"{PERCEPTION}_{side}" for side in SIDES]
    fields = ScenarioConfig.model_fields.keys() - {*sides}
    values = file.scenario.model_dump(exclude_unset=True)
    values |= {name: level for name, level in levels.items() if name in fields}
    values |= _world_step(validated(ScenarioConfig, values, "factors"), programs)
    known = {PERFECT_ONE: PERFECT, **file.perception}
    hint = f"define another one as [{PERCEPTION}.NAME]"
    receivers = drivers.receivers(file.given_to.get(PERCEPTION, "both"))
    affected = [f"{PERCEPTION}_{side}" for side in receivers]
    for factor in [name for name in (PERCEPTION, *sides) if name in levels]:
        level = level_text(levels[factor])
        perception = require(known, f"level of the factor {factor}:", level, hint).model_dump()
        values |= dict.fromkeys(affected if factor == PERCEPTION else [factor], perception)
    scenario = validated(ScenarioConfig, values, "factors")
    for name, program in programs.items():
        pace_of(scenario, program.in_spec(name))
    return scenario


def _world_step(scenario: ScenarioConfig, programs: Mapping[str, Program]) -> dict[str, float]:
    """Return the largest step that divides every program's interval; empty for the usual step.

    The actions of a language model's plan do not change: each then takes several steps. An explicit
    ``step_s`` of a study is kept; ``drivers.pace`` refuses intervals that it does not divide.
    """
    if "step_s" in scenario.model_fields_set:
        return {}
    rates_hz = [program.rate_hz for program in programs.values() if program.rate_hz is not None]
    times_s = [scenario.step_s, scenario.action_s, *(1 / rate_hz for rate_hz in rates_hz)]
    exact = [Fraction(time_s).limit_denominator(FINEST) for time_s in times_s]
    whole = math.lcm(*(time.denominator for time in exact))
    step_s = math.gcd(*(int(time * whole) for time in exact)) / whole
    usual = step_s == scenario.step_s
    return {} if usual else {"step_s": step_s, "plan_step_s": scenario.action_s}
