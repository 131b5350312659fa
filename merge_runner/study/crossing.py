"""The full factorial design of a study: its arms, each with its drivers, its world, its prompt."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import partial
from itertools import product

from pydantic import JsonValue

from merge_runner.config import PERFECT, ModelEntry, ScenarioConfig, both_sides, ego_side, validated
from merge_runner.drivers.pace import pace_of
from merge_runner.drivers.registry import EMULATOR, PROGRAMS, Program
from merge_runner.errors import UsageError, unknown_name
from merge_runner.llm.models import known_parameters, with_parameter
from merge_runner.planted_effect import PREFIX
from merge_runner.prompts.blocks import BASELINE, VARIANTS, composed
from merge_runner.records import SIDES, Side, other_side
from merge_runner.registry import require
from merge_runner.study.file import EVERY_PROMPT, GivenTo, StudyFile, StudyText

MODEL, PROMPT, OPPONENT, SELF, DEFAULT = "model", "prompt", "opponent", "self", "default"
FOCAL = "focal"
PERCEPTION, PERFECT_ONE = "perception", "perfect"
MOST_TRIALS = 1_000_000
FINEST = 1_000_000  # steps a second: decimals like 0.05 become the fractions that they stand for
Levels = Mapping[str, JsonValue]


@dataclass(frozen=True, slots=True)
class Arm:
    """One crossing of a study's levels, which is played in all its conditions.

    ``model`` is what ids of trials say, ``sides`` who drives, by their names in the registry, and
    ``asked`` the same, but by the names in ``entries`` of language models with these parameters.
    ``names`` are those of ``asked``, the ego's first, without what words plant in the emulator.
    ``factors`` are the levels as texts; ``label`` names what sets this arm apart from the others.
    ``ego`` is the side of the driver whose odds are told (see ``config.ego_side``). ``focal`` is
    the same where the two drivers are given different words, parameters or perceptions, else None.
    ``prompts`` are by side, where not both are of the ``variant``.
    """

    model: str
    sides: dict[Side, str]
    asked: dict[Side, str]
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
        """The variant of the prompt of one side."""
        return self.prompts.get(side, self.variant)

    @property
    def is_mixed(self) -> bool:
        """Whether two different drivers meet."""
        return self.sides["left"] != self.sides["right"]

    @property
    def is_scripted(self) -> bool:
        """Whether the emulator takes part."""
        return any(entry.provider == EMULATOR for entry in self.entries.values())

    @property
    def model_level(self) -> str:
        """The model as results have it, as a factor: of a pair without an opponent, both."""
        ego, other = self.sides[self.ego], self.sides[other_side(self.ego)]
        alone = not self.is_mixed or self.factors.get(OPPONENT, SELF) != SELF
        return ego if alone else f"{ego}+{other}"


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
    ``mirror``, or where the file says so, two drivers that differ, or are given different things,
    are played both ways round. Each arm is played in so many ``conditions``.
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
        make = partial(_arm, file, levels, texts, repetitions[texts[PROMPT]], registry, varying)
        arm = make()
        turned = (mirror or file.mirror) and (arm.is_mixed or arm.focal is not None)
        for each in (arm, make(turned=True)) if turned else (arm,):
            apart = (f"{n}={t}" for n, t in each.factors.items() if n not in (PROMPT, OPPONENT))
            # What comes to the same trials, as a pair that is named both ways, is played once.
            twin = arms.setdefault((each.model, each.variant, each.focal or "", *apart), each)
            if twin.asked != each.asked:
                raise UsageError(
                    f"the crossings {twin.label!r} and {each.label!r} have the same names, and are "
                    "asked otherwise: leave one out, by skip"
                )
    if not arms:
        raise UsageError("nothing is left to play: look at [factors] and skip, and at --only")
    if mirror and not any(arm.is_mixed or arm.focal for arm in arms.values()):
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
    for name, levels in file.texts.items():
        if name in (*valid, MODEL, FOCAL):
            raise UsageError(f"[texts.{name}] needs another name: there is such a factor already")
        require(file.factors, "factor", name, f"list the levels of {name} in [factors]")
        listed = dict.fromkeys(map(level_text, file.factors[name]))
        for level in levels:
            require(listed, f"level of {name} in [texts.{name}]:", level)
    for name in (*file.factors, *file.effect):
        if name not in valid | file.texts:
            raise _unknown_factor(name, [*valid, *file.texts])
    for name in file.given_to:
        if name in file.texts:
            raise UsageError(f"given_to of {name} stands with its words: in [texts.{name}.LEVEL]")
        of_a_driver = dict.fromkeys(n for n in file.factors if n in (PERCEPTION, *parameters))
        require(of_a_driver, "factor in [given_to]:", name, "a parameter, or the perception")
    taken = [f"drivers.{name}" for name in file.drivers if name in registry]
    taken += [f"{PERCEPTION}.{name}" for name in file.perception if name == PERFECT_ONE]
    if taken:
        raise UsageError(f"[{taken[0]}] needs another name: there is one of this name already")


def _unknown_factor(name: str, valid: Iterable[str]) -> UsageError:
    """The error for a factor that there is not; parameters of the emulator are not suggested."""
    likely = f"words are declared under [texts.{name}.LEVEL]"
    if name == MODEL or name in StudyFile.model_fields:
        likely = "models, skip and other keys of the study stand above [factors]"
    shown = [each for each in valid if not each.startswith(PREFIX)]
    return unknown_name("factor", name, shown, likely=likely)


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
    *,
    turned: bool = False,
) -> Arm:
    """The arm of these levels, which results name by these ``texts``; raises UsageError.

    It is ``turned`` where the drivers have changed their sides.
    """
    model, opponent = texts[MODEL], texts.get(OPPONENT, SELF)
    if opponent != SELF and "+" in model:
        raise UsageError(f"{model} is a pair already, and has no other opponent than {SELF}")
    sides = both_sides(model if opponent == SELF else f"{model}+{opponent}")
    for name in sides.values():
        require({**registry, **PROGRAMS}, "model", name, "two joined by + drive left and right")
    ego = ego_side(sides, registry, opponent)
    if turned:
        sides, ego = {side: sides[other_side(side)] for side in SIDES}, other_side(ego)
    asked = dict(sides)
    entries = {side: registry[name] for side, name in sides.items() if name in registry}
    one_sided = _set_parameters(file, levels, texts, ego, sides, asked, entries)
    words = {n: file.texts[n][text] for n, text in texts.items() if text in file.texts.get(n, ())}
    for name, word in words.items():
        given = _given(word.given_to, ego)
        if not entries.keys() & {*given}:
            raise UsageError(
                f"{sides[given[0]]} is a program and reads no words: leave {name}={texts[name]} "
                "out there, by skip"
            )
        one_sided |= word.given_to != "both"
    names = asked[ego], asked[other_side(ego)]
    _plant(words.values(), ego, sides, asked, entries)
    variant = composed(texts[PROMPT], [f"{name}={texts[name]}" for name in words])
    prompts = {
        side: composed(
            texts[PROMPT],
            [f"{n}={texts[n]}" for n, word in words.items() if side in _given(word.given_to, ego)],
        )
        for side in SIDES
    }
    programs = {name: PROGRAMS[name] for name in sides.values() if name not in registry}
    scenario = _scenario(file, levels, programs, ego)
    if file.given_to.get(PERCEPTION, "both") != "both":
        one_sided |= scenario.perception_left != scenario.perception_right
    parts = (texts[n] if n in (MODEL, PROMPT) else f"{n}={texts[n]}" for n in varying)
    label = " ".join(parts) or texts[PROMPT]
    return Arm(
        model="+".join(dict.fromkeys(sides.values())),
        sides=sides,
        asked=asked,
        names=names,
        entries={asked[side]: entry for side, entry in entries.items()},
        scenario=scenario,
        variant=variant,
        repetitions=repetitions,
        factors={
            n: t for n, t in texts.items() if n in file.factors or (n == PROMPT and file.texts)
        },
        label=f"{label} mirrored" if turned else label,
        ego=ego,
        focal=ego if one_sided else None,
        prompts={} if {*prompts.values()} == {variant} else prompts,
    )


def _given(given_to: GivenTo, ego: Side) -> list[Side]:
    """The sides that are given something."""
    return {"both": [*SIDES], "ego": [ego], "other": [other_side(ego)]}[given_to]


def _set_parameters(
    file: StudyFile,
    levels: Levels,
    texts: Mapping[str, str],
    ego: Side,
    sides: Mapping[Side, str],
    asked: dict[Side, str],
    entries: dict[Side, ModelEntry],
) -> bool:
    """Set the parameters of these levels in ``entries``, and add them to the names in ``asked``.

    Returns whether one driver alone has such a parameter. Raises UsageError.
    """
    others = {MODEL, PROMPT, OPPONENT, PERCEPTION, *ScenarioConfig.model_fields, *file.texts}
    changed, one_sided = {*both_sides(texts[MODEL]).values()}, False
    for parameter in (n for n, x in levels.items() if n not in others and x != DEFAULT):
        given_to = file.given_to.get(parameter, "both")
        given = _given(given_to, ego)
        if given_to == "both":  # an opponent keeps its own
            given = [side for side in given if sides[side] in changed]
        if not entries.keys() & {*given}:
            name = texts[MODEL] if given_to == "both" else sides[given[0]]
            raise UsageError(f"{name} is a program and takes no {parameter}, only {DEFAULT!r}")
        for side in [side for side in given if side in entries]:
            before = entries[side]
            entries[side] = with_parameter(sides[side], before, parameter, levels[parameter])
            if entries[side] != before:
                asked[side] += f" {parameter}={texts[parameter]}"
                one_sided |= given_to != "both"
    return one_sided


def _plant(
    words: Iterable[StudyText],
    ego: Side,
    sides: Mapping[Side, str],
    asked: dict[Side, str],
    entries: dict[Side, ModelEntry],
) -> None:
    """Plant in the emulator what the ``words`` say of it: on both sides, which act on one plan.

    What makes one driver go first makes the other yield.
    """
    scripted = [side for side, entry in entries.items() if entry.provider == EMULATOR]
    own = {side: _number(entries[side], "x_own_first") for side in scripted}
    gap_m = 0.0
    for word in words:
        gap_m += word.emulator.gap_m
        for side in own.keys() & {*_given(word.given_to, ego)}:
            own[side] += word.emulator.own_first
    for side in scripted:
        planted = {
            "x_own_first": own[side],
            "x_other_first": own.get(other_side(side), 0.0),
            "x_gap_m": gap_m + _number(entries[side], "x_gap_m"),
        }
        for parameter, number in planted.items():
            if number != _number(entries[side], parameter):
                entries[side] = with_parameter(sides[side], entries[side], parameter, number)
                asked[side] += f" {parameter}={number:g}"


def _number(entry: ModelEntry, parameter: str) -> float:
    """A parameter of the emulator that is 0 where it is not given."""
    number = entry.parameters.get(parameter)
    return number if isinstance(number, int | float) else 0.0


def _scenario(
    file: StudyFile, levels: Levels, programs: Mapping[str, Program], ego: Side
) -> ScenarioConfig:
    """The scenario with the switches of these levels, for these programs; raises UsageError."""
    sides = [f"{PERCEPTION}_{side}" for side in SIDES]
    fields = ScenarioConfig.model_fields.keys() - {*sides}
    given = file.scenario.model_dump(exclude_unset=True)
    given |= {name: level for name, level in levels.items() if name in fields}
    given |= _world_step(validated(ScenarioConfig, given, "factors"), programs)
    known = {PERFECT_ONE: PERFECT, **file.perception}
    hint = f"define another one as [{PERCEPTION}.NAME]"
    seeing = [f"{PERCEPTION}_{side}" for side in _given(file.given_to.get(PERCEPTION, "both"), ego)]
    for factor in [name for name in (PERCEPTION, *sides) if name in levels]:
        level = level_text(levels[factor])
        perception = require(known, f"level of the factor {factor}:", level, hint).model_dump()
        given |= dict.fromkeys(seeing if factor == PERCEPTION else [factor], perception)
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
