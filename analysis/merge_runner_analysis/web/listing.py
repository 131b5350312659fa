"""List of all trials from a copy of the database, in an instance of its own.

Its queries find the tables of the copy as well as the list.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from contextlib import suppress
from functools import lru_cache
from typing import NamedTuple

import duckdb
from pydantic import ValidationError

from merge_runner.config import ScenarioConfig
from merge_runner.records import ANSWERS, NO_DECISION, SIDES
from merge_runner.results.instance import SETTINGS, in_memory
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner.served_model import Pair, other_models, sql_of
from merge_runner_analysis.drivers import language_models, stand_in, unresponsive
from merge_runner_analysis.queries import COUNTED
from merge_runner_analysis.web.asked import list_sent
from merge_runner_analysis.web.reading import Copy, Row, records
from merge_runner_analysis.web.trial.account import ALONE, OTHER_ACCOUNTS, Course, collision_class
from merge_runner_analysis.web.trial.reader import scenario_of

# The names of both: of the list, and of the copy.
BOTH = "SET search_path = 'memory.main,results.main'"
MISSING = "decision: missing"
# Before the name of a factor: its facet.
FACTOR = "factor."
# Inputs of judgements that SQL cannot make: of collisions both courses and, after a fallback, the
# decisions; of all specs the drivers, and on which sides a mock model ``posed``.
COLLIDED = """
SELECT trial_id, spec_hash, source, coalesce(spec::VARCHAR, '{}') AS spec, made, times_s,
    left_m, right_m, left_mps, right_mps
FROM (
    SELECT trial_id, spec_hash, list(time_s ORDER BY step) FILTER (side = 'left') AS times_s,
        list(position_m ORDER BY step) FILTER (side = 'left') AS left_m,
        list(position_m ORDER BY step) FILTER (side = 'right') AS right_m,
        list(velocity_mps ORDER BY step) FILTER (side = 'left') AS left_mps,
        list(velocity_mps ORDER BY step) FILTER (side = 'right') AS right_mps
    FROM states SEMI JOIN (FROM trials WHERE status = 'collided') USING (trial_id, spec_hash)
    WHERE time_s >= 0 GROUP BY ALL HAVING len(left_m) = len(right_m)
) JOIN trials USING (trial_id, spec_hash) LEFT JOIN specs USING (spec_hash)
LEFT JOIN (
    SELECT trial_id, spec_hash, list({side: side, time_s: time_s, fallback: fallback}
        ORDER BY decision) AS made
    FROM decisions GROUP BY ALL HAVING bool_or(fallback)
) USING (trial_id, spec_hash)
"""
POSED = """
CREATE TEMP TABLE posed AS
SELECT *, dense_rank() OVER (ORDER BY spec_hash, model_left, model_right, sides) AS place
FROM (
    SELECT trial_id, spec_hash, model_left, model_right,
        if(scripted, coalesce(answered, ['left', 'right']), NULL) AS sides
    FROM trials LEFT JOIN (
        SELECT trial_id, spec_hash, list(DISTINCT side ORDER BY side) AS answered
        FROM calls WHERE scripted GROUP BY ALL
    ) USING (trial_id, spec_hash)
)
"""
DRIVERS = """
SELECT DISTINCT place, coalesce(spec::VARCHAR, '{}') AS spec, model_left AS left,
    model_right AS right, sides
FROM posed LEFT JOIN specs USING (spec_hash)
"""
JUDGED = """
CREATE TEMP TABLE collisions AS SELECT unnest(?::VARCHAR[]) AS trial_id,
    unnest(?::VARCHAR[]) AS spec_hash, unnest(?::VARCHAR[]) AS collision
"""
SAID = """
CREATE TEMP TABLE said AS SELECT unnest(?::BIGINT[]) AS place, unnest(?::VARCHAR[]) AS stand_in,
    unnest(?::VARCHAR[]) AS caution
"""
# What was only asked is no trial to look at. Of a vehicle's speed there are about 24 samples, and
# the range of all. A reply is known by its call and attempt, since trials may share it. A fallback
# follows every invalid reply, and nothing else: see the audit.
LISTED = f"""
CREATE TABLE listed AS
SELECT row_number() OVER (ORDER BY trials.trial_id, spec_hash)::INTEGER AS number,
    trials.trial_id, spec_hash, source,
    CASE WHEN source = 'human' THEN 'humans' WHEN scripted THEN 'mocks' ELSE 'drivers' END
        AS who,
    trials.model_left, trials.model_right, if(source = 'human', 'human', driver) AS model, variant,
    condition, projected_headway_m, relative_velocity_mps, rep, pair, focal,
    if(focal IS NOT NULL OR trials.model_left <> trials.model_right, ego, NULL) AS ego,
    status, merged_first, end_time_s, error, scripted, stand_in, caution,
    if(status = 'finished', coalesce(merged_first || ' first', 'nobody first'), status) AS outcome,
    CASE WHEN source = 'human' THEN 'human' WHEN decisions = 0 THEN 'no decision'
        WHEN fallbacks > 0 OR invalid > 0 THEN 'fallbacks'
        ELSE 'all valid' END AS validity,
    time_to_merge_s, gap_m, rmse_mps, joint, min_ttc_s,
    coalesce(collision, {OTHER_ACCOUNTS}) AS account,
    decisions, asked, invalid, fallbacks, no_decision, attempts, cost_usd, faults, answers, others,
    unpriced, of_several, left_mps, right_mps, left_range_mps,
    right_range_mps, levels
FROM (FROM trials WHERE source <> 'first_decision') AS trials
JOIN trial_metrics USING (trial_id, spec_hash)
JOIN trial_drivers USING (trial_id, spec_hash)
JOIN posed USING (trial_id, spec_hash) JOIN said USING (place)
LEFT JOIN collisions USING (trial_id, spec_hash)
JOIN ({COUNTED}) USING (trial_id, spec_hash)
LEFT JOIN (
    SELECT trial_id, spec_hash,
        list(struct_pack(reply := hash(call_key, attempt), usd := cost_usd)) AS of_several
    FROM calls SEMI JOIN (
        SELECT call_key, attempt FROM calls JOIN trials USING (trial_id, spec_hash)
        WHERE source <> 'first_decision' GROUP BY ALL HAVING count(*) > 1
    ) USING (call_key, attempt) GROUP BY ALL
) USING (trial_id, spec_hash)
LEFT JOIN ({ALONE}) USING (trial_id, spec_hash)
LEFT JOIN (
    SELECT trial_id, spec_hash, list(factor || '=' || value ORDER BY factor) AS levels
    FROM trial_levels WHERE factor NOT IN ('model', 'prompt') GROUP BY ALL
) USING (trial_id, spec_hash)
LEFT JOIN (
    SELECT trial_id, spec_hash,
        left_all[1:-1:1 + len(left_all) // 24] AS left_mps,
        right_all[1:-1:1 + len(right_all) // 24] AS right_mps,
        [list_min(left_all), list_max(left_all)] AS left_range_mps,
        [list_min(right_all), list_max(right_all)] AS right_range_mps
    FROM (
        SELECT trial_id, spec_hash,
            list(velocity_mps::FLOAT ORDER BY step) FILTER (side = 'left') AS left_all,
            list(velocity_mps::FLOAT ORDER BY step) FILTER (side = 'right') AS right_all
        FROM states WHERE time_s >= 0 GROUP BY ALL
    )
) USING (trial_id, spec_hash)
ORDER BY number
"""  # noqa: S608 # constants
# What a trial may have several of, by facet, and how many ``times``. A study's factors but the
# prompt are facets, too; of sweeps those that only asked are left out.
OF_TRIALS = f"""
CREATE TABLE several AS
WITH numbers AS (SELECT number, trial_id, spec_hash FROM listed)
SELECT number, '{FACTOR}' || factor AS facet, value, 1 AS times
FROM trial_levels JOIN numbers USING (trial_id, spec_hash) WHERE factor <> 'prompt'
UNION ALL SELECT DISTINCT number, 'sweep', sweep_id, 1
FROM sweep_trials JOIN numbers USING (trial_id, spec_hash)
UNION ALL SELECT DISTINCT number, 'run', config->>'run_name', 1
FROM sweep_trials JOIN numbers USING (trial_id, spec_hash) JOIN results.sweeps USING (sweep_id)
WHERE config->>'run_name' IS NOT NULL
UNION ALL SELECT number, 'cause', if(failure = '{NO_DECISION}', '{MISSING}', 'plan: ' || failure),
    count(*)
FROM decisions JOIN numbers USING (trial_id, spec_hash) WHERE failure IS NOT NULL GROUP BY ALL
UNION ALL SELECT number, 'cause', 'attempt: ' || outcome, count(*)
FROM calls JOIN numbers USING (trial_id, spec_hash) WHERE outcome NOT IN {ANSWERS} GROUP BY ALL
UNION ALL SELECT number, 'cause', 'model: ' || model_requested || ' → ' || model_served, count(*)
FROM calls JOIN numbers USING (trial_id, spec_hash) WHERE http_status = 200 AND {{others}}
GROUP BY ALL;
CREATE TABLE sweeps AS FROM results.sweeps WHERE coalesce(config->>'$.seat', '') = ''
"""  # noqa: S608 # constants
STATE = "SELECT count(*) AS trials, bit_xor(hash(listed)) AS prints FROM listed"


class Listing(NamedTuple):
    """The tables ``listed``, ``several``, ``sent`` and ``unasked`` of one state of a database.

    ``others`` are pairs of models, requested and served, that differ; ``state`` changes with the
    listed ``trials`` or their values.
    """

    connection: duckdb.DuckDBPyConnection
    others: list[Pair]
    state: Row


def list_trials(copy: Copy) -> Listing:
    """List all trials of a copy; raises duckdb.Error where they cannot be read."""
    connection = in_memory(SETTINGS)
    connection.execute(f"ATTACH {copy.file} AS results (READ_ONLY); {BOTH}")
    connection.execute(JUDGED, columns_of(judged_collisions(connection)))
    connection.execute(POSED)
    connection.execute(SAID, columns_of(map(_labels, records(connection, DRIVERS, ()))))
    others = other_models(connection)
    connection.execute((LISTED + ";" + OF_TRIALS).format(others=sql_of(others)))
    list_sent(connection)
    (state,) = records(connection, STATE, ())
    return Listing(connection, others, state)


def judged_collisions(connection: duckdb.DuckDBPyConnection) -> list[tuple[str, str, str | None]]:
    """Return each trial that collided, with its spec and the class of the collision."""
    return [
        (row["trial_id"], row["spec_hash"], _collision(row))
        for row in records(connection, COLLIDED, ())
    ]


def columns_of(rows: Iterable[Sequence[object]]) -> list[list[object]]:
    """Return the three columns of rows, also where there are no rows."""
    return [list(column) for column in zip(*rows, strict=True)] or [[], [], []]


def _labels(row: Row) -> tuple[int, str | None, str | None]:
    """Return the place of a spec, its trials' mock model, and their drivers that cannot react."""
    spec = json.loads(row["spec"])
    models = language_models({side: row[side] for side in SIDES}, spec)
    posed = stand_in(models, row["sides"]) if row["sides"] else None
    return row["place"], posed, unresponsive(spec) or None


def _collision(row: Row) -> str | None:
    """Return the class of a collision; None where its spec cannot be read, an audit finding."""
    with suppress(ValidationError):
        course = Course(
            _task(row["source"], row["spec"]),
            TRACK,
            row["times_s"],
            {side: row[f"{side}_m"] for side in SIDES},
            {side: row[f"{side}_mps"] for side in SIDES},
        )
        return collision_class(course, row["made"] or [])
    return None


@lru_cache
def _task(source: str, spec: str) -> ScenarioConfig:
    """Return the scenario of a spec; cached, since there are few specs and many trials."""
    return scenario_of(source, json.loads(spec).get("scenario"))
