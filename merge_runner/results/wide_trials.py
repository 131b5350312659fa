"""One row a trial: itself, its driver and measures, and its level of each factor, with types."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import chain

from merge_runner.results.data_dictionary import tables
from merge_runner.text_safety import quoted

# Each factor with the type that all its levels have; they are written as ``level_text`` does.
FACTORS = """
SELECT factor, CASE
    WHEN bool_and(kind = 'BOOLEAN') THEN 'BOOLEAN'
    WHEN bool_and(kind LIKE '%BIGINT' AND try_cast(value AS BIGINT) IS NOT NULL) THEN 'BIGINT'
    WHEN bool_and(kind LIKE '%BIGINT' OR kind = 'DOUBLE') THEN 'DOUBLE'
    ELSE 'VARCHAR' END AS type
FROM (
    SELECT factor, value, CASE WHEN json_valid(value) THEN json_type(value) ELSE '' END AS kind
    FROM trial_factors {only}
)
GROUP BY factor ORDER BY factor
"""
WIDE = """
SELECT trials.*, trial_drivers.* EXCLUDE (trial_id, spec_hash),
    trial_metrics.* EXCLUDE (trial_id, spec_hash), levels.* EXCLUDE (trial_id, spec_hash)
FROM trials {only}
LEFT JOIN trial_drivers USING (trial_id, spec_hash)
LEFT JOIN trial_metrics USING (trial_id, spec_hash)
LEFT JOIN (SELECT trial_id, spec_hash{levels} FROM trial_factors GROUP BY ALL) AS levels
    USING (trial_id, spec_hash)
ORDER BY trial_id, spec_hash
"""
NAME = "trials_wide"
COMMENT = "One row a trial: trials, trial_drivers, trial_metrics, and a column for each factor."


def only(sweep_id: str | None) -> str:
    """What keeps the rows of one sweep's trials; nothing is left out where none is named."""
    if sweep_id is None:
        return ""
    wanted = f"FROM sweep_trials WHERE sweep_id = {quoted(sweep_id)}"
    return f"SEMI JOIN ({wanted}) USING (trial_id, spec_hash)"


def wide_trials(factors: Iterable[tuple[str, str]], sweep_id: str | None = None) -> str:
    """Return the query of all trials, or of a sweep's, with their FACTORS.

    A factor that is called like a column of the trials has ``factor_`` before its name.
    """
    relations = ("trials", "trial_drivers", "trial_metrics")
    fixed = (table.columns for table in tables() if table.name in relations)
    taken, levels = {column.name for column in chain.from_iterable(fixed)}, ""
    for factor, kind in factors:
        name = f"factor_{factor}" if factor.lower() in taken else factor
        column = '"' + name.replace('"', '""') + '"'
        levels += f", max(value) FILTER (factor = {quoted(factor)})::{kind} AS {column}"
    return WIDE.format(levels=levels, only=only(sweep_id))
