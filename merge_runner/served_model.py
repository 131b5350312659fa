"""Whether another model answered than was asked for: decided here, and nowhere else."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from merge_runner.text_safety import quoted

if TYPE_CHECKING:
    import duckdb

# The id that was asked for, and the one that answered.
Pair = tuple[str, str]
# Those of a database, and the aliases that any of its sweeps declares, as pairs too.
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
    """Return the pairs in which another model answered; ``aliases`` pair ids with aliases."""
    declared = {*aliases}
    return [pair for pair in pairs if pair[1] not in (None, pair[0]) and pair not in declared]


def other_models(connection: duckdb.DuckDBPyConnection) -> list[Pair]:
    """Return the pairs of a database in which another model answered."""
    pairs, aliases = (connection.execute(sql).fetchall() for sql in (PAIRS, ALIASES))
    return others_among(pairs, aliases)


def sql_of(others: Iterable[Pair]) -> str:
    """Return the condition on a row of ``calls`` or ``attempts`` that another model answered."""
    listed = ", ".join(f"({quoted(asked)}, {quoted(served)})" for asked, served in others)
    return f"(model_requested, model_served) IN ({listed})" if listed else "false"
