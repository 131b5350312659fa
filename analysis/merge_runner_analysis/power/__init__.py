"""The chances of a study to find effects: simulated trials, judged by the tests of the tables."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from merge_runner.drivers.registry import EMULATOR
from merge_runner.prompts.blocks import decomposed
from merge_runner.run.plan import Plan
from merge_runner.run.summary import UNREAD_WORDS
from merge_runner.study.file import PlantedWords
from merge_runner_analysis.grouping import Group
from merge_runner_analysis.power.assumptions import DEFAULTS, NAMED, PLAYED, cases
from merge_runner_analysis.power.cases import Case, Contrast
from merge_runner_analysis.stats.intervals import POWER
from merge_runner_analysis.tables.model import Column, Row, Table, Value
from merge_runner_analysis.wording import joined

MULTIPLES = (0.5, 1.0, 2.0, 4.0)
SEED = 260409609
COLUMNS = (
    Column("table", "table", noted=True),
    Column("question", "question"),
    Column("arms", "level"),
    Column("against", "against", optional=True),
    Column("truth", "truth"),
    Column("assumed", "assumed by"),
    Column("effect", "effect", "number"),
    Column("unit", "unit"),
    Column("trials", "n", "count"),
    *(Column(f"times_{m:g}", f"x{m:g}", "percent", digits=0) for m in MULTIPLES),
    Column("enough", "n for 80 %", "count", optional=True),
    Column("cost_usd", "USD", "number", optional=True),
)


def power(case: Case | Contrast, multiple: float, simulations: int) -> dict[str, float]:
    """Return by question the share of simulated studies that find it, at a multiple of the size."""
    rng, counts = np.random.default_rng(SEED), Counter[str]()
    for _ in range(simulations):
        counts.update(name for name, shown in case.detected(multiple, rng).items() if shown)
    return {question: counts[question] / simulations for question in case.effects()}


def chances(
    plan: Plan,
    cost_usd: float | None,
    groups: Sequence[Group],
    simulations: int,
    say_now: Callable[[str], object] = str,
) -> Iterator[Row]:
    """Simulate a plan with this cost; ``groups`` are played ones. Raises UsageError.

    Each level but a reference has a row in the primary measure. Drivers have rows without a
    reference if no factor varies, or if levels change their response to the situation. ``say_now``
    gets a line of progress before each simulation.
    """
    labels: dict[Case | Contrast, list[tuple[str, str]]] = {}  # equal ones share rows
    for label, against, case in cases(plan, groups):
        labels.setdefault(case, []).append((label, against))
    for number, (case, names) in enumerate(labels.items(), 1):
        say_now(f"simulating {number} of {len(labels)}: {names[0][0]}")
        at = {m: power(case, m, simulations) for m in MULTIPLES}
        levels, against = (", ".join(dict.fromkeys(column)) for column in zip(*names, strict=True))
        for question, (table, effect, unit, by) in case.effects().items():
            enough = next((m for m in MULTIPLES if at[m][question] >= POWER), None)
            key = [table, question, levels, against, case.truth]
            size = None if enough is None else round(enough * case.trials)
            cost = None if enough is None or cost_usd is None else enough * cost_usd
            shares: list[Value] = [100 * at[m][question] for m in MULTIPLES]
            values = [*key, by, effect, unit, case.trials, *shares, size, cost]
            yield Row("/".join(key), (), dict(zip([c.name for c in COLUMNS], values, strict=True)))


def unread_words(plan: Plan) -> str:
    """Say which levels of texts change no trial of the emulator; empty without one."""
    words = dict.fromkeys(
        word
        for arm in plan.arms
        for entry in arm.entries.values()
        if entry.provider == EMULATOR and "x_persona" not in entry.parameters
        for word in decomposed(arm.variant)[1]
    )
    texts = plan.study.file.texts
    unread = [
        f"{factor}={level}"
        for factor, _, level in (word.partition("=") for word in words)
        if texts[factor][level].emulator == PlantedWords()
    ]
    if not unread:
        return ""
    return f"{joined(unread)}: the power is that of a model which reads the words. {UNREAD_WORDS}"


def power_table(title: str, rows: Sequence[Row], note: str = "") -> Table:
    """Return the rows of ``chances`` as a table, with a note of its own before the others."""
    times = ", ".join(f"x{m:g}" for m in MULTIPLES)
    notes = (
        *filter(None, [note]),
        f"n: trials of the level or driver; {times}: the share of simulated studies with so many "
        "times the repetitions that find the effect at p < .05, by the test of its table (effects; "
        "I1 to I4: indicators; humans: verdicts), before any correction; n for 80 %, USD: the "
        "smallest of these sizes with this power",
        "truth: published humans, the driver as it was played, or what a rehearsal of the emulator "
        "plants",
        f"assumed by: {NAMED} of the study, or {PLAYED}; by {DEFAULTS}, where neither says "
        "anything of the measure, a level goes first in 15 points more, leaves 1 m more, or "
        "collides twice as often. What words plant in the emulator is never assumed",
        "effects: a row for each level in the study's primary measure; nothing is assumed of "
        "interactions. n counts all trials; the table effects pools sample sets, and counts once "
        "the trials of a mock model that differ in words that it does not read",
    )
    return Table("power", COLUMNS, rows, notes, title=title)
