"""The full factorial design of a study: its arms, each with its drivers, its world, its prompt."""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from itertools import product

from pydantic import JsonValue

from merge_runner.config import (
    PERFECT,
    ModelEntry,
    ScenarioConfig,
    both_sides,
    ego_side,
    validated,
)
from merge_runner.drivers.pace import pace_of
from merge_runner.drivers.registry import EMULATOR, PROGRAMS, Program
from merge_runner.errors import UsageError
from merge_runner.llm.models import known_parameters, with_parameter
from merge_runner.prompts.blocks import VARIANTS
from merge_runner.records import SIDES, Side, other_side
from merge_runner.registry import require
from merge_runner.study.file import BASELINE, EVERY_PROMPT, StudyFile

MODEL, PROMPT, OPPONENT, SELF, DEFAULT = "model", "prompt", "opponent", "self", "default"
PERCEPTION, PERFECT_ONE = "perception", "perfect"
_PERCEPTIONS = tuple(f"{PERCEPTION}_{side}" for side in SIDES)
SET_BY = {PERCEPTION: _PERCEPTIONS, **{name: (name,) for name in _PERCEPTIONS}}
"""The factors of perception, with the switches of the scenario that each sets."""
MOST_TRIALS = 1_000_000
FINEST = 1_000_000  # steps a second: decimals like 0.05 become the fractions that they stand for
Levels = Mapping[str, JsonValue]


@dataclass(frozen=True, slots=True)
class Arm:
    """One crossing of a study's levels, which is played in all its conditions.

    ``model`` is what ids of trials say, ``sides`` who drives, by their names in the registry, and
    ``asked`` the same, but by the names in ``entries`` of language models with these parameters.
    ``factors`` are the levels as texts; ``label`` names what sets this arm apart from the others.
    ``ego`` is the side of the driver whose odds are told (see ``config.ego_side``).
    """

    model: str
    sides: dict[Side, str]
    asked: dict[Side, str]
    entries: dict[str, ModelEntry]
    scenario: ScenarioConfig
    variant: str
    repetitions: int
    factors: dict[str, str] = field(default_factory=dict)
    label: str = ""
    ego: Side = "left"

    @property
    def is_mixed(self) -> bool:
        """Whether two different drivers meet."""
        return self.sides["left"] != self.sides["right"]

    @property
    def model_level(self) -> str:
        """The model as results have it, as a factor: of a pair without an opponent, both."""
        ego, other = self.sides[self.ego], self.sides[other_side(self.ego)]
        return ego if self.factors.get(OPPONENT, SELF) != SELF else _pair(ego, other)

    @property
    def names(self) -> tuple[str, str]:
        """Who is asked, the ego first."""
        return self.asked[self.ego], self.asked[other_side(self.ego)]

    def turned(self) -> Arm:
        """The same with the drivers' sides changed."""
        return replace(
            self,
            model=_pair(self.sides["right"], self.sides["left"]),
            sides={side: self.sides[other_side(side)] for side in SIDES},
            asked={side: self.asked[other_side(side)] for side in SIDES},
            label=f"{self.label} mirrored",
            ego=other_side(self.ego),
        )


def cross(
    file: StudyFile,
    models: Sequence[str],
    repetitions: Mapping[str, int],
    registry: Mapping[str, ModelEntry],
    only: Mapping[str, Sequence[str]],
    *,
    conditions: int,
    mirror: bool = False,
) -> list[Arm]:
    """The arms of a study, model by model; raises UsageError for a crossing that cannot be.

    ``repetitions`` are those of each prompt, ``only`` the levels, as texts, that are wanted. With
    ``mirror``, or where the file says so, two different drivers are played both ways round. Each
    arm is played in so many ``conditions``.
    """
    _check_names(file, registry)
    factors = {MODEL: models, **{n: each for n, each in file.factors.items() if n != PROMPT}}
    if PROMPT in file.factors or len(repetitions) > 1:
        factors[PROMPT] = tuple(repetitions)
    axes = {name: _by_text(file, name, levels) for name, levels in factors.items()}
    varying = [name for name, levels in axes.items() if len(levels) > 1]
    mirrored = mirror or file.mirror
    arms: dict[tuple[str, ...], Arm] = {}
    for prompt, chosen in _crossings(file, axes, repetitions, only, conditions):
        arm = _arm(file, chosen, prompt, repetitions[prompt], registry, varying)
        for each in (arm, arm.turned()) if mirrored and arm.is_mixed else (arm,):
            apart = (f"{n}={t}" for n, t in each.factors.items() if n not in (PROMPT, OPPONENT))
            twin = arms.setdefault((each.model, each.variant, *apart), each)
            # One of two mirrored pairs that are each other's mirror image is left out.
            if twin is not each and not (mirrored and arm.is_mixed and each.asked == twin.asked):
                raise UsageError(
                    f"the crossings {twin.label!r} and {each.label!r} are the same trials: leave "
                    "one out, by skip"
                )
    if not arms:
        raise UsageError("nothing is left to play: look at [factors] and skip, and at --only")
    if mirror and not any(arm.is_mixed for arm in arms.values()):
        raise UsageError(
            f"there are no two different drivers to mirror: name them, as --model {models[0]}+OTHER"
        )
    return list(arms.values())


def listed_levels(
    file: StudyFile, models: Iterable[str], prompts: Iterable[str] = ()
) -> dict[str, list[str]]:
    """The levels of each factor as texts, in the order of the file, but its reference first.

    The ``models`` are those that are played, and so are the ``prompts`` beside the file's.
    """
    axes = {MODEL: [*models], **file.factors, PROMPT: [*file_prompts(file), *prompts]}
    return {name: [*_by_text(file, name, levels)] for name, levels in axes.items()}


def file_prompts(file: StudyFile) -> list[str]:
    """The prompts that a file plays by itself."""
    levels = [level_text(level) for level in file.factors.get(PROMPT, ())]
    named = [name for name in file.repetitions if name != EVERY_PROMPT]
    return levels or named or [BASELINE] * (EVERY_PROMPT in file.repetitions)


def chosen_models(file: StudyFile, models: Sequence[str]) -> tuple[str, ...]:
    """Return who drives: the ``models`` asked for, else the study's own, else the emulator."""
    return tuple(dict.fromkeys(models or file.models or (EMULATOR,)))


def level_text(level: JsonValue) -> str:
    """How a level is written in results: a string as it is, anything else as JSON."""
    return level if isinstance(level, str) else json.dumps(level, separators=(",", ":"))


def _by_text(file: StudyFile, factor: str, levels: Iterable[JsonValue]) -> dict[str, JsonValue]:
    """The levels of a factor by their texts, its reference first."""
    reference = level_text(file.reference.get(factor))
    by_text = {level_text(level): level for level in levels}
    return dict(sorted(by_text.items(), key=lambda item: item[0] != reference))


def _crossings(
    file: StudyFile,
    axes: Mapping[str, Levels],
    repetitions: Mapping[str, int],
    only: Mapping[str, Collection[str]],
    conditions: int,
) -> Iterator[tuple[str, Levels]]:
    """Each crossing that is to be played: its prompt and its levels; raises UsageError."""
    skip = [
        {n: {*map(level_text, w if isinstance(w, list) else [w])} for n, w in row.items()}
        for row in file.skip
    ]
    reference = {name: {level_text(level)} for name, level in file.reference.items()}
    # What is left out may be a model or a prompt that is not asked for today.
    models = dict.fromkeys((*axes[MODEL], *file.models))
    known: dict[str, Mapping[str, object]] = {**axes, PROMPT: VARIANTS, MODEL: models}
    for there, named in ((axes, only), *((known, row) for row in (*skip, reference))):
        for name, texts in named.items():
            levels = require(there, "factor", name)
            for text in texts:
                require(levels, f"level of {name}", text)
    wanted = {
        name: [text for text in levels if text in only.get(name, levels)]
        for name, levels in axes.items()
    }
    wanted.setdefault(PROMPT, list(repetitions))
    asked = sum(repetitions[prompt] for prompt in wanted[PROMPT])
    trials = conditions * asked * math.prod(len(wanted[name]) for name in axes if name != PROMPT)
    if trials > MOST_TRIALS:
        raise UsageError(
            f"these are {trials:,} trials, and at most {MOST_TRIALS:,} can be played: leave out "
            "levels, conditions or repetitions, in the file or by --only, --conditions or --reps"
        )
    for chosen in product(*wanted.values()):
        texts = dict(zip(wanted, chosen, strict=True))
        if not any(all(texts[name] in levels for name, levels in row.items()) for row in skip):
            yield texts[PROMPT], {name: axes[name][texts[name]] for name in axes}


def _arm(
    file: StudyFile,
    levels: Levels,
    prompt: str,
    repetitions: int,
    registry: Mapping[str, ModelEntry],
    varying: Sequence[str],
) -> Arm:
    model, opponent = str(levels[MODEL]), str(levels.get(OPPONENT, SELF))
    if opponent != SELF and "+" in model:
        raise UsageError(f"{model} is a pair already, and has no other opponent than {SELF}")
    changed = {*both_sides(model).values()}
    sides = both_sides(model if opponent == SELF else f"{model}+{opponent}")
    for name in sides.values():
        require({**registry, **PROGRAMS}, "model", name, "two joined by + drive left and right")
    programs = {name: PROGRAMS[name] for name in sides.values() if name not in registry}
    others = {MODEL, PROMPT, OPPONENT, PERCEPTION, *ScenarioConfig.model_fields}
    parameters = {n: x for n, x in levels.items() if n not in others and x != DEFAULT}
    if parameters and not changed & {*registry}:
        raise UsageError(f"{model} is a program and takes no {min(parameters)}, only {DEFAULT!r}")
    asked, entries = dict(sides), {}
    for side, name in sides.items():
        if name in registry:
            label, entry = name, registry[name]
            for parameter, level in parameters.items() if name in changed else ():
                before, entry = entry, with_parameter(name, entry, parameter, level)
                label += "" if entry == before else f" {parameter}={level_text(level)}"
            asked[side], entries[label] = label, entry
    texts = {name: level_text(level) for name, level in levels.items()}
    labels = (texts[n] if n in (MODEL, PROMPT) else f"{n}={texts[n]}" for n in varying)
    return Arm(
        model=_pair(*sides.values()),
        sides=sides,
        asked=asked,
        entries=entries,
        scenario=_scenario(file, levels, programs),
        variant=prompt,
        repetitions=repetitions,
        factors={name: text for name, text in texts.items() if name in file.factors},
        label=" ".join(labels) or prompt,
        ego=ego_side(sides, registry, opponent),
    )


def _pair(left: str, right: str) -> str:
    """Who drives, as ids of trials say."""
    return left if left == right else f"{left}+{right}"


def _scenario(file: StudyFile, levels: Levels, programs: Mapping[str, Program]) -> ScenarioConfig:
    """The scenario with the switches of these levels, for these programs; raises UsageError."""
    fields = ScenarioConfig.model_fields.keys() - SET_BY.keys()
    given = file.scenario.model_dump(exclude_unset=True)
    given |= {name: level for name, level in levels.items() if name in fields}
    given |= _world_step(validated(ScenarioConfig, given, "factors"), programs)
    known = {PERFECT_ONE: PERFECT, **file.perception}
    hint = f"define another one as [{PERCEPTION}.NAME]"
    for factor in SET_BY.keys() & levels.keys():
        level = level_text(levels[factor])
        perception = require(known, f"level of the factor {factor}:", level, hint)
        given |= dict.fromkeys(SET_BY[factor], perception.model_dump())
    scenario = validated(ScenarioConfig, given, "factors")
    for name, program in programs.items():
        pace_of(scenario, program.in_spec(name))
    return scenario


def _world_step(scenario: ScenarioConfig, programs: Mapping[str, Program]) -> dict[str, float]:
    """The largest step of which every program's interval is a whole number; empty for the usual.

    A language model's plan keeps its actions, of which each then lasts several steps. A ``step_s``
    that a study gives stays: what does not fit it is refused (``drivers.pace``).
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


def _check_names(file: StudyFile, registry: Mapping[str, ModelEntry]) -> None:
    """Raise UsageError for a factor that there is not, and for a name that is taken."""
    parameters = sorted(known_parameters(registry.values()))
    valid = dict.fromkeys((PROMPT, OPPONENT, PERCEPTION, *parameters, *ScenarioConfig.model_fields))
    for name in (*file.factors, *file.effect):
        require(valid, "factor", name, "models and skip stand above [factors]")
    taken = [f"drivers.{name}" for name in file.drivers if name in registry]
    taken += [f"{PERCEPTION}.{name}" for name in file.perception if name == PERFECT_ONE]
    if taken:
        raise UsageError(f"[{taken[0]}] needs another name: there is one of this name already")
    if PERCEPTION in file.factors and {*_PERCEPTIONS} & file.factors.keys():
        raise UsageError(
            f"the factor {PERCEPTION} is of both sides: name it, or {' and '.join(_PERCEPTIONS)}"
        )
