"""Results as data frames, for a notebook or a script."""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from merge_runner.places import DEFAULT_DB
from merge_runner.store import query


def load(sql: str, db: Path | str = DEFAULT_DB) -> pd.DataFrame:
    """The rows of one read-only query; raises UsageError."""
    names, rows = query(Path(db), sql)
    return pd.DataFrame(rows, columns=names)


def load_trials(db: Path | str = DEFAULT_DB) -> pd.DataFrame:
    """One row a trial: condition, outcome and metrics in SI units (see merge_runner/schema.sql)."""
    return load(
        "SELECT trials.*, trial_metrics.* EXCLUDE (trial_id, spec_hash) "
        "FROM trials JOIN trial_metrics USING (trial_id, spec_hash) ORDER BY trial_id, spec_hash",
        db,
    )
