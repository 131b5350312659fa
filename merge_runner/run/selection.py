"""The conditions and repetitions that a user selects of a study."""

from __future__ import annotations

import re
from collections.abc import Sequence
from decimal import Decimal
from itertools import chain, product

from merge_runner.errors import UsageError
from merge_runner.prompts.blocks import VARIANTS, blocks_of
from merge_runner.records import MOST_REPETITIONS
from merge_runner.scenarios.merge.conditions import (
    CONDITIONS,
    HUMAN_CONDITIONS,
    NUMBER,
    Condition,
    condition_name,
)
from merge_runner.study.crossing import file_prompts
from merge_runner.study.file import EVERY_CONDITION, EVERY_PROMPT, StudyFile, StudySource

USUAL_GRID = "h=-6:6:2,dv=-1.6:1.6:0.4"
"""Projected headways in m and relative velocities in m/s, left minus right: FROM:TO:STEP."""
MOST_VALUES = 100  # of an axis
_AXIS = re.compile(
    f"(?P<name>h|dv)=(?P<first>{NUMBER})(:(?P<last>{NUMBER}):(?P<step>{NUMBER}))?", re.ASCII
)


def grid_conditions(text: str) -> list[str]:
    """Return the names of the conditions of a grid such as USUAL_GRID, or ``usual``.

    ``h`` or ``dv`` may be one number; one that is left out is taken from USUAL_GRID. Raises
    UsageError.
    """
    parts = USUAL_GRID if text == "usual" else f"{USUAL_GRID},{text}"
    points = list(product(*dict(map(_axis, parts.split(","))).values()))
    for point in points:
        Condition(*point)  # raises where a vehicle would not drive forwards
    return [condition_name(*point) for point in points]


def _axis(text: str) -> tuple[str, list[float]]:
    """Return name and values of a part of a grid, computed in decimals: 3 * 0.4 is 1.2."""
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


def selected_conditions(file: StudyFile, chosen: Sequence[str] | None) -> tuple[str, ...]:
    """Return the names of the conditions, each once; raises UsageError where none is left."""
    selected = next(c for c in (chosen, file.conditions, HUMAN_CONDITIONS) if c is not None)
    names = (HUMAN_CONDITIONS if name == EVERY_CONDITION else (name,) for name in selected)
    if conditions := tuple(dict.fromkeys(chain.from_iterable(names))):
        return conditions
    raise UsageError(f"no condition is left; valid: {', '.join(CONDITIONS)}")


def selected_repetitions(
    study: StudySource, variants: Sequence[str] | None, chosen: int | None
) -> dict[str, int]:
    """Return the selected prompts with their repetitions per condition; raises UsageError."""
    if chosen is not None and not 1 <= chosen <= MOST_REPETITIONS:
        raise UsageError(f"--reps is a whole number from 1 to {MOST_REPETITIONS}")
    given, selected = study.file.repetitions, {}
    for variant in file_prompts(study.file) if variants is None else variants:
        VARIANTS.require(variant)
        blocks_of(variant)  # raises where it names a block that there is not
        selected[variant] = chosen or given.get(variant, given.get(EVERY_PROMPT, 0))
    if selected and all(selected.values()):
        return selected
    lacking = "".join(f" {variant}" for variant, repetitions in selected.items() if not repetitions)
    raise UsageError(
        f"the sweep {study.name} has no variant{lacking}; valid: {', '.join(VARIANTS)}. With "
        "--reps N any variant can be run."
    )
