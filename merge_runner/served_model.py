"""Whether another model answered than was asked for: decided here, and nowhere else."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import TYPE_CHECKING

from merge_runner.text_safety import quoted

if TYPE_CHECKING:
    import duckdb

# The id that was asked for, and the one that answered.
Pair = tuple[str, str]

# The pairs of a database, and the aliases that any of its sweeps declares, as pairs too.
PAIRS = """
SELECT DISTINCT model_requested, model_served FROM calls
WHERE model_requested IS NOT NULL AND model_served IS NOT NULL ORDER BY ALL
"""
ALIASES = """
SELECT DISTINCT value->>'id' AS model_requested,
    unnest(try_cast(value->'aliases' AS VARCHAR[])) AS alias
FROM sweeps, json_each(config, '$.models') ORDER BY ALL
"""


def own_names(asked: str, aliases: Collection[str] = ()) -> frozenset[str | None]:
    """Return the names under which a model answers; None: the server names none."""
    return frozenset({None, asked, *aliases})


def is_other_model(asked: str, served: str | None, aliases: Collection[str] = ()) -> bool:
    """Return whether another model answered: neither the id asked for nor an alias of it."""
    return served not in own_names(asked, aliases)


def others_among(pairs: Iterable[Pair], aliases: Iterable[Pair]) -> list[Pair]:
    """Return the pairs in which another model answered; ``aliases`` pair ids with aliases."""
    declared: dict[str, set[str]] = {}
    for model, alias in aliases:
        declared.setdefault(model, set()).add(alias)
    return [pair for pair in pairs if is_other_model(*pair, declared.get(pair[0], ()))]


def other_models(connection: duckdb.DuckDBPyConnection) -> list[Pair]:
    """Return the pairs of a database in which another model answered."""
    pairs, aliases = (connection.execute(sql).fetchall() for sql in (PAIRS, ALIASES))
    return others_among(pairs, aliases)


def sql_of(others: Iterable[Pair]) -> str:
    """Return the condition on a row of ``calls`` or ``attempts`` that another model answered."""
    listed = ", ".join(f"({quoted(asked)}, {quoted(served)})" for asked, served in others)
    return f"(model_requested, model_served) IN ({listed})" if listed else "false"
