"""Full factorial design of a study: its arms with their drivers, scenario and prompts."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from itertools import product

from pydantic import JsonValue

from merge_runner.config import ScenarioConfig
from merge_runner.drivers.registry import EMULATOR
from merge_runner.errors import UsageError, unknown_name
from merge_runner.llm.models import known_parameters
from merge_runner.planted_effect import PREFIX
from merge_runner.prompts.blocks import BASELINE, VARIANTS
from merge_runner.providers import ModelEntry
from merge_runner.registry import require
from merge_runner.study.arms import (
    FOCAL,
    MODEL,
    OPPONENT,
    PERCEPTION,
    PERFECT_ONE,
    PROMPT,
    Arm,
    Levels,
    level_text,
    make_arm,
)
from merge_runner.study.file import EVERY_PROMPT, StudyFile

MOST_TRIALS = 1_000_000


def cross(
    file: StudyFile,
    models: Sequence[str],
    repetitions: Mapping[str, int],
    registry: Mapping[str, ModelEntry],
    only: Mapping[str, Sequence[str]],
    *,
    conditions: int,
    mirror: bool,
) -> list[Arm]:
    """Return the arms of a study, model by model; raises UsageError for invalid combinations.

    ``repetitions`` are by prompt. ``only`` selects levels, as texts. With ``mirror`` here or in the
    file, pairs with different drivers, texts, parameters or perceptions also play with swapped
    sides. ``conditions`` is the number of conditions of each arm.
    """
    _check_names(file, registry)
    others = {name: levels for name, levels in file.factors.items() if name != PROMPT}
    factors = {MODEL: models, **others, PROMPT: tuple(repetitions)}
    axes = {name: _by_text(file, name, levels) for name, levels in factors.items()}
    skip = _skipped(file, axes, only)
    selected = {
        name: [text for text in levels if text in only.get(name, levels)]
        for name, levels in axes.items()
    }
    combinations = math.prod(map(len, selected.values()))
    if combinations > MOST_TRIALS:  # making their arms would take minutes
        raise _too_many(f"{combinations:,} combinations of levels")
    trials = 0
    varying = [name for name, levels in axes.items() if len(levels) > 1]
    arms: dict[tuple[str, ...], Arm] = {}
    for combination in product(*selected.values()):
        texts = dict(zip(selected, combination, strict=True))
        if any(all(texts[name] in levels for name, levels in row.items()) for row in skip):
            continue
        levels = {name: axes[name][text] for name, text in texts.items()}
        make = partial(make_arm, file, levels, repetitions[texts[PROMPT]], registry, varying)
        first = make()
        has_mirror = (mirror or file.mirror) and (first.is_mixed or first.focal is not None)
        for arm in (first, make(mirrored=True)) if has_mirror else (first,):
            named = (f"{n}={t}" for n, t in arm.factors.items() if n not in (PROMPT, OPPONENT))
            # Arms with the same trials, such as a pair that is listed in both orders, play once.
            twin = arms.setdefault((arm.model, arm.variant, arm.focal or "", *named), arm)
            trials += conditions * arm.repetitions if twin is arm else 0
            if trials > MOST_TRIALS:
                raise _too_many(f"more than {MOST_TRIALS:,} trials")
            if twin.full_names != arm.full_names:
                raise UsageError(
                    f"the crossings {twin.label!r} and {arm.label!r} have the same names, and are "
                    "asked otherwise: leave one out, by skip"
                )
    if not arms:
        raise UsageError("nothing is left to play: look at [factors] and skip, and at --only")
    if mirror and not any(arm.is_mixed or arm.focal for arm in arms.values()):
        raise UsageError(
            f"there are no two different drivers to mirror: name them, as --model {models[0]}+OTHER"
        )
    return list(arms.values())


def _too_many(number: str) -> UsageError:
    return UsageError(
        f"these are {number}, and at most {MOST_TRIALS:,} trials can be played: leave out "
        "levels, conditions or repetitions, in the file or by --only, --conditions or --reps"
    )


def listed_levels(
    file: StudyFile, models: Iterable[str], prompts: Iterable[str] = ()
) -> dict[str, list[str]]:
    """Return the levels of each factor as texts, in the file's order, the reference first.

    ``models`` are the played ones, ``prompts`` those in addition to the file's.
    """
    axes = {MODEL: [*models], **file.factors, PROMPT: [*file_prompts(file), *prompts]}
    return {name: [*_by_text(file, name, levels)] for name, levels in axes.items()}


def file_prompts(file: StudyFile) -> list[str]:
    """Return the prompts of a file."""
    levels = [level_text(level) for level in file.factors.get(PROMPT, ())]
    named = [name for name in file.repetitions if name != EVERY_PROMPT]
    return levels or named or [BASELINE] * (EVERY_PROMPT in file.repetitions)


def chosen_models(file: StudyFile, models: Sequence[str]) -> tuple[str, ...]:
    """Return the drivers: ``models``, or the study's without any, or the emulator."""
    return tuple(dict.fromkeys(models or file.models or (EMULATOR,)))


def _by_text(file: StudyFile, factor: str, levels: Iterable[JsonValue]) -> dict[str, JsonValue]:
    """Return the levels of a factor by text, the reference first."""
    reference = level_text(file.reference.get(factor))
    by_text = {level_text(level): level for level in levels}
    return dict(sorted(by_text.items(), key=lambda item: item[0] != reference))


def _check_names(file: StudyFile, registry: Mapping[str, ModelEntry]) -> None:
    """Raise UsageError for an unknown factor and for a name that is taken."""
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
        driver_factors = dict.fromkeys(n for n in file.factors if n in (PERCEPTION, *parameters))
        require(driver_factors, "factor in [given_to]:", name, "a parameter, or the perception")
    taken = [f"drivers.{name}" for name in file.drivers if name in registry]
    taken += [f"{PERCEPTION}.{name}" for name in file.perception if name == PERFECT_ONE]
    if taken:
        raise UsageError(f"[{taken[0]}] needs another name: there is one of this name already")


def _unknown_factor(name: str, valid: Iterable[str]) -> UsageError:
    """Return the error for an unknown factor; it suggests no parameter of the emulator."""
    likely = f"words are declared under [texts.{name}.LEVEL]"
    if name == MODEL or name in StudyFile.model_fields:
        likely = "models, skip and other keys of the study stand above [factors]"
    shown = [factor for factor in valid if not factor.startswith(PREFIX)]
    return unknown_name("factor", name, shown, likely=likely)


def _skipped(
    file: StudyFile, axes: Mapping[str, Levels], only: Mapping[str, Sequence[str]]
) -> list[dict[str, set[str]]]:
    """Return the levels of each row of ``skip``.

    Raises UsageError for an unknown level there, in ``only`` or in the file's ``reference``.
    """
    skip = [
        {n: {*map(level_text, w if isinstance(w, list) else [w])} for n, w in row.items()}
        for row in file.skip
    ]
    reference = {name: {level_text(level)} for name, level in file.reference.items()}
    # A row may name a model or a prompt that this run does not play.
    models = dict.fromkeys((*axes[MODEL], *file.models))
    known: dict[str, Mapping[str, object]] = {**axes, PROMPT: VARIANTS, MODEL: models}
    for valid, selection in ((axes, only), *((known, row) for row in (*skip, reference))):
        for name, texts in selection.items():
            levels = require(valid, "factor", name)
            for text in texts:
                require(levels, f"level of {name}", text)
    return skip
