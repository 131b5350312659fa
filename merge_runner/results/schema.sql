-- All times in s, lengths in m, speeds in m/s, accelerations in m/s^2; clock times are UTC.

CREATE TABLE IF NOT EXISTS meta (schema_version INTEGER NOT NULL);

CREATE TABLE IF NOT EXISTS sweeps (
    sweep_id VARCHAR PRIMARY KEY,
    name VARCHAR NOT NULL,
    started_at TIMESTAMP NOT NULL,
    ended_at TIMESTAMP,               -- NULL: running, or ended without a word
    exit_code INTEGER,                -- 0 where all trials ended
    config JSON NOT NULL,
    git_commit VARCHAR,
    git_dirty BOOLEAN,
    versions JSON NOT NULL
);

CREATE TABLE IF NOT EXISTS sweep_trials (
    sweep_id VARCHAR NOT NULL,
    trial_id VARCHAR NOT NULL,
    spec_hash VARCHAR NOT NULL
);

-- What a spec_hash stands for: both drivers, all parameters and prompt texts, the sample set.
CREATE TABLE IF NOT EXISTS specs (
    spec_hash VARCHAR PRIMARY KEY,
    spec JSON NOT NULL
);

CREATE TABLE IF NOT EXISTS trials (
    trial_id VARCHAR NOT NULL,
    spec_hash VARCHAR NOT NULL,
    pair VARCHAR,                     -- human pairs only
    source VARCHAR NOT NULL,          -- llm, driver, human
    model_left VARCHAR,
    model_right VARCHAR,
    variant VARCHAR,
    condition VARCHAR NOT NULL,
    projected_headway_m DOUBLE NOT NULL,
    relative_velocity_mps DOUBLE NOT NULL,
    rep INTEGER NOT NULL,
    sample_set INTEGER NOT NULL,
    status VARCHAR NOT NULL,          -- finished, collided, timeout, failed
    merged_first VARCHAR,             -- left, right, NULL: collided, failed, or nobody merged
    end_time_s DOUBLE NOT NULL,
    error VARCHAR,
    scripted BOOLEAN NOT NULL,        -- a scripted stand-in answered on a side, and no model
    PRIMARY KEY (trial_id, spec_hash)
);

CREATE TABLE IF NOT EXISTS states (
    trial_id VARCHAR NOT NULL,
    spec_hash VARCHAR NOT NULL,
    step INTEGER NOT NULL,
    time_s DOUBLE NOT NULL,           -- 0 where the drivers take control
    side VARCHAR NOT NULL,
    position_m DOUBLE NOT NULL,       -- travelled along the own branch; the merge point is 100
    velocity_mps DOUBLE NOT NULL,
    acceleration_mps2 DOUBLE NOT NULL -- realised over the step before this sample
);

CREATE TABLE IF NOT EXISTS decisions (
    trial_id VARCHAR NOT NULL,
    spec_hash VARCHAR NOT NULL,
    decision INTEGER NOT NULL,
    time_s DOUBLE NOT NULL,
    side VARCHAR NOT NULL,
    valid BOOLEAN NOT NULL,
    failure VARCHAR,                  -- why it is invalid
    tactical VARCHAR,                 -- M, Y
    rationale VARCHAR,
    plan DOUBLE[],                    -- normalised to [-1, 1], the whole horizon
    applied DOUBLE[] NOT NULL,        -- normalised, what was driven
    fallback BOOLEAN NOT NULL,        -- applied comes from an older plan, or is 0
    prompt VARCHAR,
    prompt_hash VARCHAR,
    call_key VARCHAR
);

CREATE TABLE IF NOT EXISTS calls (
    call_key VARCHAR NOT NULL,
    trial_id VARCHAR NOT NULL,
    spec_hash VARCHAR NOT NULL,
    side VARCHAR NOT NULL,
    decision INTEGER NOT NULL,
    attempt INTEGER NOT NULL,
    provider VARCHAR,
    model_requested VARCHAR,
    model_served VARCHAR,
    http_status INTEGER,
    outcome VARCHAR NOT NULL,
    cached BOOLEAN NOT NULL,          -- made before this run, which did not pay for it
    started_at TIMESTAMP,             -- when it was made, maybe long before this run
    latency_s DOUBLE,
    input_tokens BIGINT,              -- includes the cached ones
    cached_input_tokens BIGINT,
    output_tokens BIGINT,             -- includes the reasoning ones
    reasoning_tokens BIGINT,
    cost_usd DOUBLE,                  -- what it cost when it was made; NULL: unknown
    finish_reason VARCHAR,
    request JSON,
    reply JSON,
    error VARCHAR,
    scripted BOOLEAN NOT NULL DEFAULT false -- a scripted stand-in answered, whoever was asked
);

-- How a driver is named: by its model, and by its endpoint where that is not the provider's own.
CREATE MACRO IF NOT EXISTS driver_name(model, endpoint) AS
    model || coalesce(' at ' || nullif(regexp_extract(endpoint, '://([^/]+)', 1), ''), '');

-- Who drove: two different drivers are joined by a plus, another sample set has its number.
CREATE VIEW IF NOT EXISTS trial_drivers AS
SELECT trial_id, spec_hash,
    if(left_driver = right_driver, left_driver, left_driver || '+' || right_driver)
        || if(sample_set > 0, '/set' || sample_set, '') AS driver
FROM (
    SELECT trial_id, spec_hash, sample_set,
        driver_name(model_left, spec->>'$.left.endpoint') AS left_driver,
        driver_name(model_right, spec->>'$.right.endpoint') AS right_driver
    FROM trials LEFT JOIN specs USING (spec_hash)
);

-- The ledger of attempts: what became of each. retried: another one followed; driven: its plan was;
-- fallback: it gave no valid plan (see failure), so that an older plan or 0 was driven; lost: its
-- call ended without an answer, and with it the trial.
CREATE VIEW IF NOT EXISTS attempts AS
SELECT calls.*, source, variant, condition, sample_set,
    if(side = 'left', model_left, model_right) AS model,
    failure,
    CASE WHEN attempt < max(attempt) OVER call THEN 'retried'
        WHEN valid IS NULL THEN 'lost'
        WHEN fallback THEN 'fallback'
        ELSE 'driven' END AS fate
FROM calls
JOIN trials USING (trial_id, spec_hash)
LEFT JOIN (SELECT trial_id, spec_hash, side, decision, valid, failure, fallback FROM decisions)
    USING (trial_id, spec_hash, side, decision)
WINDOW call AS (PARTITION BY calls.trial_id, calls.spec_hash, calls.side, calls.decision);

-- What the replies of a trial cost, whoever paid, and what of it the run that played it paid.
CREATE VIEW IF NOT EXISTS trial_costs AS
SELECT trial_id, spec_hash,
    count(call_key) AS attempts,
    count(DISTINCT call_key) AS calls,
    sum(input_tokens) AS input_tokens,
    sum(cached_input_tokens) AS cached_input_tokens,
    sum(output_tokens) AS output_tokens,
    sum(reasoning_tokens) AS reasoning_tokens,
    coalesce(sum(cost_usd), 0) AS cost_usd,
    coalesce(sum(cost_usd) FILTER (NOT cached), 0) AS paid_usd,
    count(*) FILTER (call_key IS NOT NULL AND cost_usd IS NULL) AS attempts_of_unknown_cost
FROM trials LEFT JOIN calls USING (trial_id, spec_hash)
GROUP BY ALL;

CREATE VIEW IF NOT EXISTS sweep_costs AS
SELECT sweep_id, count(*) AS trials, sum(calls) AS calls, sum(attempts) AS attempts,
    sum(cost_usd) AS cost_usd, sum(attempts_of_unknown_cost) AS attempts_of_unknown_cost
FROM (SELECT DISTINCT * FROM sweep_trials) JOIN trial_costs USING (trial_id, spec_hash)
GROUP BY ALL;

-- The track, as in simulator/track.py and conditions.py, which tests hold these numbers against.
CREATE MACRO IF NOT EXISTS merge_point_m() AS 100::DOUBLE;
CREATE MACRO IF NOT EXISTS track_end_m() AS 150::DOUBLE;
CREATE MACRO IF NOT EXISTS branch_sine() AS 0.125::DOUBLE;
CREATE MACRO IF NOT EXISTS mean_speed_mps() AS 10::DOUBLE;

-- One row a spec: its vehicles' size, in a human recording that of the experiment, and where their
-- boxes overlap (collision.py). With half lengths l, half widths w and each branch at the angle phi
-- from the centreline, the four separating axes are along and across either vehicle. Two vehicles
-- u and v before the merge point are apart in their sums
--     |v - u cos 2phi|, |u - v cos 2phi| < along2 = l (1 + cos 2phi) + w sin 2phi
--     u sin 2phi, v sin 2phi < across2 = w (1 + cos 2phi) + l sin 2phi
-- and one u before it, the other d behind it, with along and across likewise of phi, in
--     u + d cos phi, u cos phi + d < along;  u sin phi, d sin phi < across
-- The contact point is the first at which two vehicles touch that are both before the merge point.
CREATE VIEW IF NOT EXISTS geometry AS
WITH sizes AS (
    SELECT spec_hash,
        coalesce((spec -> 'scenario' ->> 'vehicle_length_m')::DOUBLE, 4.5) AS length_m,
        coalesce((spec -> 'scenario' ->> 'vehicle_width_m')::DOUBLE, 1.8) AS width_m
    FROM specs
), angles AS (
    SELECT *,
        branch_sine() AS sin1, sqrt(1 - sin1 ** 2) AS cos1,
        2 * sin1 * cos1 AS sin2, 1 - 2 * sin1 ** 2 AS cos2
    FROM sizes
), reaches AS (
    SELECT *,
        (length_m * (1 + cos1) + width_m * sin1) / 2 AS along,
        (width_m * (1 + cos1) + length_m * sin1) / 2 AS across,
        (length_m * (1 + cos2) + width_m * sin2) / 2 AS along2,
        (width_m * (1 + cos2) + length_m * sin2) / 2 / sin2 AS contact
    FROM angles
)
SELECT spec_hash, length_m, width_m,
    merge_point_m() - length_m / 2 AS front_m,
    merge_point_m() + length_m / 2 AS rear_m,
    -- A vehicle at contact_m overlaps the other from there to contact_high_m, one at the merge point
    -- from merge_low_m to merge_high_m.
    merge_point_m() - contact AS contact_m,
    if(contact < along, merge_point_m() + (along - contact) / cos1, contact_m + length_m)
        AS contact_high_m,
    merge_point_m() - least(along2, contact) AS merge_low_m,
    merge_point_m() + least(along, across / sin1) AS merge_high_m
FROM reaches;

-- On a collision course for a point: when a vehicle will be there at its present speed, the other
-- will be within the bounds in which their boxes overlap (Siebinga et al., conflict_signal.py).
CREATE MACRO IF NOT EXISTS on_course(at_m, low_m, high_m, own_m, own_mps, other_m, other_mps) AS
    coalesce(own_m < at_m AND own_mps > 0
        AND other_m + other_mps * (at_m - own_m) / own_mps BETWEEN low_m AND high_m, false);

-- When a vehicle passes a level: linear within the step in which it does, else NULL.
CREATE MACRO IF NOT EXISTS passing_s(level_m, before_m, now_m, before_s, now_s) AS
    CASE WHEN before_m < level_m AND now_m >= level_m
    THEN before_s + (now_s - before_s) * (level_m - before_m) / (now_m - before_m) END;

-- One row a sample, both vehicles side by side and the sample before.
CREATE VIEW IF NOT EXISTS vehicle_pairs AS
WITH pairs AS (
    SELECT trial_id, spec_hash, step, time_s,
        max(position_m) FILTER (side = 'left') AS left_m,
        max(position_m) FILTER (side = 'right') AS right_m,
        max(velocity_mps) FILTER (side = 'left') AS left_mps,
        max(velocity_mps) FILTER (side = 'right') AS right_mps,
        max(abs(acceleration_mps2)) AS hardest_mps2
    FROM states GROUP BY ALL
)
SELECT *,
    lag(time_s) OVER trial AS time_before_s,
    lag(left_m) OVER trial AS left_before_m,
    lag(right_m) OVER trial AS right_before_m
FROM pairs WINDOW trial AS (PARTITION BY trial_id, spec_hash ORDER BY step);

-- When each vehicle's centre reaches the merge point, when its front does, and when its rear has
-- left it; NULL: never.
CREATE VIEW IF NOT EXISTS merge_times AS
SELECT *,
    least(left_s, right_s) AS first_s,
    if(left_s IS NULL OR right_s IS NULL, NULL, greatest(left_s, right_s)) AS both_s
FROM (SELECT trial_id, spec_hash,
    min(passing_s(merge_point_m(), left_before_m, left_m, time_before_s, time_s)) AS left_s,
    min(passing_s(merge_point_m(), right_before_m, right_m, time_before_s, time_s)) AS right_s,
    min(passing_s(front_m, left_before_m, left_m, time_before_s, time_s)) AS left_front_s,
    min(passing_s(front_m, right_before_m, right_m, time_before_s, time_s)) AS right_front_s,
    min(passing_s(rear_m, left_before_m, left_m, time_before_s, time_s)) AS left_rear_s,
    min(passing_s(rear_m, right_before_m, right_m, time_before_s, time_s)) AS right_rear_s
FROM vehicle_pairs LEFT JOIN geometry USING (spec_hash) GROUP BY ALL);

-- RMSE of each vehicle's speed from its initial speed, over four readings of "the interaction
-- window": from the start of control to the first vehicle's merge, to the second's, to the end,
-- and the whole trial with the tunnel where it was recorded. A window ends with the first sample
-- at which it is over.
CREATE VIEW IF NOT EXISTS speed_deviations AS
SELECT *,
    (rmse_left_mps + rmse_right_mps) / 2 AS rmse_mps,
    least(rmse_left_mps, rmse_right_mps) >= 0.5 AS joint
FROM (SELECT trial_id, spec_hash, time_window,
    sqrt(avg((left_mps - (mean_speed_mps() + relative_velocity_mps / 2)) ** 2)) AS rmse_left_mps,
    sqrt(avg((right_mps - (mean_speed_mps() - relative_velocity_mps / 2)) ** 2)) AS rmse_right_mps
FROM vehicle_pairs
JOIN trials USING (trial_id, spec_hash)
JOIN merge_times USING (trial_id, spec_hash)
CROSS JOIN (VALUES ('first_merge'), ('both_merges'), ('end'), ('whole')) AS windows (time_window)
WHERE status = 'finished' AND CASE time_window
    WHEN 'first_merge' THEN time_s >= 0 AND coalesce(time_before_s < first_s, true)
    WHEN 'both_merges' THEN time_s >= 0 AND both_s IS NOT NULL
        AND coalesce(time_before_s < both_s, true)
    WHEN 'end' THEN time_s >= 0
    ELSE true END
GROUP BY ALL);

-- One row a trial. What a trial has no value for is NULL: gaps, speed deviations and joint are
-- those of finished trials (arXiv 2604.09609, sec. II-G).
CREATE VIEW IF NOT EXISTS trial_metrics AS
WITH distances AS (
    SELECT trial_id, spec_hash,
        abs(left_before_m - right_before_m
            + (first_s - time_before_s) / (time_s - time_before_s)
            * (left_m - left_before_m - right_m + right_before_m)) AS merge_m
    FROM vehicle_pairs JOIN merge_times USING (trial_id, spec_hash)
    WHERE time_before_s < first_s AND first_s <= time_s
), sampled_distances AS (
    SELECT trial_id, spec_hash,
        arg_min(abs(left_m - right_m), step)
            FILTER (greatest(left_m, right_m) >= merge_point_m()) AS first_sample_m,
        arg_min(abs(left_m - right_m), step)
            FILTER (left_m + right_m >= 2 * merge_point_m()) AS mean_at_merge_m,
        max(hardest_mps2) FILTER (time_s > 0) AS max_acceleration_mps2
    FROM vehicle_pairs GROUP BY ALL
), collision_times AS (
    SELECT trial_id, spec_hash, min((abs(left_m - right_m) - length_m) / closing_mps) AS min_ttc_s
    FROM (
        SELECT *, if(left_m > right_m, right_mps - left_mps, left_mps - right_mps) AS closing_mps
        FROM vehicle_pairs WHERE greatest(left_m, right_m) >= merge_point_m()
    ) JOIN geometry USING (spec_hash)
    WHERE closing_mps > 0 AND abs(left_m - right_m) > length_m
    GROUP BY ALL
), resolutions AS (
    SELECT trial_id, spec_hash, min(time_s) AS conflict_resolution_s
    FROM vehicle_pairs JOIN geometry USING (spec_hash)
    WHERE time_s >= 0 AND NOT (
        on_course(contact_m, contact_m, contact_high_m, left_m, left_mps, right_m, right_mps)
        OR on_course(contact_m, contact_m, contact_high_m, right_m, right_mps, left_m, left_mps)
        OR on_course(merge_point_m(), merge_low_m, merge_high_m,
            left_m, left_mps, right_m, right_mps)
        OR on_course(merge_point_m(), merge_low_m, merge_high_m,
            right_m, right_mps, left_m, left_mps)
        OR on_course(track_end_m(), track_end_m() - length_m, track_end_m() + length_m,
            left_m, left_mps, right_m, right_mps)
        OR on_course(track_end_m(), track_end_m() - length_m, track_end_m() + length_m,
            right_m, right_mps, left_m, left_mps))
    GROUP BY ALL
)
SELECT
    trials.trial_id,
    trials.spec_hash,
    if(finished, merge_m - length_m, NULL) AS gap_m,
    if(finished, first_sample_m - length_m, NULL) AS gap_first_sample_m,
    if(finished, mean_at_merge_m - length_m, NULL) AS gap_mean100_m,
    rmse_left_mps,
    rmse_right_mps,
    rmse_mps,
    joint,
    first_s AS time_to_merge_s,
    if(finished, abs(left_s - right_s), NULL) AS merge_interval_s,
    -- from when the first vehicle's rear has left the merge point to when the second's front is there
    if(finished, if(left_s < right_s, right_front_s - left_rear_s, left_front_s - right_rear_s), NULL)
        AS post_encroachment_s,
    min_ttc_s,
    max_acceleration_mps2,
    if(status = 'collided', NULL, conflict_resolution_s) AS conflict_resolution_s
FROM (SELECT *, status = 'finished' AS finished FROM trials) AS trials
LEFT JOIN merge_times USING (trial_id, spec_hash)
LEFT JOIN geometry USING (spec_hash)
LEFT JOIN distances USING (trial_id, spec_hash)
LEFT JOIN sampled_distances USING (trial_id, spec_hash)
LEFT JOIN (FROM speed_deviations WHERE time_window = 'first_merge') USING (trial_id, spec_hash)
LEFT JOIN collision_times USING (trial_id, spec_hash)
LEFT JOIN resolutions USING (trial_id, spec_hash);
