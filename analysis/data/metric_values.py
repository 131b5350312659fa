"""The values of the metrics, trial by trial: the one place where their SQL is run."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import duckdb
import pandas as pd

from merge_runner.errors import UsageError
from merge_runner.text_safety import first_line
from merge_runner_analysis.data.load import TRIALS, load_each
from merge_runner_analysis.data.reference_data import human_outcomes
from merge_runner_analysis.metrics import JUDGED, METRICS, Metric


def trials_with_metrics(db: Path) -> pd.DataFrame:
    """The rows of ``load_trials`` with a column for each metric that is not JUDGED.

    Raises UsageError, also where the SQL of a metric fails.
    """

    def load(columns: str) -> pd.DataFrame:
        # Subqueries of the metrics may have changed the order.
        sql = f"SELECT *, {columns} FROM ({TRIALS}) AS trials ORDER BY trial_id, spec_hash"  # noqa: S608 # ours
        return load_each({"trials": sql}, db)["trials"]

    return _loaded(load, list(METRICS.values()), "fails")


def outcomes_with_metrics() -> pd.DataFrame:
    """The published human outcomes with a column for each metric that they determine.

    Raises UsageError where the SQL of a metric fails there.
    """
    outcomes = human_outcomes()

    def load(columns: str) -> pd.DataFrame:
        with duckdb.connect() as connection:
            connection.register("trials", outcomes.assign(number=outcomes.index))
            return connection.sql(f"SELECT {columns} FROM trials ORDER BY number").df()  # noqa: S608 # ours

    known = [metric for metric in METRICS.values() if metric.humans_from == "outcomes"]
    return outcomes.join(_loaded(load, known, "fails on the published human outcomes"))


def _loaded(load: Callable[[str], pd.DataFrame], metrics: list[Metric], fails: str) -> pd.DataFrame:
    """The columns of the metrics that are not JUDGED; UsageError names one whose SQL fails."""
    chosen = [metric for metric in metrics if metric.value not in JUDGED]
    types = {metric.column: "boolean" if metric.rate else "float" for metric in chosen}
    try:
        return load(", ".join(metric.selected for metric in chosen)).astype(types)
    except (duckdb.Error, UsageError):  # the latter where a results database is read
        for metric in chosen:
            try:
                load(metric.selected)
            except (duckdb.Error, UsageError) as exc:
                reason = first_line(exc.__cause__ or exc)
                raise UsageError(f"the SQL of the metric {metric.name} {fails}: {reason}") from exc
        raise
