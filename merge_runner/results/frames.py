"""Results as data frames, whose columns have their types also where there is no value."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import duckdb
import numpy as np
import pandas as pd

from merge_runner.results.store import answer
from merge_runner.text_safety import quoted

WHOLE_NUMBERS = ("TINYINT", "SMALLINT", "INTEGER", "BIGINT")
TEXT = pd.StringDtype(na_value=np.nan)  # what pandas calls str since its version 3
DTYPES = {
    "VARCHAR": TEXT,
    "JSON": TEXT,
    "DOUBLE": "float64",
    "FLOAT": "float64",
    "TIMESTAMP": "datetime64[us]",
}
# The rows of one sweep, in the order of its trials' ids.
OF_SWEEP = {
    "trials": """
        SELECT trials.*, trial_drivers.driver, trial_metrics.* EXCLUDE (trial_id, spec_hash)
        FROM trials SEMI JOIN wanted USING (trial_id, spec_hash)
        LEFT JOIN trial_drivers USING (trial_id, spec_hash)
        LEFT JOIN trial_metrics USING (trial_id, spec_hash) ORDER BY trial_id""",
    "states": """
        FROM states SEMI JOIN wanted USING (trial_id, spec_hash) ORDER BY trial_id, step, side""",
    "decisions": """
        FROM decisions SEMI JOIN wanted USING (trial_id, spec_hash)
        ORDER BY trial_id, decision, side""",
    "calls": """
        FROM calls SEMI JOIN wanted USING (trial_id, spec_hash)
        ORDER BY trial_id, decision, side, attempt""",
    "trial_factors": """
        FROM trial_factors SEMI JOIN wanted USING (trial_id, spec_hash)
        ORDER BY trial_id, factor""",
}


def load(db: Path, sql: str) -> pd.DataFrame:
    """The rows of one read-only query; raises UsageError."""
    with answer(db, sql) as result:
        return frame(result)


def load_of_sweep(db: Path, sweep_id: str, table: str) -> pd.DataFrame:
    """The rows of a table (one of OF_SWEEP) that belong to the trials of a sweep."""
    wanted = f"FROM sweep_trials SELECT DISTINCT * WHERE sweep_id = {quoted(sweep_id)}"
    return load(db, f"WITH wanted AS ({wanted}) {OF_SWEEP[table]}")


def with_factors(trials: pd.DataFrame, factors: pd.DataFrame) -> pd.DataFrame:
    """Trials with a column for each factor, of numbers or truth values where all levels are such.

    A factor that is called like a column of the trials has ``factor_`` before its name.
    """
    keys = ["trial_id", "spec_hash"]
    wide = factors.pivot(index=keys, columns="factor", values="value")
    columns = {
        f"factor_{name}" if name in trials else name: _of_levels(wide[name]) for name in wide
    }
    return trials.merge(pd.DataFrame(columns, index=wide.index).reset_index(), "left", on=keys)


def _of_levels(texts: pd.Series) -> pd.Series:
    """A factor's column; its levels are written as ``level_text`` does."""
    try:
        values = [json.loads(text) for text in texts.dropna().unique()]
    except ValueError:
        values = []
    if values and all(isinstance(value, bool) for value in values):
        return texts.map({"true": True, "false": False}).astype("boolean")
    if values and all(type(value) in (int, float) for value in values):
        return pd.to_numeric(texts)
    return texts.astype(TEXT)


def frame(result: duckdb.DuckDBPyConnection) -> pd.DataFrame:
    """All rows of a result.

    Where a value is missing, truth values are ``boolean`` and whole numbers ``Int64``, which know
    missing values; a text is ``str``, and a list or a decimal number an object.
    """
    columns = [(name, str(kind)) for name, kind, *_ in result.description or ()]
    # By place, since two columns may have one name.
    made = pd.DataFrame(result.fetchall(), columns=range(len(columns)))
    types = {place: _dtype(kind, made[place]) for place, (_, kind) in enumerate(columns)}
    made = made.astype({place: dtype for place, dtype in types.items() if dtype is not None})
    made.columns = pd.Index([name for name, _ in columns])
    return made


def _dtype(kind: str, values: pd.Series) -> Any:  # noqa: ANN401 # pandas knows many
    """The dtype of a column of this SQL type; None: as pandas finds it."""
    if kind == "BOOLEAN":
        return "boolean" if values.hasnans else bool
    if kind in WHOLE_NUMBERS:
        return "Int64" if values.hasnans else "int64"
    return DTYPES.get(kind)
