"""Origin of the results: sweeps, specs, outcomes and costs of the calls."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from merge_runner.records import NO_DECISION, SIDES
from merge_runner.results import frames
from merge_runner.results.database import read_database
from merge_runner.served_model import other_models, sql_of
from merge_runner_analysis.frames import KEYS
from merge_runner_analysis.grouping import Group
from merge_runner_analysis.queries import QUERIES
from merge_runner_analysis.study import StudyResults
from merge_runner_analysis.task import leaves, task_settings


class Provenance(NamedTuple):
    """Origin of the report's numbers: rows of the queries here.

    ``settings`` by driver, variant and spec_hash: rule, unusual task settings, request parameters.
    """

    sweeps: pd.DataFrame
    calls: pd.DataFrame
    model_costs: pd.DataFrame
    mismatches: pd.DataFrame
    settings: dict[str, str]


def provenance(db: Path) -> Provenance:
    """Read the origin of a database's results."""
    with read_database(db) as connection:
        served = QUERIES["served"].format(others=sql_of(other_models(connection)))
        runs, calls, costs = (QUERIES[name] for name in ("runs", "calls_by_model", "model_costs"))
        sweeps, calls, model_costs, mismatches = (
            frames.frame(connection.execute(sql)) for sql in (runs, calls, costs, served)
        )
        played = connection.execute(QUERIES["played_specs"]).fetchall()
    settings = {
        f"{driver}/{variant} ({name})": ", ".join(dict.fromkeys(_settings(json.loads(spec))))
        for driver, variant, name, spec in played
    }
    return Provenance(sweeps, calls, model_costs, mismatches, settings)


def call_counts(study: StudyResults, group: Group) -> pd.DataFrame:
    """Return the counts of each trial's calls; the table ``attempts`` explains them.

    Each reason for an invalid answer has a count, too; ``no_decision`` is not one of these.
    """
    trials = group.trials[KEYS].merge(study.frames.calls, how="left", on=KEYS)
    trials = trials.set_axis(group.trials.index).drop(columns=KEYS)
    reasons = trials.pop("failures").dropna().str.split("\n").map(Counter)
    failures = pd.DataFrame.from_dict(reasons.to_dict(), "index").reindex(trials.index)
    failures = failures.fillna(0).astype(int).sort_index(axis=1)
    return trials.join(failures).assign(
        trials=1,
        failed=group.trials["status"] == "failed",
        answers=trials["calls"] - trials["lost"],
        invalid=failures.drop(columns=NO_DECISION, errors="ignore").sum(axis=1),
    )


def tally(study: StudyResults, group: Group) -> Counter[str]:
    """Return the sums of ``call_counts`` over a group's trials."""
    return Counter({name: int(n) for name, n in call_counts(study, group).sum().items()})


def _settings(spec: Mapping[str, Any]) -> Iterator[str]:
    """Yield the settings of a driving task, and its models' parameters without prompts."""
    yield from task_settings(spec.get("scenario", {}))
    for side in SIDES:
        body = spec.get(side, {}).get("body", {})
        sent = {k: v for k, v in body.items() if k != "model" and '""' not in json.dumps(v)}
        yield from leaves(sent)
