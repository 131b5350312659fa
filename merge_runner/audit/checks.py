"""What must hold of every trial, as queries for what does not: trial_id, side, decision, text.

They read the tables of a database, or of calls alone those that recordings.py makes, and the
temporary ones that sweeps.py makes: ``audited`` (the trials), ``rules`` (numbers of a spec's
scenario and track), ``paces`` (when the driver of a spec's side decides), ``drivers`` (per spec and
side the endpoint and the body of an empty request, NULL for a program), ``sweep_models`` (what a
sweep calls its models) and ``other_models`` (who answered in place of whom).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import duckdb

from merge_runner.audit.findings import Finding

# What a trial's row repeats of its states agrees with them.
OUTCOMES = """
WITH driven AS (
    SELECT trial_id, spec_hash, max(step) AS last_step, count(*) AS samples,
        count(DISTINCT (step, side)) AS places, max(time_s) AS end_s, max(position_m) AS far_m,
        min(step) FILTER (side = 'left' AND position_m >= merge_point_m) AS left_step,
        min(step) FILTER (side = 'right' AND position_m >= merge_point_m) AS right_step
    FROM states SEMI JOIN audited USING (trial_id, spec_hash) JOIN rules USING (spec_hash)
    GROUP BY ALL
), judged AS (
    SELECT trial_id, CASE
        WHEN samples IS NULL THEN 'it has no states'
        WHEN samples <> 2 * (last_step + 1) OR places <> samples
            THEN format('it has {} states in {} steps of two vehicles', samples, last_step + 1)
        WHEN abs(end_time_s - end_s) > 1e-6
            THEN format('it ended after {} s, its states after {} s', end_time_s, end_s)
        WHEN status = 'failed' AND error IS NULL THEN 'it failed and names no reason'
        WHEN status = 'finished' AND far_m < end_m
            THEN 'it is finished, and nobody has reached the end of the track'
        WHEN status IN ('timeout', 'failed') AND far_m >= end_m
            THEN format('it is {}, and a vehicle has reached the end of the track', status)
        WHEN status = 'timeout' AND last_step <> timeout_steps
            THEN format('its time was over after {} of {} steps', last_step, timeout_steps)
        WHEN status IN ('collided', 'failed') THEN
            if(merged_first IS NULL, NULL, format('it is {}, and has a first merger', status))
        WHEN left_step IS NULL AND right_step IS NULL THEN
            if(merged_first IS NULL, NULL, 'nobody merged, and it has a first merger')
        WHEN merged_first IS NULL THEN 'a vehicle merged, and it has no first merger'
        -- Who was first within one step depends on exact instants, which are not derived here.
        WHEN left_step = right_step THEN NULL
        WHEN merged_first <> if(right_step IS NULL OR left_step < right_step, 'left', 'right')
            THEN format('{} merged first by its row, and not by its states', merged_first)
        END AS text
    FROM audited JOIN rules USING (spec_hash) LEFT JOIN driven USING (trial_id, spec_hash)
)
SELECT trial_id, NULL AS side, NULL AS decision, text FROM judged WHERE text IS NOT NULL
"""

# Every driver in control decides once per interval until the trial ends. The last interval of a
# failed trial was not driven: one side may have decided in it.
NUMBERS = """
WITH last_steps AS (
    SELECT trial_id, spec_hash, max(step) AS last_step FROM states
    SEMI JOIN audited USING (trial_id, spec_hash) GROUP BY ALL
), implied AS (
    SELECT trial_id, spec_hash, side, step // interval_steps AS decision, time_s AS due_s
    FROM states JOIN last_steps USING (trial_id, spec_hash) JOIN paces USING (spec_hash, side)
    JOIN rules USING (spec_hash)
    WHERE step % interval_steps = 0 AND step < last_step AND position_m > tunnel_exit_m - 1e-9
), made AS (
    SELECT trial_id, spec_hash, side, decision, count(*) AS times, min(time_s) AS at_s
    FROM decisions SEMI JOIN audited USING (trial_id, spec_hash) GROUP BY ALL
), compared AS (
    SELECT trial_id, side, decision, CASE
        WHEN times IS NULL THEN 'it is missing: the driver was in control'
        WHEN times > 1 THEN format('it is stored {} times', times)
        WHEN due_s IS NULL AND NOT (status = 'failed' AND decision * interval_steps = last_step)
            THEN 'nothing was to be decided: the trial was over, or the driver not in control'
        WHEN abs(at_s - due_s) > 1e-6
            THEN format('it was due at {} s and made at {} s', due_s, at_s)
        END AS text
    FROM implied FULL JOIN made USING (trial_id, spec_hash, side, decision)
    JOIN audited USING (trial_id, spec_hash)
    JOIN paces USING (spec_hash, side)
    LEFT JOIN last_steps USING (trial_id, spec_hash)
)
SELECT trial_id, side, decision, text FROM compared WHERE text IS NOT NULL
"""  # constants

# After an invalid reply the last valid plan goes on where it was left or, by the other rule, at
# its first action; 0 where it is exhausted or there is none (drivers/language_model.py).
PLANS = """
WITH numbered AS (
    SELECT *, row_number() OVER (
        PARTITION BY trial_id, spec_hash, side ORDER BY decision) AS place
    FROM decisions SEMI JOIN audited USING (trial_id, spec_hash) JOIN rules USING (spec_hash)
    JOIN paces USING (spec_hash, side)
), older AS (
    SELECT *,
        last_value(if(valid, plan, NULL) IGNORE NULLS) OVER before AS older_plan,
        max(place) FILTER (valid) OVER before AS older_place
    FROM numbered WINDOW before AS (
        PARTITION BY trial_id, spec_hash, side ORDER BY place
        ROWS BETWEEN UNBOUNDED PRECEDING AND 1 PRECEDING)
), due AS (
    SELECT *, if(valid OR restarts, 0, (place - coalesce(older_place, place)) * executed) AS gone,
        if(valid, plan, coalesce(older_plan, []::DOUBLE[])) AS driven
    FROM older
), judged AS (
    SELECT trial_id, side, decision, CASE
        WHEN valid AND plan IS NULL THEN 'it is valid and has no plan'
        WHEN valid AND failure IS NOT NULL THEN format('it is valid and failed: {}', failure)
        WHEN valid AND fallback THEN 'it is valid and marked as a fallback'
        WHEN valid AND len(plan) <> plan_actions
            THEN format('its plan has {} actions of {}', len(plan), plan_actions)
        WHEN NOT valid AND plan IS NOT NULL THEN 'it is invalid and has a plan'
        WHEN NOT valid AND failure IS NULL THEN 'it is invalid and names no failure'
        WHEN NOT valid AND NOT fallback THEN 'it is invalid and not marked as a fallback'
        WHEN applied <> list_resize(driven[gone + 1 : gone + executed], executed, 0.0::DOUBLE)
            THEN if(valid, 'other actions were driven than the first of its plan',
                'other actions were driven than the fallback rule gives')
        END AS text
    FROM due
)
SELECT trial_id, side, decision, text FROM judged WHERE text IS NOT NULL
"""

# A trial that failed ended in the middle of a decision, which may have attempts and no row.
CALLS = """
WITH called AS (
    SELECT trial_id, spec_hash, side, decision, call_key, max_by(outcome, attempt) AS outcome
    FROM calls SEMI JOIN audited USING (trial_id, spec_hash) GROUP BY ALL
), judged AS (
    SELECT d.trial_id, d.side, d.decision, CASE
        WHEN d.call_key IS NULL AND NOT (fallback AND failure IS NOT NULL)
            THEN 'it has neither a call nor a named failure'
        WHEN d.call_key IS NULL THEN NULL
        WHEN outcome IS NULL THEN 'its call is not stored'
        WHEN outcome NOT IN ('ok', 'refusal', 'truncated', 'empty')
            THEN format('its call has no answer: {}', outcome)
        WHEN outcome <> 'ok' AND failure IS DISTINCT FROM outcome
            THEN format('its answer is named {}, the decision says {}',
                outcome, coalesce(failure, 'valid'))
        END AS text
    FROM decisions AS d SEMI JOIN audited USING (trial_id, spec_hash)
    JOIN drivers ON drivers.spec_hash = d.spec_hash AND drivers.side = d.side
    LEFT JOIN called ON called.trial_id = d.trial_id AND called.spec_hash = d.spec_hash
        AND called.side = d.side AND called.decision = d.decision
        AND called.call_key = d.call_key
    WHERE body IS NOT NULL
)
SELECT trial_id, side, decision, text FROM judged WHERE text IS NOT NULL
UNION ALL
SELECT trial_id, side, decision, 'it was called for, and there is no such decision'
FROM called JOIN audited USING (trial_id, spec_hash)
ANTI JOIN decisions USING (trial_id, spec_hash, side, decision)
WHERE status <> 'failed'
"""

# An empty answer may be asked for again (llm/consequences.py); any other is the last attempt.
ATTEMPTS = """
WITH numbered AS (
    SELECT trial_id, side, decision, list(attempt ORDER BY attempt) AS numbers,
        min(call_key) <> max(call_key) AS several_keys,
        min(hash(request)) <> max(hash(request)) AS several_requests,
        min(attempt) FILTER (outcome IN ('ok', 'refusal', 'truncated')) < max(attempt) AS early
    FROM calls SEMI JOIN audited USING (trial_id, spec_hash)
    GROUP BY trial_id, spec_hash, side, decision
), judged AS (
    SELECT trial_id, side, decision, CASE
        WHEN several_keys THEN 'its attempts are of several calls'
        WHEN numbers <> range(1, len(numbers) + 1)
            THEN format('its attempts are numbered {}', numbers::VARCHAR)
        WHEN several_requests THEN 'its attempts hold different requests'
        WHEN early THEN 'an answer was followed by another attempt'
        END AS text
    FROM numbered
)
SELECT trial_id, side, decision, text FROM judged WHERE text IS NOT NULL
"""

MODELS = """
SELECT trial_id, side, min(decision), format(
    '{} attempts asked for {} of {}, the sweep names {} of {}',
    count(*), model_requested, calls.provider, id, sweep_models.provider)
FROM calls JOIN audited USING (trial_id, spec_hash)
JOIN sweep_models ON name = if(side = 'left', model_left, model_right)
WHERE model_requested IS DISTINCT FROM id OR calls.provider IS DISTINCT FROM sweep_models.provider
GROUP BY trial_id, side, model_requested, calls.provider, id, sweep_models.provider
"""

# One finding for each pair of models, at its first answer.
SERVED = """
SELECT min_by(trial_id, place), min_by(side, place), min_by(decision, place),
    format('{} -> {}: another model answered than was asked for ({} answers)',
        model_requested, model_served, count(*))
FROM (
    SELECT *, (trial_id, decision, side) AS place
    FROM calls SEMI JOIN audited USING (trial_id, spec_hash)
    SEMI JOIN other_models USING (model_requested, model_served) WHERE http_status = 200
)
GROUP BY model_requested, model_served
"""

# The spec holds the body of a request with an empty prompt: with the prompt cut out they are equal.
REQUESTS = """
WITH asked AS (
    SELECT trial_id, spec_hash, side, decision, request::VARCHAR AS request,
        to_json(prompt)::VARCHAR AS prompt
    FROM decisions SEMI JOIN audited USING (trial_id, spec_hash)
    JOIN calls USING (trial_id, spec_hash, side, decision, call_key)
    WHERE attempt = 1 AND prompt IS NOT NULL
)
SELECT trial_id, side, decision, if(contains(request, prompt),
    'its request is, but for the prompt, another than the spec says',
    'its request holds another prompt than the decision')
FROM asked JOIN drivers USING (spec_hash, side)
WHERE replace(request, prompt, '""') IS DISTINCT FROM body
"""

# Kind of finding to the query for it.
CHECKS = {
    "outcome": OUTCOMES,
    "numbering": NUMBERS,
    "plan": PLANS,
    "call": CALLS,
    "attempt": ATTEMPTS,
    "model": MODELS,
    "served": SERVED,
    "request": REQUESTS,
}


def run_checks(
    connection: duckdb.DuckDBPyConnection, kinds: Iterable[str] = tuple(CHECKS)
) -> Iterator[Finding]:
    """What these checks find."""
    for kind in kinds:
        rows = connection.execute(f"{CHECKS[kind]} ORDER BY ALL").fetchall()
        for trial_id, side, decision, text in rows:
            yield Finding(kind, text, trial=trial_id, side=side, decision=decision)
