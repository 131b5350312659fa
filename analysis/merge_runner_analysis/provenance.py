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
from merge_runner_analysis.study import StudyResults
from merge_runner_analysis.task import leaves, task_settings

SWEEPS = """
SELECT sweep_id, name, started_at, ended_at, git_commit, git_dirty, versions,
    count(trial_id) AS trials
FROM sweeps LEFT JOIN sweep_trials USING (sweep_id)
GROUP BY ALL ORDER BY started_at, sweep_id
"""
# The last attempt of each call is the answer; those before it are retries.
CALLS = """
SELECT provider, model_requested, model_served,
    count(DISTINCT call_key) AS calls,
    count(*) FILTER (attempt > 1) AS retries,
    count(*) FILTER (outcome = 'refusal') AS refusals,
    count(*) FILTER (outcome = 'truncated') AS truncated,
    count(*) FILTER (outcome = 'empty') AS empty,
    sum(input_tokens) AS input_tokens,
    sum(output_tokens) AS output_tokens,
    sum(cost_usd) AS cost_usd,
    count(*) FILTER (cost_usd IS NULL AND http_status = 200) AS unpriced,
    min(started_at)::DATE AS first_day,
    max(started_at)::DATE AS last_day
-- A recorded call that several trials use was made once.
FROM (
    SELECT DISTINCT ON (call_key, attempt)
        * EXCLUDE (request, reply, error)
        REPLACE (max(model_served) OVER (PARTITION BY call_key) AS model_served)
    FROM calls
)
GROUP BY provider, model_requested, model_served ORDER BY ALL
"""
SPECS = """
SELECT DISTINCT driver, variant, spec_hash, spec
FROM specs JOIN trials USING (spec_hash) JOIN trial_drivers USING (trial_id, spec_hash)
WHERE source NOT IN ('human', 'first_decision') ORDER BY ALL
"""
# Answers by each other model than was asked for.
SERVED = """
SELECT model_requested AS requested, model_served AS served,
    count(DISTINCT (trial_id, spec_hash, side, decision, attempt)) AS answers,
    coalesce(string_agg(DISTINCT sweep_id, ', ' ORDER BY sweep_id), 'unknown') AS sweeps
FROM calls LEFT JOIN sweep_trials USING (trial_id, spec_hash)
WHERE http_status = 200 AND {others}
GROUP BY ALL ORDER BY ALL
"""
MODEL_COSTS = """
SELECT driver, count(*) AS trials,
    sum(calls) AS calls, sum(attempts) AS attempts,
    sum(input_tokens) AS input_tokens, sum(cached_input_tokens) AS cached_input_tokens,
    sum(output_tokens) AS output_tokens, sum(reasoning_tokens) AS reasoning_tokens,
    sum(cost_usd) AS cost_usd, sum(paid_usd) AS paid_usd,
    sum(attempts_of_unknown_cost) AS attempts_of_unknown_cost
FROM trials JOIN trial_costs USING (trial_id, spec_hash)
JOIN trial_drivers USING (trial_id, spec_hash)
WHERE source <> 'human' GROUP BY ALL ORDER BY ALL
"""


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
        served = SERVED.format(others=sql_of(other_models(connection)))
        sweeps, calls, model_costs, mismatches = (
            frames.frame(connection.execute(sql)) for sql in (SWEEPS, CALLS, MODEL_COSTS, served)
        )
        played = connection.execute(SPECS).fetchall()
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
