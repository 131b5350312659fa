-- All times in s, lengths in m, speeds in m/s, accelerations in m/s^2; clock times are UTC.

-- What this program needs to know of the database.
CREATE TABLE IF NOT EXISTS meta (
    schema_version INTEGER NOT NULL   -- of the tables: files of another are refused
);

-- A run of a sweep.
CREATE TABLE IF NOT EXISTS sweeps (
    sweep_id VARCHAR PRIMARY KEY,     -- its name, its drivers and when it started
    name VARCHAR NOT NULL,            -- of its file, as in experiments/NAME.toml
    started_at TIMESTAMP NOT NULL,    -- when the run began
    ended_at TIMESTAMP,               -- NULL: running, or ended without a word
    exit_code INTEGER,                -- 0: all trials ended, and none was removed since
    config JSON NOT NULL,             -- what was to be played, by whom, with which parameters
    git_commit VARCHAR,               -- of the program, or its installed version
    git_dirty BOOLEAN,                -- whether the program had uncommitted changes
    versions JSON NOT NULL            -- of Python and the packages
);

-- The trials of each run of a sweep.
CREATE TABLE IF NOT EXISTS sweep_trials (
    sweep_id VARCHAR NOT NULL,
    trial_id VARCHAR NOT NULL,
    spec_hash VARCHAR NOT NULL
);

-- What a spec_hash stands for: both drivers, all parameters and prompt texts, the sample set.
CREATE TABLE IF NOT EXISTS specs (
    spec_hash VARCHAR PRIMARY KEY,
    spec JSON NOT NULL                -- both drivers, all parameters, prompt texts, sample set
);

-- A trial.
CREATE TABLE IF NOT EXISTS trials (
    trial_id VARCHAR NOT NULL,        -- drivers/variant/condition/repetition, and the sample set
    spec_hash VARCHAR NOT NULL,       -- of what determines the result, but condition and rep
    pair VARCHAR,                     -- human pairs only
    source VARCHAR NOT NULL,          -- llm, driver, human; seat: asked without the loop
    model_left VARCHAR,               -- who drove on the left: a model of the registry or a program
    model_right VARCHAR,              -- who drove on the right
    variant VARCHAR,                  -- of the prompt
    condition VARCHAR NOT NULL,       -- of the experiment
    projected_headway_m DOUBLE NOT NULL, -- of the condition, left minus right
    relative_velocity_mps DOUBLE NOT NULL, -- of the condition, left minus right
    rep INTEGER NOT NULL,             -- the repetition, from 1
    sample_set INTEGER NOT NULL,      -- another number is a fresh set of samples
    status VARCHAR NOT NULL,          -- finished, collided, timeout, failed
    merged_first VARCHAR,             -- left, right, NULL: collided, failed, or nobody merged
    end_time_s DOUBLE NOT NULL,       -- when the trial ended
    error VARCHAR,                    -- why it failed
    scripted BOOLEAN NOT NULL,        -- a scripted stand-in answered on a side, and no model
    PRIMARY KEY (trial_id, spec_hash)
);

-- A level of a factor of a trial's study.
CREATE TABLE IF NOT EXISTS trial_factors (
    trial_id VARCHAR NOT NULL,        -- of trials
    spec_hash VARCHAR NOT NULL,       -- of trials
    factor VARCHAR NOT NULL,          -- as the study's file names it
    value VARCHAR NOT NULL            -- the level: a text as it is, anything else as JSON
);

-- A vehicle at a sample.
CREATE TABLE IF NOT EXISTS states (
    trial_id VARCHAR NOT NULL,
    spec_hash VARCHAR NOT NULL,
    step INTEGER NOT NULL,            -- of the simulation, 0 where the drivers take control
    time_s DOUBLE NOT NULL,           -- 0 where the drivers take control
    side VARCHAR NOT NULL,            -- left, right
    position_m DOUBLE NOT NULL,       -- travelled along the own branch; see geometry
    velocity_mps DOUBLE NOT NULL,     -- along the own branch
    acceleration_mps2 DOUBLE NOT NULL -- realised over the step before this sample
);

-- A driver at a decision instant.
CREATE TABLE IF NOT EXISTS decisions (
    trial_id VARCHAR NOT NULL,
    spec_hash VARCHAR NOT NULL,
    decision INTEGER NOT NULL,        -- counts those of this driver from 0
    time_s DOUBLE NOT NULL,
    side VARCHAR NOT NULL,
    valid BOOLEAN NOT NULL,           -- whether the reply holds a plan
    failure VARCHAR,                  -- why it is invalid
    tactical VARCHAR,                 -- M, Y
    rationale VARCHAR,                -- the reason in the reply
    plan DOUBLE[],                    -- normalised to [-1, 1], the whole horizon
    applied DOUBLE[] NOT NULL,        -- normalised, what was driven
    fallback BOOLEAN NOT NULL,        -- applied comes from an older plan, or is 0
    prompt VARCHAR,                   -- the situation as the driver was told it
    prompt_hash VARCHAR,              -- SHA-256 of the prompt
    call_key VARCHAR,                 -- leads to the call; NULL: a program decided
    other_seen BOOLEAN,               -- whether it saw the other; NULL: it was told the truth
    told_own_position_m DOUBLE,       -- what it was told; NULL: the truth
    told_own_speed_mps DOUBLE,        -- what it was told; NULL: the truth
    told_distance_m DOUBLE,           -- how far ahead the other is, it was told; NULL: not seen
    told_other_speed_mps DOUBLE,      -- what it was told; NULL: the truth, or not seen
    told_other_acceleration_mps2 DOUBLE, -- what programs were told; NULL as above
    told_other_speeds_mps DOUBLE[]    -- the history that it was told; NULL as above
);

-- An attempt at a call.
CREATE TABLE IF NOT EXISTS calls (
    call_key VARCHAR NOT NULL,        -- a hash of the request and its slot among the samples
    trial_id VARCHAR NOT NULL,
    spec_hash VARCHAR NOT NULL,
    side VARCHAR NOT NULL,
    decision INTEGER NOT NULL,
    attempt INTEGER NOT NULL,         -- counts those at this call from 1
    provider VARCHAR,                 -- whose format was spoken
    model_requested VARCHAR,          -- the id that was asked for
    model_served VARCHAR,             -- the id that the reply names
    http_status INTEGER,              -- NULL: no reply came
    outcome VARCHAR NOT NULL,         -- ok, refusal, truncated, empty, unknown, or why it failed
    cached BOOLEAN NOT NULL,          -- made before this run, which did not pay for it
    started_at TIMESTAMP,             -- when it was made, maybe long before this run
    latency_s DOUBLE,                 -- from the request to the end of the reply
    input_tokens BIGINT,              -- includes the cached ones
    cached_input_tokens BIGINT,       -- read from the provider's cache
    output_tokens BIGINT,             -- includes the reasoning ones
    reasoning_tokens BIGINT,          -- of which the reply shows nothing
    cost_usd DOUBLE,                  -- what it cost when it was made; NULL: unknown
    finish_reason VARCHAR,            -- as the provider says it
    request JSON,                     -- the body that was sent
    reply JSON,                       -- the body that came
    error VARCHAR,
    scripted BOOLEAN NOT NULL DEFAULT false, -- a scripted stand-in answered, whoever was asked
    batch_id VARCHAR                  -- the provider's batch that it was a line of; NULL: of none
);

-- A human's first action, decoded from the published page by its user; the pair is not known.
CREATE TABLE IF NOT EXISTS human_first_actions (
    trial INTEGER NOT NULL,           -- counts the trials of the page from 1
    side VARCHAR NOT NULL,            -- left, right
    relative_velocity_mps DOUBLE NOT NULL, -- of the trial's condition, left minus right
    merged_first VARCHAR,             -- left, right, NULL: collided
    first_mps2 DOUBLE NOT NULL,       -- net acceleration at the first sample under control
    PRIMARY KEY (trial, side)
);

-- How a driver is named: by its model, and by its endpoint where that is not the provider's own.
CREATE MACRO IF NOT EXISTS driver_name(model, endpoint) AS
    model || coalesce(' at ' || nullif(regexp_extract(endpoint, '://([^/]+)', 1), ''), '');

-- What was so beside what a driver with imperfect perception was told, for each of its decisions.
CREATE VIEW IF NOT EXISTS perceptions AS
SELECT trial_id, spec_hash, decision, decisions.time_s, decisions.side, other_seen,
    -- how far ahead the other was
    other.position_m - own.position_m AS distance_m,
    told_distance_m,
    -- how fast the other was
    other.velocity_mps AS other_speed_mps,
    told_other_speed_mps,
    -- where the own vehicle was
    own.position_m AS own_position_m,
    told_own_position_m,
    -- how fast the own vehicle was
    own.velocity_mps AS own_speed_mps,
    told_own_speed_mps
FROM decisions
JOIN states AS own USING (trial_id, spec_hash, time_s, side)
JOIN states AS other USING (trial_id, spec_hash, step)
WHERE other_seen IS NOT NULL AND other.side <> own.side;

-- Who drove: two different drivers are joined by a plus, the ego first, whichever side it sat on;
-- another sample set has its number, and so has each level of a study's factors but the prompt and
-- the opponent, which are named already.
CREATE VIEW IF NOT EXISTS trial_drivers AS
SELECT trial_id, spec_hash,
    -- the model, with its endpoint if that is not the provider's own
    CASE WHEN left_driver = right_driver THEN left_driver
        WHEN ego = 'left' THEN left_driver || '+' || right_driver
        ELSE right_driver || '+' || left_driver END
        || CASE WHEN sample_set > 0 THEN '/set' || sample_set ELSE '' END
        || coalesce(' [' || levels || ']', '') AS driver,
    -- the side of the driver that is named first, whose odds are told: of two different ones that
    -- which its study does not call the opponent, else a language model before a program, else the
    -- first in the alphabet; of two equal ones, and of humans, the left one
    ego
FROM (
    SELECT trial_id, spec_hash, sample_set, levels,
        driver_name(model_left, spec->>'$.left.endpoint') AS left_driver,
        driver_name(model_right, spec->>'$.right.endpoint') AS right_driver,
        (spec->'$.left.body') IS NOT NULL AS left_asks,
        (spec->'$.right.body') IS NOT NULL AS right_asks,
        CASE WHEN opponent = model_right THEN 'left'
            WHEN opponent = model_left THEN 'right'
            WHEN model_left = model_right THEN 'left'
            WHEN left_asks AND NOT right_asks THEN 'left'
            WHEN right_asks AND NOT left_asks THEN 'right'
            WHEN model_left > model_right THEN 'right' ELSE 'left' END AS ego
    FROM trials LEFT JOIN specs USING (spec_hash) LEFT JOIN (
        SELECT trial_id, spec_hash, max(value) FILTER (factor = 'opponent') AS opponent,
            string_agg(factor || '=' || value, ', ' ORDER BY factor)
                FILTER (factor NOT IN ('prompt', 'opponent')) AS levels
        FROM trial_factors GROUP BY ALL
    ) USING (trial_id, spec_hash)
);

-- The ledger of attempts: what became of each. retried: another one followed; driven: its plan was;
-- fallback: it gave no valid plan (see failure), so that an older plan or 0 was driven; lost: its
-- call ended without an answer, and with it the trial.
CREATE VIEW IF NOT EXISTS attempts AS
SELECT calls.*, source, variant, condition, sample_set,
    -- who was asked: a model of the registry
    CASE side WHEN 'left' THEN model_left ELSE model_right END AS model,
    failure,
    -- retried, driven, fallback or lost: see the view
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
    -- how many attempts there were
    count(call_key) AS attempts,
    -- how many calls there were
    count(DISTINCT call_key) AS calls,
    sum(input_tokens) AS input_tokens,
    sum(cached_input_tokens) AS cached_input_tokens,
    sum(output_tokens) AS output_tokens,
    sum(reasoning_tokens) AS reasoning_tokens,
    -- what the replies cost when they were made, whoever paid
    coalesce(sum(cost_usd), 0) AS cost_usd,
    -- the part paid by the run that played the trial
    coalesce(sum(cost_usd) FILTER (NOT cached), 0) AS paid_usd,
    -- how many of the attempts have no known cost
    count(*) FILTER (call_key IS NOT NULL AND cost_usd IS NULL) AS attempts_of_unknown_cost
FROM trials LEFT JOIN calls USING (trial_id, spec_hash)
GROUP BY ALL;

-- The sums of trial_costs over the trials of a sweep.
CREATE VIEW IF NOT EXISTS sweep_costs AS
SELECT sweep_id,
    -- how many trials the sweep has
    count(*) AS trials,
    sum(calls) AS calls, sum(attempts) AS attempts,
    sum(cost_usd) AS cost_usd, sum(attempts_of_unknown_cost) AS attempts_of_unknown_cost
FROM (SELECT DISTINCT * FROM sweep_trials) JOIN trial_costs USING (trial_id, spec_hash)
GROUP BY ALL;
