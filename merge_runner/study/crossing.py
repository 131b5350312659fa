"""The full factorial design of a study: its arms, each with its drivers, its world, its prompt."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
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
        alone = not self.is_mixed or self.factors.get(OPPONENT, SELF) != SELF
        return ego if alone else f"{ego}+{other}"

    @property
    def names(self) -> tuple[str, str]:
        """Who is asked, the ego first."""
        return self.asked[self.ego], self.asked[other_side(self.ego)]

    def turned(self) -> Arm:
        """The same with the drivers' sides changed."""
        return replace(
            self,
            model="+".join([self.sides["right"], self.sides["left"]]),
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
    others = {name: levels for name, levels in file.factors.items() if name != PROMPT}
    factors = {MODEL: models, **others, PROMPT: tuple(repetitions)}
    axes = {name: _by_text(file, name, levels) for name, levels in factors.items()}
    skip = _skipped(file, axes, only)
    wanted = {
        name: [text for text in levels if text in only.get(name, levels)]
        for name, levels in axes.items()
    }
    asked = sum(repetitions[prompt] for prompt in wanted[PROMPT])
    trials = conditions * asked * math.prod(len(wanted[name]) for name in axes if name != PROMPT)
    if trials > MOST_TRIALS:
        raise UsageError(
            f"these are {trials:,} trials, and at most {MOST_TRIALS:,} can be played: leave out "
            "levels, conditions or repetitions, in the file or by --only, --conditions or --reps"
        )
    varying = [name for name, levels in axes.items() if len(levels) > 1]
    arms: dict[tuple[str, ...], Arm] = {}
    for chosen in product(*wanted.values()):
        texts = dict(zip(wanted, chosen, strict=True))
        if any(all(texts[name] in levels for name, levels in row.items()) for row in skip):
            continue
        levels = {name: axes[name][text] for name, text in texts.items()}
        arm = _arm(file, levels, texts, repetitions[texts[PROMPT]], registry, varying)
        turned = (mirror or file.mirror) and arm.is_mixed
        for each in (arm, arm.turned()) if turned else (arm,):
            apart = (f"{n}={t}" for n, t in each.factors.items() if n not in (PROMPT, OPPONENT))
            # What comes to the same trials, as a pair that is named both ways, is played once.
            twin = arms.setdefault((each.model, each.variant, *apart), each)
            if twin.asked != each.asked:
                raise UsageError(
                    f"the crossings {twin.label!r} and {each.label!r} have the same names, and are "
                    "asked otherwise: leave one out, by skip"
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


def _check_names(file: StudyFile, registry: Mapping[str, ModelEntry]) -> None:
    """Raise UsageError for a factor that there is not, and for a driver's name that is taken."""
    parameters = sorted(known_parameters(registry.values()))
    valid = dict.fromkeys((PROMPT, OPPONENT, PERCEPTION, *parameters, *ScenarioConfig.model_fields))
    for name in (*file.factors, *file.effect):
        require(valid, "factor", name, "models and skip stand above [factors]")
    for name in file.drivers.keys() & registry.keys():
        raise UsageError(f"[drivers.{name}] needs another name: there is one of this name already")


def _skipped(
    file: StudyFile, axes: Mapping[str, Levels], only: Mapping[str, Sequence[str]]
) -> list[dict[str, set[str]]]:
    """The levels of each row of skip; raises UsageError for a level that there is not.

    So it does for those of ``only`` and of the file's ``reference``.
    """
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
    return skip


def _arm(
    file: StudyFile,
    levels: Levels,
    texts: Mapping[str, str],
    repetitions: int,
    registry: Mapping[str, ModelEntry],
    varying: Sequence[str],
) -> Arm:
    """The arm of these levels, which results name by these ``texts``; raises UsageError."""
    model, opponent = texts[MODEL], texts.get(OPPONENT, SELF)
    if opponent != SELF and "+" in model:
        raise UsageError(f"{model} is a pair already, and has no other opponent than {SELF}")
    changed = {*both_sides(model).values()}
    sides = both_sides(model if opponent == SELF else f"{model}+{opponent}")
    for name in sides.values():
        require({**registry, **PROGRAMS}, "model", name, "two joined by + drive left and right")
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
                label += "" if entry == before else f" {parameter}={texts[parameter]}"
            asked[side], entries[label] = label, entry
    labels = (texts[n] if n in (MODEL, PROMPT) else f"{n}={texts[n]}" for n in varying)
    programs = {name: PROGRAMS[name] for name in sides.values() if name not in registry}
    return Arm(
        model="+".join(dict.fromkeys(sides.values())),
        sides=sides,
        asked=asked,
        entries=entries,
        scenario=_scenario(file, levels, programs),
        variant=texts[PROMPT],
        repetitions=repetitions,
        factors={name: text for name, text in texts.items() if name in file.factors},
        label=" ".join(labels) or texts[PROMPT],
        ego=ego_side(sides, registry, opponent),
    )


def _scenario(file: StudyFile, levels: Levels, programs: Mapping[str, Program]) -> ScenarioConfig:
    """The scenario with the switches of these levels, for these programs; raises UsageError."""
    sides = [f"{PERCEPTION}_{side}" for side in SIDES]
    fields = ScenarioConfig.model_fields.keys() - {*sides}
    given = file.scenario.model_dump(exclude_unset=True)
    given |= {name: level for name, level in levels.items() if name in fields}
    given |= _world_step(validated(ScenarioConfig, given, "factors"), programs)
    known = {PERFECT_ONE: PERFECT, **file.perception}
    hint = f"define another one as [{PERCEPTION}.NAME]"
    for factor in [name for name in (PERCEPTION, *sides) if name in levels]:
        level = level_text(levels[factor])
        perception = require(known, f"level of the factor {factor}:", level, hint).model_dump()
        given |= dict.fromkeys(sides if factor == PERCEPTION else [factor], perception)
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
