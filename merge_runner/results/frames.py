"""Results as data frames, whose columns have their types also where there is no value."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import duckdb
import numpy as np
import pandas as pd

from merge_runner.results.database import only
from merge_runner.results.export import FACTORS, wide_trials
from merge_runner.results.rows import PLACES
from merge_runner.results.store import answer

TEXT = pd.StringDtype(na_value=np.nan)  # what pandas calls str since its version 3
# By the SQL type, without and with missing values; None: as pandas finds it.
DTYPES: dict[str, tuple[Any, Any]] = {
    **dict.fromkeys(("VARCHAR", "JSON"), (TEXT, TEXT)),
    # A number that a query writes with a point is a DECIMAL.
    **dict.fromkeys(("DOUBLE", "FLOAT", "DECIMAL"), ("float64", "float64")),
    **dict.fromkeys(("TINYINT", "SMALLINT", "INTEGER", "BIGINT"), ("int64", "Int64")),
    "HUGEINT": (None, "float64"),  # a sum of whole numbers
    "BOOLEAN": (bool, "boolean"),
    "TIMESTAMP": ("datetime64[us]", "datetime64[us]"),
}


def load(db: Path, sql: str) -> pd.DataFrame:
    """The rows of one read-only query; raises UsageError."""
    with answer(db, sql) as result:
        return frame(result)


def load_of_sweep(db: Path, sweep_id: str, table: str) -> pd.DataFrame:
    """The rows of a table that belong to the trials of a sweep, in the order of their ids."""
    places = ", ".join(("trial_id", *PLACES[table]))
    return load(db, f"FROM {table} {only([sweep_id])} ORDER BY {places}")


def load_trials(db: Path, sweep_id: str) -> pd.DataFrame:
    """The trials of a sweep, with their measures and levels."""
    factors = load(db, FACTORS.format(only=only([sweep_id])))
    return load(db, wide_trials(factors.itertuples(index=False, name=None), [sweep_id]))


def frame(result: duckdb.DuckDBPyConnection) -> pd.DataFrame:
    """All rows of a result.

    Where a value is missing, truth values are ``boolean`` and whole numbers ``Int64``, which know
    missing values; a text is ``str``, and a list an object.
    """
    columns = [(name, str(kind)) for name, kind, *_ in result.description or ()]
    # By place, since two columns may have one name.
    made = pd.DataFrame(result.fetchall(), columns=range(len(columns)))
    for place, (_, kind) in enumerate(columns):
        dtype = DTYPES.get(kind.partition("(")[0], (None, None))[made[place].hasnans]
        if dtype is not None:
            made[place] = made[place].astype(dtype)
    made.columns = pd.Index([name for name, _ in columns])
    return made
