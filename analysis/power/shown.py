"""The chances of a study as a table."""

from __future__ import annotations

from analysis.power.search import MOST
from analysis.power.study import MULTIPLES, Chance, Power
from analysis.stats.intervals import POWER
from analysis.tables.model import Column, Row, Table, Value

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


def table(found: Power) -> Table:
    """The table of a study's chances."""
    return Table(
        "power",
        f"What the study {found.study} can find ({found.driver}, {found.trials} trials)",
        COLUMNS,
        [_row(found, each) for each in found.chances],
        (
            f"n: trials of an arm; {', '.join(f'x{m:g}' for m in MULTIPLES)}: the chance to find "
            f"the effect at p < .05 with so many times the repetitions, of {found.simulations} "
            f"simulated studies with the seed {found.seed}",
            f"smallest: the smallest effect that is found with a chance of {100 * POWER:.0f} % at "
            f"n; n for {100 * POWER:.0f} %: the trials of an arm from which on the effect is found "
            f"with this chance, at most {MOST} times those of the study; USD: the whole study then",
            "if trials go as: the published odds and gaps of humans; those of the driver cei; "
            "those of humans, but that who merges first does not depend on the relative velocity; "
            "or what is planted in the emulator. Against another arm: that one goes so, and this "
            "one lacks the cue, leaves 1 m more, or collides twice as often",
            "tests: Firth's likelihood ratio (who merges first), HC3 (gap), equivalence (I4), "
            "Fisher's exact test (collisions), the linear model within conditions (gap of two "
            "arms); each by itself, without correction for their number",
            f"the whole study costs {_costs(found)}",
        ),
    )


def _row(found: Power, each: Chance) -> Row:
    values: dict[str, Value] = {
        "table": each.table,
        "question": each.question,
        "arms": each.arms[0] if len(each.arms) == 1 else f"each of {len(each.arms)}",
        "against": each.against,
        "truth": each.truth,
        "effect": each.effect,
        "unit": each.unit,
        "trials": each.trials,
        "smallest": each.smallest,
        "enough": _enough(each),
        "cost_usd": "" if each.enough is None else _usd(found, each.cost_usd),
    }
    values |= {f"times_{m:g}": 100 * share for m, share in zip(MULTIPLES, each.found, strict=True)}
    row = "/".join((each.table, each.question, each.truth, each.against, *each.arms))
    return Row(row, (), values)


def _enough(each: Chance) -> str:
    if each.effect == 0:
        return NOTHING
    return NOT_FINDABLE if each.enough is None else str(each.enough)


def _costs(found: Power) -> str:
    if found.free:
        return "nothing"
    costs = ", ".join(
        f"{_usd(found, cost)} (x{multiple:g})"
        for multiple, cost in zip(MULTIPLES, found.costs_usd, strict=True)
    )
    how = "as measured before" if found.measured else "by the registry's typical tokens"
    return f"about {costs} USD, {how}"


def _usd(found: Power, cost_usd: float | None) -> str:
    if found.free:
        return "free"
    return "unknown" if cost_usd is None else f"{cost_usd:.2f}"
