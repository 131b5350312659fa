"""Steps to take after a study, by its results: a sentence and a command for each."""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping, Sequence
from typing import Any

from merge_runner_analysis.published import human_counts
from merge_runner_analysis.web.comparison import Comparison
from merge_runner_analysis.web.judged import Driver
from merge_runner_analysis.web.people import repeated
from merge_runner_analysis.web.question import Answer
from merge_runner_analysis.web.runs import study_in, without
from merge_runner_analysis.wording import (
    DIFFERS,
    ENOUGH,
    MOCK,
    has_verdict,
    joined,
    shown_state,
)

REHEARSED = (
    "This was a rehearsal: no conclusion rests on it. Run the study with a language model, first "
    "with --dry-run, which estimates the cost"
)
REPEATED = (
    f"{{}}: fewer than {ENOUGH} different trials, and more repetitions would be the same again. "
    "Add {}another driver"
)
FEW = f"{{}}: fewer than {ENOUGH} counted trials. Add repetitions"
UNDECIDED = (
    "By people's rule it is not known how many trials crashed, since another rule ended some. To "
    "know it, set this {}, and play the study again"
)
BY_OUTLINES = 'collision_rule = "rectangle"'
UNASKED = ("--yes", "--quiet")  # of a rehearsal, not of a run that costs money
UNSHOWN = "No effect is shown. Estimate how many trials one would need"


def next_steps(
    program: str,
    played: Sequence[str],
    study: str,
    drivers: Sequence[Driver],
    short: Mapping[str, str],
    conditions: Mapping[str, Any],
    answers: Answer | Comparison | None,
) -> list[tuple[str, str]]:
    """Return sentences with commands; ``played`` are the words that played a ``study``, a text."""
    sweep = ["sweep", *without("--recording", played)[1:]]  # a replay plays no further trial

    def again(*options: str) -> str:
        return shlex.join([program, *sweep, *options])

    steps = []
    if is_rehearsal(drivers):
        of_any = [word for word in without("--model", sweep) if word not in UNASKED]
        steps.append((REHEARSED, shlex.join([program, *of_any, "--model", "MODEL", "--dry-run"])))
    judged = [driver for driver in drivers if driver.cells]
    few = [of for of in judged if not has_verdict(of.cells["collisions"].values)]
    same = [short[of.name] for of in few if repeated(of, conditions)[0]]
    others = [short[of.name] for of in few if short[of.name] not in same]
    if same:
        unplayed = len(human_counts().keys() - conditions["names"])
        more = "situations that people drove, or " * bool(unplayed)
        steps.append((REPEATED.format(joined(same), more), ""))
    if others and not is_rehearsal(drivers):
        steps.append((FEW.format(joined(others)), again("--reps", "N")))
    if any(driver.cells["collisions"].values.get("undecided") for driver in judged):
        file = study_in(sweep) or f"a copy of {sweep[1]}.toml"
        has_table = re.search(r"^\s*\[scenario\]", study, re.MULTILINE)
        place = f"in [scenario] of {file}" if has_table else f"at the top of {file}"
        steps.append((UNDECIDED.format(place), "scenario." * (not has_table) + BY_OUTLINES))
    if isinstance(answers, Answer) and not any(row.is_shown for row in answers.changes):
        steps.append((UNSHOWN, shlex.join([program, "power", study_in(sweep) or sweep[1]])))
    return steps


def is_rehearsal(drivers: Sequence[Driver]) -> bool:
    """Return whether mock models alone drove."""
    return {driver.kind for driver in drivers} == {MOCK}


def is_found(drivers: Sequence[Driver], answers: Answer | Comparison | None) -> bool:
    """Return whether a difference is shown: of levels, of drivers, or from people."""
    if is_rehearsal(drivers):
        return False
    if isinstance(answers, Answer):
        return any(row.is_shown for row in (*answers.changes, *answers.others))
    if answers and any(row.is_shown for row in answers.rows):
        return True
    return any(
        shown_state(cell.values) in DIFFERS for driver in drivers for cell in driver.cells.values()
    )
