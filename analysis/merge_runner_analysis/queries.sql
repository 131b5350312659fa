-- Queries of results by name: each block is one, and braces hold what the program fills in.

-- trials: one row per trial, as its ego sees it (see ``trial_drivers``). A trial whose ego sat on
-- the right is mirrored: "left" is the ego everywhere, headway and relative velocity are the ego's
-- minus the other's, and the condition is the one with these numbers. If no condition has them,
-- its name is that of the driven one and the word mirrored.
WITH placed AS (
    SELECT trials.*, driver, ego, ego = 'right' AS turned,
        (spec->>'$.mean_speed_mps')::DOUBLE AS mean_mps
    FROM trials JOIN trial_drivers USING (trial_id, spec_hash) LEFT JOIN specs USING (spec_hash)
), known (image, headway_m, velocity_mps, mean_mps, own) AS (
    SELECT *, NULL::DOUBLE, false FROM (VALUES {published})
    UNION SELECT condition, projected_headway_m, relative_velocity_mps, mean_mps, true FROM placed
), images AS (
    SELECT headway_m, velocity_mps, mean_mps, arg_min(image, (own, image)) AS image
    FROM known GROUP BY ALL
)
SELECT placed.* EXCLUDE (driver, ego, turned, mean_mps) REPLACE (
        if(turned, coalesce(image, condition || ' mirrored'), condition) AS condition,
        if(turned, 0 - projected_headway_m, projected_headway_m) AS projected_headway_m,
        if(turned, 0 - relative_velocity_mps, relative_velocity_mps) AS relative_velocity_mps,
        if(turned, model_right, model_left) AS model_left,
        if(turned, model_left, model_right) AS model_right,
        if(turned, CASE merged_first WHEN 'left' THEN 'right' WHEN 'right' THEN 'left' END,
            merged_first) AS merged_first
    ), driver,
    coalesce(if(turned, right_scripted, left_scripted), false) AS left_scripted,
    coalesce(if(turned, left_scripted, right_scripted), false) AS right_scripted,
    trial_metrics.* EXCLUDE (trial_id, spec_hash) REPLACE (
        if(turned, rmse_right_mps, rmse_left_mps) AS rmse_left_mps,
        if(turned, rmse_left_mps, rmse_right_mps) AS rmse_right_mps
    ), ego, cost_usd,
    CASE WHEN model_left = model_right THEN left_replies + right_replies
        WHEN turned THEN right_replies ELSE left_replies END AS replies,
    CASE WHEN model_left = model_right THEN left_valid + right_valid
        WHEN turned THEN right_valid ELSE left_valid END AS valid_replies
FROM placed JOIN trial_metrics USING (trial_id, spec_hash)
LEFT JOIN (
    SELECT trial_id, spec_hash, bool_or(scripted AND side = 'left') AS left_scripted,
        bool_or(scripted AND side = 'right') AS right_scripted,
        if(count(*) = count(cost_usd), sum(cost_usd), NULL) AS cost_usd
    FROM calls GROUP BY ALL
) USING (trial_id, spec_hash)
LEFT JOIN (
    SELECT trial_id, spec_hash, count(*) FILTER (side = 'left') AS left_replies,
        count(*) FILTER (side = 'right') AS right_replies,
        count(*) FILTER (side = 'left' AND valid) AS left_valid,
        count(*) FILTER (side = 'right' AND valid) AS right_valid
    FROM decisions WHERE call_key IS NOT NULL GROUP BY ALL
) USING (trial_id, spec_hash)
LEFT JOIN images ON turned AND headway_m = 0 - projected_headway_m
    AND velocity_mps = 0 - relative_velocity_mps
    AND images.mean_mps IS NOT DISTINCT FROM placed.mean_mps
ORDER BY trial_id, spec_hash

-- traces: hashes of each driven trial that ended: its states as its ego sees them and as they are,
-- with the other determinants of its outcome and its gap. Equal ones went the same way.
SELECT trial_id, spec_hash, concat_ws(' ', seen, beside) AS trace, concat_ws(' ', driven, beside)
    AS drive
FROM (
    SELECT trial_id, spec_hash, sum(hash(step, if(side = ego, 'left', 'right'), position_m,
        velocity_mps)) AS seen, sum(hash(step, side, position_m, velocity_mps)) AS driven
    FROM states JOIN trial_drivers USING (trial_id, spec_hash) GROUP BY ALL
) JOIN (
    SELECT trial_id, spec_hash, concat_ws(' ', status, spec->>'$.scenario.vehicle_length_m',
        spec->>'$.scenario.vehicle_width_m') AS beside
    FROM trials LEFT JOIN specs USING (spec_hash) WHERE source <> 'human' AND status <> 'failed'
) USING (trial_id, spec_hash)

-- speeds: one row a vehicle: its speeds under control, and whether the simulator slowed it by
-- itself. It cruises until its first decision; humans' decisions are not on record.
SELECT trial_id, spec_hash, side, list(time_s ORDER BY step) AS time_s,
    list(velocity_mps ORDER BY step) AS velocity_mps,
    any_value(resisted) AS resisted
FROM states JOIN (
    SELECT spec_hash,
        coalesce(spec->>'$.source', spec->>'$.scenario.resistance', '') = 'human'
        AS resisted FROM specs
) USING (spec_hash) LEFT JOIN (
    SELECT trial_id, spec_hash, side, min(time_s) AS first_s FROM decisions GROUP BY ALL
) USING (trial_id, spec_hash, side)
WHERE time_s >= greatest(0, coalesce(first_s, 0)) GROUP BY ALL ORDER BY ALL

-- specs: specs of trials, those of the newest run first.
SELECT spec_hash, spec FROM specs JOIN trials USING (spec_hash)
LEFT JOIN sweep_trials USING (trial_id, spec_hash) LEFT JOIN sweeps USING (sweep_id)
GROUP BY ALL ORDER BY max(started_at) DESC NULLS LAST, spec_hash

-- sweeps: the newest run comes first: the order of its levels counts.
SELECT sweep_id, name, coalesce('-' || nullif(config->>'$.seat', ''), '') AS suffix,
    coalesce(config->'$.levels', '{}') AS levels, config->>'$.run_name' AS run_name,
    config->>'$.study.text' AS text
FROM sweeps ORDER BY started_at DESC, sweep_id

-- near: samples at or next to which boxes can overlap: with centres closer in the plane than the
-- diagonal of a box and the way that they can come nearer within a step.
SELECT trial_id, spec_hash,
    list((step, time_s, left_m, left_mps, right_m, right_mps) ORDER BY step) AS near
FROM (
    SELECT *, left_m - merge_m AS left_past_m, right_m - merge_m AS right_past_m,
        sine * (least(left_past_m, 0) + least(right_past_m, 0)) AS across_m,
        if(left_past_m < 0, cosine * left_past_m, left_past_m)
            - if(right_past_m < 0, cosine * right_past_m, right_past_m) AS along_m,
        {step_s} * (abs(left_mps - right_mps) + sine * (left_mps + right_mps)) AS nearer_m
    FROM (SELECT *, merge_point_m() AS merge_m, branch_sine() AS sine, sqrt(1 - sine ** 2) AS cosine
        FROM vehicle_pairs WHERE spec_hash IN ({specs}))
) WHERE across_m ** 2 + along_m ** 2 < ({reach_m} + nearer_m) ** 2 GROUP BY ALL

-- counted_calls: one row a trial. A call is asked at one decision, in attempts from 1 on; the last
-- one is its answer, which a lost call has not; ``faults`` are attempts without one. ``answers``
-- are replies, ``others`` come from another model, as the condition on a row of calls has it that
-- stands for it. ``failures`` has in lines what each answer lacks, a valid plan or the decision
-- asked for.
SELECT trial_id, spec_hash,
    coalesce(decisions, 0) AS decisions, coalesce(asked, 0) AS asked,
    coalesce(invalid, 0) AS invalid, coalesce(fallbacks, 0) AS fallbacks,
    coalesce(no_decision, 0) AS no_decision, failures,
    coalesce(attempts, 0) AS attempts, coalesce(calls, 0) AS calls,
    coalesce(retried, 0) AS retried, greatest(coalesce(calls - coalesce(asked, 0), 0), 0) AS lost,
    coalesce(faults, 0) AS faults, coalesce(unknown, 0) AS unknown,
    coalesce(answers, 0) AS answers, coalesce(others, 0) AS others,
    coalesce(unpriced, 0) AS unpriced, cost_usd
FROM trials LEFT JOIN (
    SELECT trial_id, spec_hash, count(*) AS decisions, count(call_key) AS asked,
        count(*) FILTER (NOT valid) AS invalid, count(*) FILTER (fallback) AS fallbacks,
        count(*) FILTER (failure = '{no_decision}') AS no_decision,
        string_agg(failure, chr(10)) AS failures
    FROM decisions GROUP BY ALL
) USING (trial_id, spec_hash) LEFT JOIN (
    SELECT trial_id, spec_hash, count(*) AS attempts, count(*) FILTER (attempt = 1) AS calls,
        count(*) FILTER (attempt > 1) AS retried,
        count(*) FILTER (outcome NOT IN {answers}) AS faults,
        count(*) FILTER (outcome = 'unknown') AS unknown,
        count(*) FILTER (http_status = 200) AS answers,
        count(*) FILTER (http_status = 200 AND {others}) AS others,
        count(*) FILTER (cost_usd IS NULL) AS unpriced, sum(cost_usd) AS cost_usd
    FROM calls GROUP BY ALL
) USING (trial_id, spec_hash)

-- first_actions: one row a vehicle: the acceleration of the first step that its driver controls,
-- and the word of the first decision. Where each driver takes control at its own exit the other
-- one cruises yet: that is no first action.
SELECT trial_id, spec_hash, if(side = ego, 'left', 'right') AS side, first_mps2, tactical
FROM (
    SELECT trial_id, spec_hash, side, arg_min(acceleration_mps2, step) AS first_mps2
    FROM states WHERE time_s > 0 GROUP BY ALL
) JOIN trial_drivers USING (trial_id, spec_hash)
LEFT JOIN (FROM decisions WHERE decision = 0) USING (trial_id, spec_hash, side)
ANTI JOIN (FROM specs WHERE spec->>'$.scenario.control_start' = 'own_exit') USING (spec_hash)
ORDER BY ALL

-- runs: each run with the number of its trials.
SELECT sweep_id, name, started_at, ended_at, git_commit, git_dirty, versions,
    count(trial_id) AS trials
FROM sweeps LEFT JOIN sweep_trials USING (sweep_id)
GROUP BY ALL ORDER BY started_at, sweep_id

-- calls_by_model: the last attempt of each call is the answer; those before it are retries.
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

-- played_specs: specs by driver and prompt variant, without humans and first-decision probes.
SELECT DISTINCT driver, variant, spec_hash, spec
FROM specs JOIN trials USING (spec_hash) JOIN trial_drivers USING (trial_id, spec_hash)
WHERE source NOT IN ('human', 'first_decision') ORDER BY ALL

-- served: answers by each other model than was asked for.
SELECT model_requested AS requested, model_served AS served,
    count(DISTINCT (trial_id, spec_hash, side, decision, attempt)) AS answers,
    coalesce(string_agg(DISTINCT sweep_id, ', ' ORDER BY sweep_id), 'unknown') AS sweeps
FROM calls LEFT JOIN sweep_trials USING (trial_id, spec_hash)
WHERE http_status = 200 AND {others}
GROUP BY ALL ORDER BY ALL

-- model_costs: calls, tokens and costs of each driver.
SELECT driver, count(*) AS trials,
    sum(calls) AS calls, sum(attempts) AS attempts,
    sum(input_tokens) AS input_tokens, sum(cached_input_tokens) AS cached_input_tokens,
    sum(output_tokens) AS output_tokens, sum(reasoning_tokens) AS reasoning_tokens,
    sum(cost_usd) AS cost_usd, sum(paid_usd) AS paid_usd,
    sum(attempts_of_unknown_cost) AS attempts_of_unknown_cost
FROM trials JOIN trial_costs USING (trial_id, spec_hash)
JOIN trial_drivers USING (trial_id, spec_hash)
WHERE source <> 'human' GROUP BY ALL ORDER BY ALL
