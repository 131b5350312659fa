"""Results as data frames with fixed column types, also for empty columns."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import duckdb
import numpy as np
import pandas as pd

from merge_runner.results.database import only
from merge_runner.results.export import FACTOR_TYPES, wide_trials
from merge_runner.results.rows import KEY_COLUMNS
from merge_runner.results.store import open_result

TEXT = pd.StringDtype(na_value=np.nan)  # pandas' str since version 3
# By SQL type: dtype without and with missing values; None: inferred by pandas.
DTYPES: dict[str, tuple[Any, Any]] = {
    **dict.fromkeys(("VARCHAR", "JSON"), (TEXT, TEXT)),
    # A literal with a decimal point is a DECIMAL.
    **dict.fromkeys(("DOUBLE", "FLOAT", "DECIMAL"), ("float64", "float64")),
    **dict.fromkeys(("TINYINT", "SMALLINT", "INTEGER", "BIGINT"), ("int64", "Int64")),
    "HUGEINT": (None, "float64"),  # a sum of whole numbers
    "BOOLEAN": (bool, "boolean"),
    "TIMESTAMP": ("datetime64[us]", "datetime64[us]"),
}


def load(db: Path, sql: str) -> pd.DataFrame:
    """Return the rows of a read-only query; raises UsageError."""
    with open_result(db, sql) as result:
        return frame(result)


def load_of_sweep(db: Path, sweep_id: str, table: str) -> pd.DataFrame:
    """Return the rows of a table for the trials of a sweep, sorted by trial id."""
    places = ", ".join(("trial_id", *KEY_COLUMNS[table]))
    return load(db, f"FROM {table} {only([sweep_id])} ORDER BY {places}")


def load_trials(db: Path, sweep_id: str) -> pd.DataFrame:
    """Return the trials of a sweep with their measures and factor levels."""
    factors = load(db, FACTOR_TYPES.format(only=only([sweep_id])))
    return load(db, wide_trials(factors.itertuples(index=False, name=None), [sweep_id]))


def frame(result: duckdb.DuckDBPyConnection) -> pd.DataFrame:
    """Return the rows of a result.

    In columns with missing values, truth values are ``boolean`` and integers ``Int64``, which have
    missing values. Texts are ``str``, and lists are objects.
    """
    columns = [(name, str(kind)) for name, kind, *_ in result.description or ()]
    # By position, since two columns may have the same name.
    rows = pd.DataFrame(result.fetchall(), columns=range(len(columns)))
    for position, (_, kind) in enumerate(columns):
        dtype = DTYPES.get(kind.partition("(")[0], (None, None))[rows[position].hasnans]
        if dtype is not None:
            rows[position] = rows[position].astype(dtype)
    rows.columns = pd.Index([name for name, _ in columns])
    return rows
