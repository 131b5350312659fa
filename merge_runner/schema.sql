-- All times in s, lengths in m, speeds in m/s, accelerations in m/s^2; clock times are UTC.

CREATE TABLE IF NOT EXISTS meta (schema_version INTEGER NOT NULL);

CREATE TABLE IF NOT EXISTS sweeps (
    sweep_id VARCHAR PRIMARY KEY,
    name VARCHAR NOT NULL,
    started_at TIMESTAMP NOT NULL,
    ended_at TIMESTAMP,               -- NULL: running, or ended without a word
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
    scripted BOOLEAN NOT NULL,        -- the emulator drives on a side: a stand-in, no model
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
    cached BOOLEAN NOT NULL,          -- the sweep found the reply recorded
    latency_s DOUBLE,
    input_tokens BIGINT,              -- includes the cached ones
    cached_input_tokens BIGINT,
    output_tokens BIGINT,             -- includes the reasoning ones
    reasoning_tokens BIGINT,
    cost_usd DOUBLE,                  -- what it cost when it was made; NULL: unknown
    finish_reason VARCHAR,
    request JSON,
    reply JSON,
    error VARCHAR
);

-- One row a trial. The merge instants are interpolated within the step; what a trial has no value
-- for is NULL: gaps, RMSE and joint are those of finished trials (arXiv 2604.09609, sec. II-G).
CREATE VIEW IF NOT EXISTS trial_metrics AS
WITH pairs AS (
    SELECT trial_id, spec_hash, step, time_s,
        max(position_m) FILTER (side = 'left') AS left_m,
        max(position_m) FILTER (side = 'right') AS right_m,
        max(velocity_mps) FILTER (side = 'left') AS left_mps,
        max(velocity_mps) FILTER (side = 'right') AS right_mps
    FROM states GROUP BY ALL
), steps AS (
    SELECT *,
        lag(time_s) OVER trial AS time_before_s,
        lag(left_m) OVER trial AS left_before_m,
        lag(right_m) OVER trial AS right_before_m
    FROM pairs WINDOW trial AS (PARTITION BY trial_id, spec_hash ORDER BY step)
), merges AS (
    SELECT trial_id, spec_hash,
        min(time_before_s + (time_s - time_before_s) * (100 - left_before_m)
            / (left_m - left_before_m)) FILTER (left_before_m < 100 AND left_m >= 100) AS left_s,
        min(time_before_s + (time_s - time_before_s) * (100 - right_before_m)
            / (right_m - right_before_m)) FILTER (right_before_m < 100 AND right_m >= 100) AS right_s
    FROM steps GROUP BY ALL
), firsts AS (
    SELECT *, least(left_s, right_s) AS first_s FROM merges
), gaps AS (
    SELECT trial_id, spec_hash,
        abs(left_before_m - right_before_m
            + (first_s - time_before_s) / (time_s - time_before_s)
            * (left_m - left_before_m - right_m + right_before_m)) AS headway_m
    FROM steps JOIN firsts USING (trial_id, spec_hash)
    WHERE time_before_s < first_s AND first_s <= time_s
), means AS (
    SELECT trial_id, spec_hash, arg_min(abs(left_m - right_m), step) AS headway_m
    FROM pairs WHERE left_m + right_m >= 200 GROUP BY ALL
), deviations AS (
    SELECT trial_id, spec_hash,
        sqrt(avg((left_mps - (10 + relative_velocity_mps / 2)) ** 2)) AS left_mps,
        sqrt(avg((right_mps - (10 - relative_velocity_mps / 2)) ** 2)) AS right_mps
    FROM steps
    JOIN trials USING (trial_id, spec_hash)
    JOIN firsts USING (trial_id, spec_hash)
    -- from the start of control to the first sample at which a vehicle has reached the merge point
    WHERE time_s >= 0 AND coalesce(time_before_s < first_s, true)
    GROUP BY ALL
), collision_times AS (
    SELECT trial_id, spec_hash,
        min((abs(left_m - right_m) - 4.5) / closing_mps) AS seconds
    FROM (
        SELECT *, if(left_m > right_m, right_mps - left_mps, left_mps - right_mps) AS closing_mps
        FROM pairs WHERE greatest(left_m, right_m) >= 100
    )
    WHERE closing_mps > 0 AND abs(left_m - right_m) > 4.5
    GROUP BY ALL
)
SELECT
    trials.trial_id,
    trials.spec_hash,
    if(status = 'finished', gaps.headway_m - 4.5, NULL) AS gap_m,
    if(status = 'finished', means.headway_m - 4.5, NULL) AS gap_mean100_m,
    if(status = 'finished', deviations.left_mps, NULL) AS rmse_left_mps,
    if(status = 'finished', deviations.right_mps, NULL) AS rmse_right_mps,
    (rmse_left_mps + rmse_right_mps) / 2 AS rmse_mps,
    least(rmse_left_mps, rmse_right_mps) >= 0.5 AS joint,
    if(status = 'finished', abs(left_s - right_s), NULL) AS post_encroachment_s,
    collision_times.seconds AS min_ttc_s,
    first_s AS time_to_merge_s
FROM trials
LEFT JOIN firsts USING (trial_id, spec_hash)
LEFT JOIN gaps USING (trial_id, spec_hash)
LEFT JOIN means USING (trial_id, spec_hash)
LEFT JOIN deviations USING (trial_id, spec_hash)
LEFT JOIN collision_times USING (trial_id, spec_hash);
