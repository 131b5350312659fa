"""The chances of a study as a table."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

from merge_runner_analysis.power.study import MOST, MULTIPLES, Chance
from merge_runner_analysis.stats.intervals import POWER
from merge_runner_analysis.tables.model import Column, Row, Table

NOT_FINDABLE, NOTHING = "not findable", "nothing to find"
COLUMNS = (
    Column("table", "table"),
    Column("question", "effect"),
    Column("arms", "arms"),
    Column("against", "against"),
    Column("truth", "if trials go as"),
    Column("effect", "size", "number", 2, optional=True),
    Column("unit", "unit"),
    Column("trials", "n", "count"),
    *(Column(f"times_{m:g}", f"x{m:g}", "percent", 0) for m in MULTIPLES),
    Column("smallest", "smallest", "number", 2, optional=True),
    Column("enough", f"n for {100 * POWER:.0f} %"),
    Column("cost_usd", "USD"),
)


def table(found: Mapping[str, Any], chances: Sequence[Chance]) -> Table:
    """The table of a study's chances; ``found`` is what the command tells of the study."""

    def usd(cost: float | None) -> str:
        return "free" if found["free"] else "unknown" if cost is None else f"{cost:.2f}"

    costs = "nothing"
    if not found["free"]:
        each = zip(found["costs_usd"], MULTIPLES, strict=True)
        how = "as measured before" if found["measured"] else "by the registry's typical tokens"
        costs = f"about {', '.join(f'{usd(cost)} (x{m:g})' for cost, m in each)} USD, {how}"
    return Table(
        "power",
        COLUMNS,
        [_row(each, usd) for each in chances],
        (
            f"n: trials of an arm; {', '.join(f'x{m:g}' for m in MULTIPLES)}: the chance to find "
            f"the effect at p < .05 with so many times the repetitions, of {found['simulations']} "
            f"simulated studies with the seed {found['seed']}",
            f"smallest: the smallest effect that is found with a chance of {100 * POWER:.0f} % at "
            f"n; n for {100 * POWER:.0f} %: the trials of an arm from which on the effect is found "
            f"with this chance, at most {MOST} times those of the study; USD: the whole study then",
            "if trials go as: the published odds and gaps of humans; those of the driver as it was "
            "played; or what is planted in the emulator. Against another arm: if both go as "
            "humans, this one leaves 1 m more, or collides twice as often",
            "tests: Firth's likelihood ratio (who merges first), HC3 (gap), equivalence (I4), "
            "Fisher's exact test (collisions), the linear model within conditions (gap of two "
            "arms); each by itself, without correction for their number",
            f"the whole study costs {costs}",
        ),
        title=f"What the study {found['study']} can find ({found['driver']}, "
        f"{found['trials']} trials)",
    )


def _row(each: Chance, usd: Callable[[float | None], str]) -> Row:
    enough = NOTHING if each.effect == 0 else NOT_FINDABLE if each.enough is None else each.enough
    values = asdict(each) | {
        "arms": each.arms[0] if len(each.arms) == 1 else f"each of {len(each.arms)}",
        "enough": str(enough),
        "cost_usd": "" if each.enough is None else usd(each.cost_usd),
    }
    values |= {f"times_{m:g}": 100 * share for m, share in zip(MULTIPLES, each.found, strict=True)}
    return Row(
        "/".join((each.table, each.question, each.truth, each.against, *each.arms)), (), values
    )
