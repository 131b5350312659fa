"""The trials of a database with their metrics, and with whether they collided, by two rules.

A trial that one rule ended, before the other rule saw a collision, is undecided by the other.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import hypot
from typing import Any

import duckdb
import pandas as pd

from merge_runner.config import ScenarioConfig
from merge_runner.errors import UsageError
from merge_runner.results.frames import frame
from merge_runner.results.instance import SETTINGS
from merge_runner.text_safety import first_line, quoted
from merge_runner_analysis.metrics import JUDGED, LEFT_FIRST, METRICS, Metric
from merge_runner_analysis.outlines import first_overlap
from merge_runner_analysis.published import human_outcomes
from merge_runner_analysis.queries import QUERIES


def with_metrics(connection: duckdb.DuckDBPyConnection, trials: str) -> pd.DataFrame:
    """Return the rows of a query of trials with a column for each metric that is not JUDGED."""
    metrics = [metric for metric in METRICS.values() if metric.value not in JUDGED]
    types = {metric.column: "boolean" if metric.rate else "float" for metric in metrics}
    types |= {metric.weight_column: "float" for metric in metrics if metric.weight}
    try:
        return _selected(connection, trials, metrics).astype(types)
    except duckdb.Error:
        # A plug-in's metric may be wrong, or need more memory than is asked for to read ours.
        connection.execute(f"SET memory_limit = '{SETTINGS['memory_limit']}'")
    for metric in metrics:
        try:
            _selected(connection, trials, [metric])
        except duckdb.Error as exc:
            reason = first_line(exc)
            raise UsageError(f"the SQL of the metric {metric.name} fails: {reason}") from exc
    return _selected(connection, trials, metrics).astype(types)


def _selected(
    connection: duckdb.DuckDBPyConnection, trials: str, metrics: list[Metric]
) -> pd.DataFrame:
    columns = ", ".join(metric.selected for metric in metrics)
    # Subqueries of the metrics may have changed the order.
    sql = f"SELECT *, {columns} FROM ({trials}) AS trials ORDER BY trial_id, spec_hash"  # noqa: S608 # ours
    return frame(connection.execute(sql))


def outcomes_with_metrics() -> pd.DataFrame:
    """Return the published human outcomes with a column for each metric that they determine."""
    outcomes = human_outcomes()
    left = outcomes["merged_first"].eq("left").astype("boolean")
    return outcomes.assign(**{LEFT_FIRST.column: left.where(outcomes["status"] == "finished")})


def judged(
    connection: duckdb.DuckDBPyConnection,
    trials: pd.DataFrame,
    specs: Mapping[str, Mapping[str, Any]],
) -> pd.DataFrame:
    """Return the trials with a column for each collision rule: collided or not; NA if unknown."""
    ended, human = trials["status"] != "failed", trials["source"] == "human"
    recorded = trials["status"].eq("collided").astype("boolean").where(ended)
    tasks = {
        name: ScenarioConfig.model_validate(specs.get(name, {}).get("scenario", {}))
        for name in trials.loc[ended & ~human, "spec_hash"].unique()
    }
    near = connection.execute(_near(tasks)).fetchall()
    overlapped = {tuple(key) for *key, samples in near if first_overlap(tasks[key[1]], samples)}
    keys = pd.MultiIndex.from_frame(trials[["trial_id", "spec_hash"]])
    boxes = pd.Series(keys.isin(overlapped), trials.index, dtype="boolean")
    # A trial that another rule ended stays undecided where its trace shows no overlap.
    boxes = boxes.mask(recorded & ~boxes).where(ended).mask(human, recorded)
    return trials.assign(collided=recorded.mask(human), collided_boxes=boxes)


def _near(tasks: Mapping[str, ScenarioConfig]) -> str:
    configs = [ScenarioConfig(), *tasks.values()]
    step_s = max(task.step_s for task in configs)
    # Distance that opposed accelerations, and a resistance, add within a step.
    added_m = 2 * (max(task.max_acceleration_mps2 for task in configs) + 2) * step_s**2
    reach_m = max(hypot(task.vehicle_length_m, task.vehicle_width_m) for task in configs)
    names = ", ".join(map(quoted, tasks)) or "NULL"
    return QUERIES["near"].format(specs=names, step_s=step_s, reach_m=reach_m + added_m + 0.01)
