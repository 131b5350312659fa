"""Where the results come from: sweeps, specs, what the calls came to, and what they cost."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import duckdb
import pandas as pd

from merge_runner.audit.checks import make_views
from merge_runner.config import ScenarioConfig
from merge_runner.records import SIDES
from merge_runner.results import frames
from merge_runner.results.database import read_database
from merge_runner.served_model import other_models, sql_of
from merge_runner_analysis.data.load import ANSWERED, load_specs
from merge_runner_analysis.data.study import Group, Study, of_trials

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
        * EXCLUDE (request, reply, error)
        REPLACE (max(model_served) OVER (PARTITION BY call_key) AS model_served)
    FROM calls
)
GROUP BY provider, model_requested, model_served ORDER BY ALL
"""
SPECS = """
SELECT DISTINCT driver, variant, spec_hash
FROM specs JOIN trials USING (spec_hash) JOIN trial_drivers USING (trial_id, spec_hash)
WHERE source NOT IN ('human', 'seat') ORDER BY ALL
"""
# Answers by each other model than was asked for.
SERVED = """
SELECT model_requested AS requested, model_served AS served,
    count(DISTINCT (trial_id, spec_hash, side, decision)) AS answers,
    coalesce(string_agg(DISTINCT sweep_id, ', ' ORDER BY sweep_id), 'unknown') AS sweeps
FROM attempts LEFT JOIN sweep_trials USING (trial_id, spec_hash)
WHERE fate IN {answered} AND {others}
GROUP BY ALL ORDER BY ALL
"""
SWEEP_COSTS = """
SELECT sweep_id, name, sweep_costs.* EXCLUDE (sweep_id)
FROM sweeps JOIN sweep_costs USING (sweep_id) ORDER BY started_at, sweep_id
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
# Trials that are looked through for answers that repeat each other, of a driver at a time.
OF_DRIVER = """
CREATE OR REPLACE TEMP TABLE audited AS
SELECT trial_id, spec_hash FROM trials JOIN trial_drivers USING (trial_id, spec_hash)
WHERE driver = ? AND NOT scripted
"""
DRIVERS = """
SELECT DISTINCT driver FROM trials JOIN trial_drivers USING (trial_id, spec_hash)
WHERE source = 'llm' AND NOT scripted ORDER BY ALL
"""


@dataclass(frozen=True, slots=True)
class Provenance:
    """What the report says about the origin of its numbers.

    ``sweeps``, ``calls``, ``sweep_costs``, ``model_costs`` and ``mismatches`` are rows of the
    queries here. By driver, variant and spec_hash ``switches`` holds the settings of the driving
    task that differ from the defaults, and by spec_hash and side ``sent`` what was sent to the
    models beside the prompt. ``alike`` has the drivers all of whose answers to a prompt that was
    asked before are word for word as before, with their number.
    """

    sweeps: pd.DataFrame
    calls: pd.DataFrame
    sweep_costs: pd.DataFrame
    model_costs: pd.DataFrame
    mismatches: pd.DataFrame
    switches: dict[str, str]
    alike: dict[str, int]
    sent: dict[str, dict[str, dict[str, object]]]


def provenance(db: Path) -> Provenance:
    """Read the origin of a database's results."""
    with read_database(db) as connection:
        others = sql_of(other_models(connection))
        queries = {
            "sweeps": SWEEPS,
            "calls": CALLS,
            "sweep_costs": SWEEP_COSTS,
            "model_costs": MODEL_COSTS,
            "mismatches": SERVED.format(answered=ANSWERED, others=others),
        }
        found = {name: frames.frame(connection.execute(sql)) for name, sql in queries.items()}
        played = connection.execute(SPECS).fetchall()
        alike = _alike(connection)
    specs = load_specs(db)
    switches = {
        f"{driver}/{variant} ({name})": _switched(specs[name]) or "defaults"
        for driver, variant, name in played
    }
    sent = {name: _sent(specs[name]) for *_, name in played}
    return Provenance(**found, switches=switches, alike=alike, sent=sent)


def tally(study: Study, group: Group) -> Counter[str]:
    """Count a group's trials, calls, attempts, decisions, and what went wrong with them.

    A call is asked at one decision, in one or more attempts. ``retried`` attempts were followed by
    another, ``lost`` calls ended without an answer; of the ``answers``, ``invalid`` ones have no
    valid plan, for a reason that has a count of its own, too. ``fallback`` counts the ``decisions``
    that were driven from an older plan, or none.
    """
    trials = of_trials(study.calls.trials, group.trials)
    counts = {name: int(trials[name].sum()) for name in trials.select_dtypes("number")}
    failures = Counter("\n".join(trials["failures"].dropna()).splitlines())
    return Counter(
        dict(failures)
        | counts
        | {
            "trials": len(group.trials),
            "failed": len(group.trials) - len(group.ended),
            "answers": counts["calls"] - counts["lost"],
            "invalid": failures.total(),
        }
    )


def _switched(spec: Mapping[str, Any]) -> str:
    """The settings of a spec's driving task that differ from the defaults."""
    defaults, scenario = ScenarioConfig().model_dump(), spec.get("scenario", {})
    return ", ".join(f"{name} = {v}" for name, v in scenario.items() if defaults.get(name) != v)


def _alike(connection: duckdb.DuckDBPyConnection) -> dict[str, int]:
    make_views(connection)
    found = {}
    for (driver,) in connection.execute(DRIVERS).fetchall():
        connection.execute(OF_DRIVER, [driver])
        ((found[driver],),) = connection.execute("FROM alike").fetchall()
    return {driver: repeated for driver, repeated in found.items() if repeated}


def _sent(spec: Mapping[str, Any]) -> dict[str, dict[str, object]]:
    """The parameters of the model on each side of a spec, by the last part of their names.

    A program on a side has none, and is left out. A spec is made with an empty prompt, by which
    that is known in any format.
    """
    bodies = {side: spec[side]["body"] for side in SIDES if "body" in spec.get(side, {})}
    return {
        side: dict(
            _leaves({k: v for k, v in body.items() if k != "model" and '""' not in json.dumps(v)})
        )
        for side, body in bodies.items()
    }


def _leaves(values: Mapping[str, Any]) -> Iterator[tuple[str, object]]:
    for name, value in values.items():
        yield from _leaves(value) if isinstance(value, dict) else [(name, value)]
