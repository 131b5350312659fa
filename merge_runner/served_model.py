"""Detection of replies by another model than requested, in one place for all callers."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from merge_runner.text_safety import quoted

if TYPE_CHECKING:
    import duckdb

# (requested id, served id)
Pair = tuple[str, str]
# Pairs of a database, and the aliases that its sweeps declare, as pairs too.
PAIRS = """
SELECT DISTINCT model_requested, model_served FROM calls
WHERE model_requested IS NOT NULL AND model_served IS NOT NULL ORDER BY ALL
"""
ALIASES = """
SELECT DISTINCT value->>'id' AS model_requested,
    unnest(try_cast(value->'aliases' AS VARCHAR[])) AS alias
FROM sweeps, json_each(config, '$.models') ORDER BY ALL
"""


def others_among(pairs: Iterable[Pair], aliases: Iterable[Pair]) -> list[Pair]:
    """Return the pairs whose served model is neither the requested one nor one of its aliases."""
    declared = {*aliases}
    return [pair for pair in pairs if pair[1] not in (None, pair[0]) and pair not in declared]


def other_models(connection: duckdb.DuckDBPyConnection) -> list[Pair]:
    """Return the pairs (requested, served) of a database in which another model answered."""
    pairs, aliases = (connection.execute(sql).fetchall() for sql in (PAIRS, ALIASES))
    return others_among(pairs, aliases)


def sql_of(others: Iterable[Pair]) -> str:
    """Return the condition on a row of ``calls`` or ``attempts`` that another model answered."""
    listed = ", ".join(f"({quoted(requested)}, {quoted(served)})" for requested, served in others)
    return f"(model_requested, model_served) IN ({listed})" if listed else "false"
