-- Facts of a sweep's summary. Each block is a query by name; they read the tables of checks.sql.

-- tables: the trials of the sweep in the variable sweep_id.
CREATE OR REPLACE TEMP TABLE played AS
FROM trials SEMI JOIN (FROM sweep_trials WHERE sweep_id = getvariable('sweep_id'))
    USING (trial_id, spec_hash);

-- outcomes: numbers of trials by status.
SELECT status, count(*) AS trials FROM played GROUP BY ALL ORDER BY ALL;

-- levels: outcomes by condition, in total, and by level of each factor.
SELECT factor, value AS level, count(*) AS trials,
    count(*) FILTER (status = 'finished' AND merged_first = 'left') AS "left first",
    count(*) FILTER (status = 'finished' AND merged_first = 'right') AS "right first",
    count(*) FILTER (status = 'collided') AS collided,
    count(*) FILTER (status = 'timeout') AS timeout,
    count(*) FILTER (status = 'failed') AS failed
FROM played JOIN (
    SELECT trial_id, spec_hash, 'condition' AS factor, unnest([condition, 'all']) AS value
    FROM played
    UNION ALL SELECT trial_id, spec_hash, factor, value FROM trial_levels
) USING (trial_id, spec_hash)
GROUP BY ALL ORDER BY ALL;

-- failed: why each of them did.
SELECT trial_id, error FROM played WHERE status = 'failed' ORDER BY ALL;

-- others: replies of another model than requested.
SELECT model_requested, model_served, count(*) AS answers FROM calls
SEMI JOIN played USING (trial_id, spec_hash) SEMI JOIN other_models USING (model_requested, model_served)
WHERE http_status = 200 GROUP BY ALL ORDER BY ALL;

-- stand_ins: drivers with replies of a mock model: these replies, and all replies.
SELECT driver_name(model, spec->>('$.' || side || '.endpoint')) AS driver, model, provider,
    count(*) FILTER (attempts.scripted) AS scripted, count(*) AS answers
FROM attempts LEFT JOIN specs USING (spec_hash) SEMI JOIN played USING (trial_id, spec_hash)
WHERE fate IN ('driven', 'fallback')
GROUP BY ALL HAVING bool_or(attempts.scripted) ORDER BY ALL;

-- same_prompts: variants with identical trials of mock models, which read nothing that differs.
WITH driven AS (
    SELECT trial_id, spec_hash, sum(hash(step, side, position_m)) AS trace
    FROM states SEMI JOIN (
        FROM played WHERE scripted AND status <> 'failed'
            AND (SELECT count(DISTINCT variant) FROM played) > 1
    ) USING (trial_id, spec_hash)
    GROUP BY ALL
), prompts AS (
    SELECT variant,
        list_sort(list(DISTINCT (model_left, model_right, condition, rep, sample_set, trace)))
            AS trials
    FROM played JOIN driven USING (trial_id, spec_hash) GROUP BY variant
)
SELECT list(variant ORDER BY variant) AS variants
FROM prompts GROUP BY trials HAVING count(*) > 1 ORDER BY ALL;

-- decided: numbers of decisions; and by the names of other blocks, whether these may have a row: to
-- plan them takes longer.
FROM (SELECT count(*) AS decisions, count(*) FILTER (NOT valid) AS invalid,
        count(*) FILTER (fallback) AS fallbacks,
        count(*) FILTER (failure = 'no_decision') AS no_decision
    FROM decisions SEMI JOIN played USING (trial_id, spec_hash)),
    (SELECT coalesce(bool_or(status = 'failed'), false) AS failed,
        coalesce(bool_or(source = 'first_decision'), false) AS first_looks,
        coalesce(bool_or(scripted) AND min(variant) < max(variant), false) AS same_prompts
    FROM played),
    (SELECT count(*) > 0 AS others FROM other_models);

-- first_looks: first decisions without the closed loop. The velocity is the driver's minus the other's.
-- The action is the net acceleration over the first step, for an invalid reply the fallback's. The
-- share of M is that among replies with a tactical decision.
WITH asked AS (FROM played WHERE source = 'first_decision' AND status <> 'failed')
SELECT driver, variant, if(side = 'left', model_left, model_right) AS model, side,
    if(side = 'left', 1, -1) * relative_velocity_mps + 0 AS relative_velocity_mps,
    count(*) AS asked, count(*) FILTER (NOT valid) AS invalid,
    count(tactical) AS with_a_word,
    count(*) FILTER (tactical = 'M') / nullif(count(tactical), 0) AS share_m,
    avg(action_mps2) FILTER (valid) AS first_action_mps2
FROM asked
JOIN (FROM decisions WHERE decision = 0) USING (trial_id, spec_hash)
JOIN (
    SELECT trial_id, spec_hash, side, min_by(acceleration_mps2, step) AS action_mps2
    FROM states SEMI JOIN asked USING (trial_id, spec_hash) WHERE time_s > 0 GROUP BY ALL
) USING (trial_id, spec_hash, side)
JOIN drivers USING (trial_id, spec_hash)
GROUP BY ALL ORDER BY ALL;
