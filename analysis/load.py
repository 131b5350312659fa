"""Results as data frames; all SQL that reads for the analysis."""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from merge_runner.places import DEFAULT_DB
from merge_runner.store import query

TRIALS = (
    "SELECT trials.*, trial_metrics.* EXCLUDE (trial_id, spec_hash) "
    "FROM trials JOIN trial_metrics USING (trial_id, spec_hash) ORDER BY trial_id, spec_hash"
)
# One row a vehicle; the speeds from the start of control on.
SPEEDS = (
    "SELECT trial_id, spec_hash, side, list(time_s ORDER BY step) AS time_s, "
    "list(velocity_mps ORDER BY step) AS velocity_mps FROM states WHERE time_s >= 0 "
    "GROUP BY ALL ORDER BY ALL"
)
# A plan's revision: |the new plan's first actions - the old plan's for the same instants|. Both
# plans cover the horizon; the older one is `executed` actions ahead of the new one.
PLANS = """
WITH plans AS (
    SELECT trial_id, spec_hash, side, decision, plan, len(applied) AS executed,
        lag(plan) OVER driver AS before
    FROM decisions WINDOW driver AS (PARTITION BY trial_id, spec_hash, side ORDER BY decision)
), compared AS (
    SELECT trial_id, spec_hash,
        len(list_distinct(plan)) <= 2 AS coarse,
        CASE WHEN before IS NOT NULL AND len(before) > executed THEN list_avg(list_transform(
            range(1, len(before) - executed + 1),
            lambda i: abs(plan[i] - before[i + executed]))) END AS revision
    FROM plans WHERE plan IS NOT NULL
)
SELECT trial_id, spec_hash, count(*) AS plans, count(*) FILTER (coarse) AS coarse_plans,
    count(revision) AS revised_plans, sum(revision) AS total_revision,
    count(*) FILTER (revision > 0.1) AS large_revisions
FROM compared GROUP BY ALL ORDER BY ALL
"""
# How many calls of a variant's spec share their reply with a baseline's spec.
SHARED = """
WITH used AS (
    SELECT DISTINCT spec_hash, variant, call_key
    FROM decisions JOIN trials USING (trial_id, spec_hash) WHERE call_key IS NOT NULL
), totals AS (SELECT spec_hash, count(*) AS calls FROM used GROUP BY ALL)
SELECT one.spec_hash, base.spec_hash AS baseline, calls, count(*) AS shared
FROM used AS one JOIN used AS base USING (call_key) JOIN totals ON totals.spec_hash = one.spec_hash
WHERE one.variant <> 'baseline' AND base.variant = 'baseline' GROUP BY ALL ORDER BY ALL
"""


def load(sql: str, db: Path | str = DEFAULT_DB) -> pd.DataFrame:
    """The rows of one read-only query; raises UsageError."""
    names, rows = query(Path(db), sql)
    return pd.DataFrame(rows, columns=names)


def load_trials(db: Path | str = DEFAULT_DB) -> pd.DataFrame:
    """One row a trial: condition, outcome and metrics in SI units (see merge_runner/schema.sql)."""
    return load(TRIALS, db)


def load_speeds(db: Path | str = DEFAULT_DB) -> pd.DataFrame:
    """One row a vehicle: lists of times in s and speeds in m/s from the start of control on."""
    return load(SPEEDS, db)


def load_plans(db: Path | str = DEFAULT_DB) -> pd.DataFrame:
    """One row a trial: its valid plans, how coarse they are and how much they were revised."""
    return load(PLANS, db)
