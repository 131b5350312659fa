"""The values of the metrics, trial by trial: the one place where their SQL is run."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import duckdb
import pandas as pd

from merge_runner.errors import UsageError
from merge_runner.text_safety import first_line
from merge_runner_analysis.data.load import TRIALS, load_each
from merge_runner_analysis.data.reference_data import human_outcomes
from merge_runner_analysis.metrics import JUDGED, METRICS, Metric

Load = Callable[[Sequence[Metric]], pd.DataFrame]


def trials_with_metrics(db: Path) -> pd.DataFrame:
    """The rows of ``load_trials`` with a column for each metric that is not JUDGED.

    Raises UsageError, also where the SQL of a metric fails.
    """

    def load(metrics: Sequence[Metric]) -> pd.DataFrame:
        # Subqueries of the metrics may have changed the order.
        rows = f"({TRIALS}) AS trials"
        sql = f"SELECT *, {_columns(metrics)} FROM {rows} ORDER BY trial_id, spec_hash"  # noqa: S608 # ours
        return load_each({"trials": sql}, db)["trials"]

    return _loaded(load, METRICS.values(), "fails")


def outcomes_with_metrics() -> pd.DataFrame:
    """The published human outcomes with a column for each metric that they determine.

    Raises UsageError where the SQL of a metric fails there.
    """
    outcomes = human_outcomes()

    def load(metrics: Sequence[Metric]) -> pd.DataFrame:
        with duckdb.connect() as connection:
            connection.register("trials", outcomes.assign(number=outcomes.index))
            sql = f"SELECT {_columns(metrics)} FROM trials ORDER BY number"  # noqa: S608 # ours
            return connection.sql(sql).df()

    known = (one for one in METRICS.values() if one.humans_from == "outcomes")
    return outcomes.join(_loaded(load, known, "fails on the published human outcomes"))


def _loaded(load: Load, metrics: Iterable[Metric], fails: str) -> pd.DataFrame:
    """The columns of the metrics that are not JUDGED; UsageError names one whose SQL fails."""
    chosen = [metric for metric in metrics if metric.value not in JUDGED]
    try:
        return load(chosen).astype(_types(chosen))
    except (duckdb.Error, UsageError):  # the latter where a results database is read
        for metric in chosen:
            _try_alone(load, metric, fails)
        raise


def _try_alone(load: Load, metric: Metric, fails: str) -> None:
    try:
        load([metric])
    except (duckdb.Error, UsageError) as exc:
        said = first_line(exc.__cause__ or exc)
        raise UsageError(f"the SQL of the metric {metric.name} {fails}: {said}") from exc


def _columns(metrics: Iterable[Metric]) -> str:
    return ", ".join(metric.selected for metric in metrics)


def _types(metrics: Iterable[Metric]) -> dict[str, str]:
    return {metric.column: "boolean" if metric.rate else "float" for metric in metrics}
