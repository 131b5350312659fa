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
    position_m DOUBLE NOT NULL,       -- travelled along the own branch; see geometry
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
    left_driver
        || CASE WHEN left_driver <> right_driver THEN '+' || right_driver ELSE '' END
        || CASE WHEN sample_set > 0 THEN '/set' || sample_set ELSE '' END AS driver
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
    CASE side WHEN 'left' THEN model_left ELSE model_right END AS model,
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
