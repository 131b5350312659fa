-- All times in s, lengths in m, speeds in m/s, accelerations in m/s^2; clock times are UTC.
-- A column without a comment has the meaning of the first column with its name.

CREATE TABLE meta (
    schema_version INTEGER NOT NULL
);
COMMENT ON TABLE meta IS 'Facts about the database itself.';
COMMENT ON COLUMN meta.schema_version IS 'version of the tables; a file of another version is '
    'refused';

CREATE TABLE sweeps (
    sweep_id VARCHAR PRIMARY KEY,
    name VARCHAR NOT NULL,
    started_at TIMESTAMP NOT NULL,
    ended_at TIMESTAMP,
    exit_code INTEGER,
    config JSON NOT NULL,
    git_commit VARCHAR,
    git_dirty BOOLEAN,
    versions JSON NOT NULL
);
COMMENT ON TABLE sweeps IS 'One row per run of a sweep.';
COMMENT ON COLUMN sweeps.sweep_id IS 'name, drivers and start time of the run';
COMMENT ON COLUMN sweeps.name IS 'name of its file, as in experiments/NAME.toml';
COMMENT ON COLUMN sweeps.started_at IS 'start of the run';
COMMENT ON COLUMN sweeps.ended_at IS 'end of the run; NULL: running, or killed';
COMMENT ON COLUMN sweeps.exit_code IS '0: all trials ended, and none was removed since';
COMMENT ON COLUMN sweeps.config IS 'plan: trials, drivers, parameters';
COMMENT ON COLUMN sweeps.git_commit IS 'commit of the program''s checkout; without one, its '
    'installed version';
COMMENT ON COLUMN sweeps.git_dirty IS 'whether the checkout had uncommitted changes; NULL: '
    'installed version';
COMMENT ON COLUMN sweeps.versions IS 'versions of Python and the packages';

CREATE TABLE sweep_trials (
    sweep_id VARCHAR NOT NULL,
    trial_id VARCHAR NOT NULL,
    spec_hash VARCHAR NOT NULL
);
COMMENT ON TABLE sweep_trials IS 'One row per trial of a run of a sweep.';

CREATE TABLE specs (
    spec_hash VARCHAR PRIMARY KEY,
    spec JSON NOT NULL
);
COMMENT ON TABLE specs IS 'One row per spec_hash: both drivers, all parameters, prompt texts, '
    'sample set.';
COMMENT ON COLUMN specs.spec IS 'both drivers, all parameters, prompt texts, sample set; of a '
    'program also its revision, its own rate, the program that it is based_on, and the hash of '
    'the data that it drives by';

CREATE TABLE trials (
    trial_id VARCHAR NOT NULL,
    spec_hash VARCHAR NOT NULL,
    pair VARCHAR,
    source VARCHAR NOT NULL,
    model_left VARCHAR,
    model_right VARCHAR,
    variant VARCHAR,
    condition VARCHAR NOT NULL,
    projected_headway_m DOUBLE NOT NULL,
    relative_velocity_mps DOUBLE NOT NULL,
    rep INTEGER NOT NULL,
    sample_set INTEGER NOT NULL,
    status VARCHAR NOT NULL,
    merged_first VARCHAR,
    end_time_s DOUBLE NOT NULL,
    error VARCHAR,
    scripted BOOLEAN NOT NULL,
    focal VARCHAR,
    PRIMARY KEY (trial_id, spec_hash)
);
COMMENT ON TABLE trials IS 'One row per trial. One trial_id may occur with two specs: join and '
    'group by (trial_id, spec_hash).';
COMMENT ON COLUMN trials.trial_id IS 'drivers/prompt/condition/repetition, then the sample set '
    'unless it is 0, levels of factors, and focal=SIDE unless focal is NULL; a first decision''s '
    'begins with seat/, a human trial''s is human/pair/condition/iteration';
COMMENT ON COLUMN trials.spec_hash IS 'hash of all that determines the result, except condition '
    'and rep';
COMMENT ON COLUMN trials.pair IS 'the human pair; NULL: no human trial';
COMMENT ON COLUMN trials.source IS 'llm, driver, human; first_decision: the first decisions '
    'alone, without the closed loop';
COMMENT ON COLUMN trials.model_left IS 'left driver: a model of the registry or a program';
COMMENT ON COLUMN trials.model_right IS 'right driver';
COMMENT ON COLUMN trials.variant IS 'prompt variant, with its levels of text factors';
COMMENT ON COLUMN trials.condition IS 'initial condition, such as L_4_-8';
COMMENT ON COLUMN trials.projected_headway_m IS 'projected headway of the condition, left minus '
    'right';
COMMENT ON COLUMN trials.relative_velocity_mps IS 'relative velocity of the condition, left minus '
    'right';
COMMENT ON COLUMN trials.rep IS 'repetition, from 1';
COMMENT ON COLUMN trials.sample_set IS 'number of the sample set; another number asks anew';
COMMENT ON COLUMN trials.status IS 'finished, collided, timeout, failed; a collision by the rule '
    'of the scenario, of humans by boxes at 20 Hz';
COMMENT ON COLUMN trials.merged_first IS 'left, right; NULL: collided, failed, or nobody merged';
COMMENT ON COLUMN trials.end_time_s IS 'end of the trial';
COMMENT ON COLUMN trials.error IS 'why it failed';
COMMENT ON COLUMN trials.scripted IS 'whether a mock model answered on either side, whatever '
    'model was requested';
COMMENT ON COLUMN trials.focal IS 'left, right: side of the ego, if the two drivers have '
    'different texts, parameters or perceptions; NULL: they have the same';

CREATE TABLE trial_factors (
    trial_id VARCHAR NOT NULL,
    spec_hash VARCHAR NOT NULL,
    factor VARCHAR NOT NULL,
    value VARCHAR NOT NULL,
    words BOOLEAN NOT NULL
);
COMMENT ON TABLE trial_factors IS 'One row per trial and factor of its study.';
COMMENT ON COLUMN trial_factors.trial_id IS 'as in trials';
COMMENT ON COLUMN trial_factors.spec_hash IS 'as in trials';
COMMENT ON COLUMN trial_factors.factor IS 'name in the study''s file';
COMMENT ON COLUMN trial_factors.value IS 'level: a text as it is, anything else as JSON';
COMMENT ON COLUMN trial_factors.words IS 'whether it is a text factor, whose level the variant '
    'names';

CREATE TABLE states (
    trial_id VARCHAR NOT NULL,
    spec_hash VARCHAR NOT NULL,
    step INTEGER NOT NULL,
    time_s DOUBLE NOT NULL,
    side VARCHAR NOT NULL,
    position_m DOUBLE NOT NULL,
    velocity_mps DOUBLE NOT NULL,
    acceleration_mps2 DOUBLE NOT NULL
);
COMMENT ON TABLE states IS 'One row per vehicle and sample.';
COMMENT ON COLUMN states.step IS 'step of the simulation; 0 at the start of control';
COMMENT ON COLUMN states.time_s IS '0 at the start of control';
COMMENT ON COLUMN states.side IS 'left, right';
COMMENT ON COLUMN states.position_m IS 'distance travelled along the own branch: tunnel exit 50, '
    'merge point 100, end 150';
COMMENT ON COLUMN states.velocity_mps IS 'speed along the own branch';
COMMENT ON COLUMN states.acceleration_mps2 IS 'realised acceleration over the step before the '
    'sample';

CREATE TABLE decisions (
    trial_id VARCHAR NOT NULL,
    spec_hash VARCHAR NOT NULL,
    decision INTEGER NOT NULL,
    time_s DOUBLE NOT NULL,
    side VARCHAR NOT NULL,
    valid BOOLEAN NOT NULL,
    failure VARCHAR,
    tactical VARCHAR,
    rationale VARCHAR,
    plan DOUBLE[],
    applied DOUBLE[] NOT NULL,
    fallback BOOLEAN NOT NULL,
    prompt VARCHAR,
    prompt_hash VARCHAR,
    call_key VARCHAR,
    other_seen BOOLEAN,
    perceived_own_position_m DOUBLE,
    perceived_own_speed_mps DOUBLE,
    perceived_distance_m DOUBLE,
    perceived_other_speed_mps DOUBLE,
    perceived_other_acceleration_mps2 DOUBLE,
    perceived_other_speeds_mps DOUBLE[]
);
COMMENT ON TABLE decisions IS 'One row per driver and decision instant.';
COMMENT ON COLUMN decisions.decision IS 'number of the instant at this driver''s rate, 0 at the '
    'start of control; a driver that leaves its tunnel later (control_start = "own_exit") begins '
    'with a higher number';
COMMENT ON COLUMN decisions.valid IS 'whether the reply holds a valid plan';
COMMENT ON COLUMN decisions.failure IS 'why the plan is invalid; no_decision: the plan is valid, '
    'but the requested tactical decision is missing';
COMMENT ON COLUMN decisions.tactical IS 'M (merge), Y (yield)';
COMMENT ON COLUMN decisions.rationale IS 'reason in the reply';
COMMENT ON COLUMN decisions.plan IS 'whole plan, normalised to [-1, 1] (times 2.5 m/s^2); a '
    'model''s actions have plan_step_s, a program''s step_s';
COMMENT ON COLUMN decisions.applied IS 'normalised actions that were driven';
COMMENT ON COLUMN decisions.fallback IS 'whether applied comes from an older plan, or is 0';
COMMENT ON COLUMN decisions.prompt IS 'situation as the driver observed it, in words';
COMMENT ON COLUMN decisions.prompt_hash IS 'SHA-256 of the prompt';
COMMENT ON COLUMN decisions.call_key IS 'key in calls; NULL: a program decided';
COMMENT ON COLUMN decisions.other_seen IS 'whether the other vehicle was seen; NULL: perfect '
    'perception';
COMMENT ON COLUMN decisions.perceived_own_position_m IS 'observed value; NULL: the true one';
COMMENT ON COLUMN decisions.perceived_own_speed_mps IS 'observed value; NULL: the true one';
COMMENT ON COLUMN decisions.perceived_distance_m IS 'observed distance to the other vehicle, ahead '
    'positive; NULL: not seen, or the true one';
COMMENT ON COLUMN decisions.perceived_other_speed_mps IS 'observed value; NULL: not seen, or the true '
    'one';
COMMENT ON COLUMN decisions.perceived_other_acceleration_mps2 IS 'value that programs observed; NULL: '
    'not seen, or the true one';
COMMENT ON COLUMN decisions.perceived_other_speeds_mps IS 'observed history; NULL: not seen, or the '
    'true one';

CREATE TABLE calls (
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
    cached BOOLEAN NOT NULL,
    started_at TIMESTAMP,
    latency_s DOUBLE,
    input_tokens BIGINT,
    cached_input_tokens BIGINT,
    output_tokens BIGINT,
    reasoning_tokens BIGINT,
    cost_usd DOUBLE,
    finish_reason VARCHAR,
    request JSON,
    reply JSON,
    error VARCHAR,
    scripted BOOLEAN NOT NULL,
    batch_id VARCHAR
);
COMMENT ON TABLE calls IS 'One row per HTTP attempt at a call.';
COMMENT ON COLUMN calls.call_key IS 'hash of the request and its slot';
COMMENT ON COLUMN calls.attempt IS 'number of the attempt at this call, from 1';
COMMENT ON COLUMN calls.provider IS 'provider, as the registry names it';
COMMENT ON COLUMN calls.model_requested IS 'requested model id';
COMMENT ON COLUMN calls.model_served IS 'model id that the reply names';
COMMENT ON COLUMN calls.http_status IS 'NULL: no reply';
COMMENT ON COLUMN calls.outcome IS 'ok, refusal, truncated, empty; unknown: the run was killed '
    'before the reply; else the reason of the failure';
COMMENT ON COLUMN calls.cached IS 'whether the attempt was made before this run, or for another '
    'trial of it';
COMMENT ON COLUMN calls.started_at IS 'when it was made (a batch: when that was submitted), maybe '
    'long before this run';
COMMENT ON COLUMN calls.latency_s IS 'from the request to the end of the reply; NULL in a batch';
COMMENT ON COLUMN calls.input_tokens IS 'cached ones included';
COMMENT ON COLUMN calls.cached_input_tokens IS 'read from the provider''s cache';
COMMENT ON COLUMN calls.output_tokens IS 'reasoning ones included';
COMMENT ON COLUMN calls.reasoning_tokens IS 'tokens that the reply does not show';
COMMENT ON COLUMN calls.cost_usd IS 'cost at the prices of started_at; NULL: unknown';
COMMENT ON COLUMN calls.finish_reason IS 'as the provider says it';
COMMENT ON COLUMN calls.request IS 'body that was sent';
COMMENT ON COLUMN calls.reply IS 'body that was received';
COMMENT ON COLUMN calls.scripted IS 'whether a mock model answered, whatever model was requested';
COMMENT ON COLUMN calls.batch_id IS 'provider''s batch of the request; NULL: sent alone';

-- Name of a driver: its model, with its endpoint unless that is the provider's own.
CREATE MACRO driver_name(model, endpoint) AS
    model || coalesce(' at ' || nullif(regexp_extract(endpoint, '://([^/]+)', 1), ''), '');

CREATE VIEW perceptions AS
SELECT trial_id, spec_hash, decision, decisions.time_s, decisions.side, other_seen,
    other.position_m - own.position_m AS distance_m,
    perceived_distance_m,
    other.velocity_mps AS other_speed_mps,
    perceived_other_speed_mps,
    own.position_m AS own_position_m,
    perceived_own_position_m,
    own.velocity_mps AS own_speed_mps,
    perceived_own_speed_mps
FROM decisions
JOIN states AS own USING (trial_id, spec_hash, time_s, side)
JOIN states AS other USING (trial_id, spec_hash, step)
WHERE other_seen IS NOT NULL AND other.side <> own.side;
COMMENT ON VIEW perceptions IS 'One row per decision under imperfect perception: true values and '
    'observed ones.';
COMMENT ON COLUMN perceptions.distance_m IS 'true distance to the other vehicle, ahead positive';
COMMENT ON COLUMN perceptions.other_speed_mps IS 'true speed of the other vehicle';
COMMENT ON COLUMN perceptions.own_position_m IS 'true position of the own vehicle';
COMMENT ON COLUMN perceptions.own_speed_mps IS 'true speed of the own vehicle';

CREATE VIEW trial_drivers AS
SELECT trial_id, spec_hash,
    CASE WHEN left_driver = right_driver THEN left_driver
        WHEN ego = 'left' THEN left_driver || '+' || right_driver
        ELSE right_driver || '+' || left_driver END
        || CASE WHEN sample_set > 0 THEN '/set' || sample_set ELSE '' END
        || coalesce(' [' || levels || ']', '') AS driver,
    ego
FROM (
    SELECT trial_id, spec_hash, sample_set, levels,
        driver_name(model_left, spec->>'$.left.endpoint') AS left_driver,
        driver_name(model_right, spec->>'$.right.endpoint') AS right_driver,
        (spec->'$.left.body') IS NOT NULL AS left_asks,
        (spec->'$.right.body') IS NOT NULL AS right_asks,
        CASE WHEN focal IS NOT NULL THEN focal
            WHEN opponent = model_right THEN 'left'
            WHEN opponent = model_left THEN 'right'
            WHEN model_left = model_right THEN 'left'
            WHEN left_asks AND NOT right_asks THEN 'left'
            WHEN right_asks AND NOT left_asks THEN 'right'
            WHEN model_left > model_right THEN 'right' ELSE 'left' END AS ego
    FROM trials LEFT JOIN specs USING (spec_hash) LEFT JOIN (
        SELECT trial_id, spec_hash, max(value) FILTER (factor = 'opponent') AS opponent,
            string_agg(factor || '=' || value, ', ' ORDER BY factor)
                FILTER (factor NOT IN ('prompt', 'opponent') AND NOT words) AS levels
        FROM trial_factors GROUP BY ALL
    ) USING (trial_id, spec_hash)
);
COMMENT ON VIEW trial_drivers IS 'One row per trial: its driver. Two different drivers are joined '
    'by a plus, the ego first; another sample set and the levels of factors other than prompt, '
    'text factors and opponent follow.';
COMMENT ON COLUMN trial_drivers.driver IS 'model, with its endpoint if that is not the '
    'provider''s own, as in o3 at localhost:8080';
COMMENT ON COLUMN trial_drivers.ego IS 'side of the ego: trials.focal if it is not NULL; else, of '
    'two different drivers, the one that is not the study''s opponent, else the language model, '
    'else the first in the alphabet; of two equal drivers, and of humans, the left one';

CREATE VIEW trial_levels AS
WITH own AS (SELECT * EXCLUDE words FROM trial_factors)
FROM own SEMI JOIN trials USING (trial_id, spec_hash) WHERE factor <> 'prompt'
UNION ALL
SELECT trial_id, spec_hash, unnest(['model', 'prompt']),
    unnest([CASE WHEN model_left = model_right OR coalesce(opponent, 'self') <> 'self' THEN one
        ELSE one || '+' || other END, coalesce(prompt, variant)])
FROM (
    SELECT *, CASE ego WHEN 'left' THEN model_left ELSE model_right END AS one,
        CASE ego WHEN 'left' THEN model_right ELSE model_left END AS other
    FROM trials JOIN trial_drivers USING (trial_id, spec_hash)
) AS trials LEFT JOIN (
    SELECT trial_id, spec_hash, max(value) FILTER (factor = 'opponent') AS opponent,
        max(value) FILTER (factor = 'prompt') AS prompt
    FROM own GROUP BY ALL
) USING (trial_id, spec_hash)
WHERE source <> 'human';
COMMENT ON VIEW trial_levels IS 'One row per driven trial and factor: factors of trial_factors '
    'without text factors, and model and prompt. The level of the factor model is the driver; of two '
    'different ones without a factor opponent it is the pair, A+B, the ego first.';
COMMENT ON COLUMN trial_levels.factor IS 'name in the study''s file, or model, or prompt';

CREATE VIEW attempts AS
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
COMMENT ON VIEW attempts IS 'One row per attempt, with its trial and its fate.';
COMMENT ON COLUMN attempts.call_key IS 'key in calls';
COMMENT ON COLUMN attempts.started_at IS 'see calls';
COMMENT ON COLUMN attempts.scripted IS 'see calls';
COMMENT ON COLUMN attempts.model IS 'requested model of the registry';
COMMENT ON COLUMN attempts.fate IS 'retried: another attempt followed; driven: its plan was '
    'driven; fallback: no valid plan (see failure), an older one or 0 was driven; lost: the call '
    'failed, and so did the trial';

CREATE VIEW trial_costs AS
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
COMMENT ON VIEW trial_costs IS 'One row per trial: the cost of its replies.';
COMMENT ON COLUMN trial_costs.attempts IS 'number of attempts';
COMMENT ON COLUMN trial_costs.calls IS 'number of calls';
COMMENT ON COLUMN trial_costs.cost_usd IS 'sum of the known costs of its replies when they were made, whoever '
    'paid';
COMMENT ON COLUMN trial_costs.paid_usd IS 'part that the run of the trial paid';
COMMENT ON COLUMN trial_costs.attempts_of_unknown_cost IS 'number of attempts without a known cost';

CREATE VIEW sweep_costs AS
SELECT sweep_id,
    count(*) AS trials,
    sum(calls) AS calls, sum(attempts) AS attempts,
    sum(cost_usd) AS cost_usd, sum(attempts_of_unknown_cost) AS attempts_of_unknown_cost
FROM (SELECT DISTINCT * FROM sweep_trials) JOIN trial_costs USING (trial_id, spec_hash)
GROUP BY ALL;
COMMENT ON VIEW sweep_costs IS 'One row per sweep: sums of trial_costs over its trials.';
COMMENT ON COLUMN sweep_costs.cost_usd IS 'sum of the known costs of replies when they were made';
COMMENT ON COLUMN sweep_costs.trials IS 'number of trials';
