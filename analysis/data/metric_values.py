"""The values of the metrics, trial by trial: the one place where their SQL is run."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import duckdb
import pandas as pd

from analysis.data.load import TRIALS, load_each
from analysis.data.reference_data import human_outcomes
from analysis.metrics import JUDGED, METRICS, Metric
from merge_runner.errors import UsageError
from merge_runner.text_safety import first_line


def trials_with_metrics(db: Path) -> pd.DataFrame:
    """The rows of ``load_trials`` with a column for each metric that is not JUDGED.

    Raises UsageError, also where the SQL of a metric fails.
    """
    metrics = _selected(METRICS.values())
    try:
        found = _load(db, metrics)
    except duckdb.Error:
        for metric in metrics:
            _try_alone(db, metric)
        raise
    return found.astype(_types(metrics))


def outcomes_with_metrics() -> pd.DataFrame:
    """The published human outcomes with a column for each metric that they tell."""
    outcomes = human_outcomes()
    metrics = _selected(one for one in METRICS.values() if one.humans_from == "outcomes")
    with duckdb.connect() as connection:
        connection.register("trials", outcomes.assign(number=outcomes.index))
        sql = f"SELECT {_columns(metrics)} FROM trials ORDER BY number"  # noqa: S608 # ours
        found = connection.sql(sql).df()
    return outcomes.join(found.astype(_types(metrics)))


def _selected(metrics: Iterable[Metric]) -> list[Metric]:
    """Those whose values SQL can select."""
    return [metric for metric in metrics if metric.value not in JUDGED]


def _columns(metrics: Iterable[Metric]) -> str:
    return ", ".join(metric.selected for metric in metrics)


def _types(metrics: Iterable[Metric]) -> dict[str, str]:
    return {metric.column: "boolean" if metric.rate else "float" for metric in metrics}


def _load(db: Path, metrics: Iterable[Metric]) -> pd.DataFrame:
    # Subqueries of the metrics may have changed the order.
    rows = f"({TRIALS}) AS trials"
    sql = f"SELECT *, {_columns(metrics)} FROM {rows} ORDER BY trial_id, spec_hash"  # noqa: S608 # ours
    return load_each({"trials": sql}, db)["trials"]


def _try_alone(db: Path, metric: Metric) -> None:
    try:
        _load(db, [metric])
    except duckdb.Error as exc:
        raise UsageError(f"the SQL of the metric {metric.name} fails: {first_line(exc)}") from exc
