"""Where the results come from: sweeps, specs, and what the calls came to."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from analysis.load import load
from merge_runner.config import Scenario, load_models

SWEEPS = """
SELECT sweep_id, name, started_at, ended_at, git_commit, git_dirty, versions,
    count(trial_id) AS trials
FROM sweeps LEFT JOIN sweep_trials USING (sweep_id)
GROUP BY ALL ORDER BY started_at, sweep_id
"""
# Of each call the last attempt is the answer; those before it are retries.
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
        * REPLACE (max(model_served) OVER (PARTITION BY call_key) AS model_served)
    FROM calls
)
GROUP BY provider, model_requested, model_served ORDER BY ALL
"""
SPECS = """
SELECT DISTINCT split_part(trial_id, '/', 1) AS driver, variant, spec_hash, spec
FROM specs JOIN trials USING (spec_hash) WHERE source <> 'human' ORDER BY ALL
"""
DECISIONS = """
SELECT split_part(trial_id, '/', 1) AS driver, trials.spec_hash, variant, count(*) AS decisions,
    count(*) FILTER (NOT valid) AS invalid, count(*) FILTER (fallback) AS fallbacks
FROM decisions JOIN trials USING (trial_id, spec_hash) GROUP BY ALL ORDER BY ALL
"""


@dataclass(frozen=True, slots=True)
class Provenance:
    """What the report says about the origin of its numbers.

    ``sweeps``, ``calls`` and ``decisions`` are rows of the queries here; ``switches`` holds, by
    driver, variant and spec_hash, the settings of the driving task that differ from the defaults;
    ``mismatches`` says where another model answered than was asked for.
    """

    sweeps: pd.DataFrame
    calls: pd.DataFrame
    decisions: pd.DataFrame
    switches: dict[str, str]
    mismatches: list[str]


def provenance(db: Path) -> Provenance:
    """Read the origin of a database's results."""
    calls = load(CALLS, db)
    return Provenance(
        sweeps=load(SWEEPS, db),
        calls=calls,
        decisions=load(DECISIONS, db),
        switches=_switches(db),
        mismatches=_mismatches(calls),
    )


def _switches(db: Path) -> dict[str, str]:
    defaults = Scenario().model_dump()
    found = {}
    for row in load(SPECS, db).itertuples():
        scenario = json.loads(row.spec).get("scenario", {})
        changed = [f"{name} = {v}" for name, v in scenario.items() if defaults.get(name) != v]
        found[f"{row.driver}/{row.variant} ({row.spec_hash})"] = ", ".join(changed) or "defaults"
    return found


def _mismatches(calls: pd.DataFrame) -> list[str]:
    accepted: dict[str, set[str]] = {}
    for entry in load_models().values():
        accepted.setdefault(entry.id, set()).update({entry.id, *entry.aliases})
    return [
        f"{row.model_served} answered {row.calls} calls that asked for {row.model_requested}"
        for row in calls.itertuples()
        if isinstance(row.model_served, str)
        and row.model_served not in accepted.get(row.model_requested, {row.model_requested})
    ]
