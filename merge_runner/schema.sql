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
    cost_usd DOUBLE,                  -- 0 for a recorded reply; NULL: unknown
    finish_reason VARCHAR,
    request JSON,
    reply JSON,
    error VARCHAR
);
