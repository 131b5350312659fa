"""Results as data frames, whose columns have their types also where there is no value."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import duckdb
import numpy as np
import pandas as pd

from merge_runner.results.comparison import PLACES
from merge_runner.results.export import FACTORS, only, wide_trials
from merge_runner.results.store import answer

WHOLE_NUMBERS = ("TINYINT", "SMALLINT", "INTEGER", "BIGINT")
TEXT = pd.StringDtype(na_value=np.nan)  # what pandas calls str since its version 3
DTYPES = {
    "VARCHAR": TEXT,
    "JSON": TEXT,
    "DOUBLE": "float64",
    "FLOAT": "float64",
    "DECIMAL": "float64",  # a number that a query writes with a point
    "TIMESTAMP": "datetime64[us]",
}


def load(db: Path, sql: str) -> pd.DataFrame:
    """The rows of one read-only query; raises UsageError."""
    with answer(db, sql) as result:
        return frame(result)


def load_of_sweep(db: Path, sweep_id: str, table: str) -> pd.DataFrame:
    """The rows of a table that belong to the trials of a sweep, in the order of their ids."""
    places = ", ".join(("trial_id", *PLACES[table]))
    return load(db, f"FROM {table} {only(sweep_id)} ORDER BY {places}")


def load_trials(db: Path, sweep_id: str) -> pd.DataFrame:
    """The trials of a sweep, with their measures and levels."""
    factors = load(db, FACTORS.format(only=only(sweep_id)))
    return load(db, wide_trials(factors.itertuples(index=False, name=None), sweep_id))


def frame(result: duckdb.DuckDBPyConnection) -> pd.DataFrame:
    """All rows of a result.

    Where a value is missing, truth values are ``boolean`` and whole numbers ``Int64``, which know
    missing values; a text is ``str``, and a list an object.
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
    if kind == "HUGEINT":  # a sum of whole numbers
        return "float64" if values.hasnans else None
    if kind in WHOLE_NUMBERS:
        return "Int64" if values.hasnans else "int64"
    return DTYPES.get(kind.partition("(")[0])
