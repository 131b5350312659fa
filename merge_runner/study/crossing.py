"""What the factors of a study cross to: its arms, each with its drivers, its world, its prompt."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from itertools import product

from pydantic import JsonValue

from merge_runner.config import PERFECT, ModelEntry, ScenarioConfig, both_sides, ego_side, validated
from merge_runner.drivers.pace import pace_of
from merge_runner.drivers.registry import EMULATOR, PROGRAMS, Program
from merge_runner.errors import UsageError, unknown_name
from merge_runner.llm.formats.parameters import known_parameters, with_parameter
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
    factors = {name: levels for name, levels in file.factors.items() if name != PROMPT}
    if PROMPT in file.factors or len(repetitions) > 1:
        factors[PROMPT] = tuple(repetitions)
    _check_names(file, registry)
    axes = {MODEL: _by_text(file, MODEL, models)}
    axes |= {name: _by_text(file, name, levels) for name, levels in factors.items()}
    _check_levels(axes, only)
    # What is left out may be a model or a prompt that is not asked for today.
    known = {**axes, PROMPT: VARIANTS, MODEL: {*axes[MODEL], *file.models}}
    skip = [{name: _texts(wanted) for name, wanted in row.items()} for row in file.skip]
    for row in skip:
        _check_levels(known, row)
    _check_levels(known, {name: [level_text(level)] for name, level in file.reference.items()})
    varying = [name for name, levels in axes.items() if len(levels) > 1]
    for name, texts in only.items():
        axes[name] = {text: level for text, level in axes[name].items() if text in texts}
    _check_size(axes, skip, repetitions, conditions)
    arms = []
    for prompt, levels in _crossings(axes, skip, repetitions):
        try:
            arm = _arm(file, levels, prompt, repetitions, registry, varying)
        except UsageError as exc:
            if not file.factors:
                raise
            here = ", ".join(f"{name} = {json.dumps(level)}" for name, level in levels.items())
            raise UsageError(
                f"{exc}; to leave such crossings out, write above [factors]: skip = [{{ {here} }}]"
            ) from exc
        both_ways = arm.is_mixed and (mirror or file.mirror)
        arms += [arm, arm.turned()] if both_ways else [arm]
    if not arms:
        raise UsageError("nothing is left to play: look at skip, and at --only")
    if mirror and not any(arm.is_mixed for arm in arms):
        raise UsageError(
            f"there are no two different drivers to mirror: name them, as --model {models[0]}+OTHER"
        )
    return list(_once(arms, mirrored=mirror or file.mirror))


def listed_levels(
    file: StudyFile, models: Iterable[str], prompts: Iterable[str] = ()
) -> dict[str, list[str]]:
    """The levels of each factor as texts, in the order of the file, but its reference first.

    The ``models`` are those that are played, and so are the ``prompts`` beside the file's.
    """
    axes = {MODEL: [*models], **file.factors, PROMPT: [*file_prompts(file), *prompts]}
    return {
        name: _reference_first(file, name, dict.fromkeys(map(level_text, levels)))
        for name, levels in axes.items()
    }


def file_prompts(file: StudyFile) -> list[str]:
    """The prompts that a file plays by itself."""
    levels = [level_text(level) for level in file.factors.get(PROMPT, ())]
    named = [name for name in file.repetitions if name != EVERY_PROMPT]
    return levels or named or [BASELINE] * (EVERY_PROMPT in file.repetitions)


def _reference_first(file: StudyFile, factor: str, texts: Iterable[str]) -> list[str]:
    if factor not in file.reference:
        return list(texts)
    reference = level_text(file.reference[factor])
    return sorted(texts, key=lambda text: text != reference)


def _by_text(file: StudyFile, factor: str, levels: Iterable[JsonValue]) -> dict[str, JsonValue]:
    """The levels of a factor by their texts; raises UsageError for none, or one twice."""
    by_text: dict[str, JsonValue] = {}
    numbers: dict[str, str] = {}
    for level in levels:
        number = int(level) if isinstance(level, float) and level.is_integer() else level
        text = level_text(level)
        twin = numbers.setdefault(level_text(number), text)
        if twin != text or text in by_text:
            raise UsageError(
                f"the factor {factor} needs each of its levels once: {twin} and {text} are the same"
            )
        by_text[text] = level
    if not by_text:
        raise UsageError(f"the factor {factor} needs levels")
    return {text: by_text[text] for text in _reference_first(file, factor, by_text)}


def _texts(wanted: JsonValue) -> set[str]:
    """The levels that a row of ``skip`` names."""
    return set(map(level_text, wanted if isinstance(wanted, list) else [wanted]))


def _check_levels(
    axes: Mapping[str, Collection[str]], named: Mapping[str, Collection[str]]
) -> None:
    """Raise UsageError for a factor, or a level of it, that there is not."""
    for name, texts in named.items():
        levels = require(axes, "factor", name)
        for text in texts:
            require(dict.fromkeys(levels), f"level of {name}", text)


def _crossings(
    axes: Mapping[str, Mapping[str, JsonValue]],
    skip: Sequence[Mapping[str, Collection[str]]],
    repetitions: Mapping[str, int],
) -> Iterator[tuple[str, Levels]]:
    """Each crossing that is to be played: its prompt and its levels."""
    for chosen in product(*axes.values()):
        texts = {PROMPT: next(iter(repetitions)), **dict(zip(axes, chosen, strict=True))}
        if not any(all(texts[name] in wanted for name, wanted in row.items()) for row in skip):
            yield texts[PROMPT], {name: axes[name][texts[name]] for name in axes}


def _check_size(
    axes: Mapping[str, Mapping[str, JsonValue]],
    skip: Sequence[Mapping[str, Collection[str]]],
    repetitions: Mapping[str, int],
    conditions: int,
) -> None:
    """Raise UsageError where these are more trials than can be played."""
    sizes = Counter({f"levels of {name}": len(levels) for name, levels in axes.items()})
    crossings = math.prod(sizes.values())
    sizes.update({"conditions": conditions, "repetitions": max(repetitions.values())})
    trials = math.prod(sizes.values())
    if crossings <= MOST_TRIALS:  # few enough to go through
        trials = conditions * sum(repetitions[p] for p, _ in _crossings(axes, skip, repetitions))
    if trials > MOST_TRIALS:
        large = [(f"{n:,} {what}", what) for what, n in sizes.most_common() if n > 1]
        raise UsageError(
            f"{' x '.join(size for size, _ in large)} make {trials:,} trials, and at most "
            f"{MOST_TRIALS:,} can be played: leave out {large[0][1]}, in the file or by --only, "
            "--conditions or --reps"
        )


def chosen_models(file: StudyFile, models: Sequence[str]) -> tuple[str, ...]:
    """Return who drives: the ``models`` asked for, else the study's own, else the emulator."""
    return tuple(dict.fromkeys(models or file.models or (EMULATOR,)))


def driver_names(file: StudyFile, models: Iterable[str]) -> set[str]:
    """Return the names of all drivers that meet where these models drive in a study."""
    pairs = [*models, *map(level_text, file.factors.get(OPPONENT, ()))]
    return {name for pair in pairs for name in both_sides(pair).values()}


def _once(arms: Iterable[Arm], *, mirrored: bool) -> Iterator[Arm]:
    """The arms, but one of two ``mirrored`` pairs that are each other's mirror image.

    Raises UsageError where others are the same trials, as with a model as its own opponent.
    """
    known: dict[tuple[str, ...], Arm] = {}
    for arm in arms:
        apart = [f"{n}={level}" for n, level in arm.factors.items() if n not in (PROMPT, OPPONENT)]
        twin = known.setdefault((arm.model, arm.variant, *apart), arm)
        if twin is arm:
            yield arm
        elif not (mirrored and arm.is_mixed and arm.asked == twin.asked):
            raise UsageError(
                f"the crossings {twin.label!r} and {arm.label!r} are the same trials: leave one "
                "out, by skip"
            )


def level_text(level: JsonValue) -> str:
    """How a level is written in results: a string as it is, anything else as JSON."""
    return level if isinstance(level, str) else json.dumps(level, separators=(",", ":"))


def _arm(
    file: StudyFile,
    levels: Levels,
    prompt: str,
    repetitions: Mapping[str, int],
    registry: Mapping[str, ModelEntry],
    varying: Sequence[str],
) -> Arm:
    sides = _sides(str(levels[MODEL]), str(levels.get(OPPONENT, SELF)))
    for name in sides.values():
        require({**registry, **PROGRAMS}, "model", name, "two joined by + drive left and right")
    programs = {name: PROGRAMS[name] for name in sides.values() if name not in registry}
    scenario = _scenario(file, levels, programs)
    for name, program in programs.items():
        _refuse_hurry(name, program, scenario)
        pace_of(scenario, program.in_spec(name))
    parameters = {name: level for name, level in levels.items() if _is_parameter(name)}
    changed = {*both_sides(str(levels[MODEL])).values()}
    refused = [name for name, level in parameters.items() if level != DEFAULT]
    if refused and not changed & {*registry}:
        raise UsageError(
            f"{levels[MODEL]} is a program and takes no {refused[0]}, only {DEFAULT!r}"
        )
    entries: dict[str, ModelEntry] = {}
    asked = {}
    for side, name in sides.items():
        label, entry = _entry(name, registry, parameters if name in changed else {})
        asked[side] = label
        if entry is not None:
            entries[label] = entry
    return Arm(
        model=_pair(*sides.values()),
        sides=sides,
        asked=asked,
        entries=entries,
        scenario=scenario,
        variant=prompt,
        repetitions=repetitions[prompt],
        factors={name: level_text(levels[name]) for name in levels if name in file.factors},
        label=" ".join(
            level_text(levels[name])
            if name in (MODEL, PROMPT)
            else f"{name}={level_text(levels[name])}"
            for name in varying
        )
        or prompt,
        ego=ego_side(sides, registry, str(levels.get(OPPONENT, SELF))),
    )


def _scenario(file: StudyFile, levels: Levels, programs: Mapping[str, Program]) -> ScenarioConfig:
    """The scenario with the switches of these levels, for these programs; raises UsageError."""
    fields = ScenarioConfig.model_fields.keys() - SET_BY.keys()
    given = file.scenario.model_dump(exclude_unset=True)
    given |= {name: levels[name] for name in levels if name in fields}
    step = _world_step(validated(ScenarioConfig, given, "factors"), programs)
    known = {PERFECT_ONE: PERFECT, **file.perception}
    hint = f"define another one as [{PERCEPTION}.NAME]"
    for factor in SET_BY.keys() & levels.keys():
        level = level_text(levels[factor])
        perception = require(known, f"level of the factor {factor}:", level, hint)
        given |= dict.fromkeys(SET_BY[factor], perception.model_dump())
    return validated(ScenarioConfig, {**given, **step}, "factors")


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


def _refuse_hurry(name: str, program: Program, scenario: ScenarioConfig) -> None:
    """Raise UsageError for a clock faster than the prompt rate, if that is the program's own."""
    source, rate_hz = PROGRAMS.get(program.based_on), program.rate_hz
    if source is None or source.rate_hz is not None or rate_hz is None:
        return
    if rate_hz > scenario.prompt_rate_hz * (1 + 1e-9):
        raise UsageError(
            f"{name}: clock = {1 / rate_hz:g} is too fast: {program.based_on} decides every "
            f"{1 / scenario.prompt_rate_hz:g} s (1 / prompt_rate_hz), and a clock can only slow it "
            "down"
        )


def _pair(left: str, right: str) -> str:
    """Who drives, as ids of trials say."""
    return left if left == right else f"{left}+{right}"


def _sides(model: str, opponent: str) -> dict[Side, str]:
    if opponent == SELF:
        return both_sides(model)
    if "+" in model:
        raise UsageError(f"{model} is a pair already, and has no other opponent than {SELF}")
    return dict(zip(SIDES, (model, opponent), strict=True))


def _is_parameter(name: str) -> bool:
    return name not in {MODEL, PROMPT, OPPONENT, PERCEPTION, *ScenarioConfig.model_fields}


def _check_names(file: StudyFile, registry: Mapping[str, ModelEntry]) -> None:
    """Raise UsageError for a factor that no model at all takes, as one that is misspelled."""
    if MODEL in file.factors:
        raise UsageError("models are no factor: write models = [...] above the factors")
    if "skip" in file.factors:
        raise UsageError("skip is no factor: write it above [factors]")
    if taken := [name for name in file.drivers if name in registry]:
        raise UsageError(f"[drivers.{taken[0]}] needs another name: there is a model {taken[0]}")
    if PERCEPTION in file.factors and {*_PERCEPTIONS} & file.factors.keys():
        raise UsageError(
            f"the factor {PERCEPTION} is of both sides: name it, or {' and '.join(_PERCEPTIONS)}"
        )
    if PERFECT_ONE in file.perception:
        raise UsageError(
            f"[perception.{PERFECT_ONE}] needs another name: {PERFECT_ONE} is to be told the truth"
        )
    known = known_parameters(registry.values())
    for name in filter(_is_parameter, file.factors):
        if name not in known:
            switches = ScenarioConfig.model_fields
            valid = (PROMPT, OPPONENT, PERCEPTION, *sorted(known), *switches)
            raise unknown_name("factor", name, valid)


def _entry(
    name: str, registry: Mapping[str, ModelEntry], parameters: Levels
) -> tuple[str, ModelEntry | None]:
    """A driver with these parameters, and the name of this combination."""
    entry = registry.get(name)
    changed = []
    for parameter, level in parameters.items():
        if entry is None or level == DEFAULT:
            continue
        with_it = with_parameter(name, entry, parameter, level)
        if with_it != entry:
            changed.append(f"{parameter}={level_text(level)}")
        entry = with_it
    return " ".join([name, *changed]), entry
