-- All times in s, lengths in m, speeds in m/s, accelerations in m/s^2; clock times are UTC.
-- A column without a comment means what the first of its name does.

CREATE TABLE meta (
    schema_version INTEGER NOT NULL
);
COMMENT ON TABLE meta IS 'What this program needs to know of the database.';
COMMENT ON COLUMN meta.schema_version IS 'of the tables: files of another are refused';

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
COMMENT ON TABLE sweeps IS 'A run of a sweep.';
COMMENT ON COLUMN sweeps.sweep_id IS 'its name, its drivers and when it started';
COMMENT ON COLUMN sweeps.name IS 'of its file, as in experiments/NAME.toml';
COMMENT ON COLUMN sweeps.started_at IS 'when the run began';
COMMENT ON COLUMN sweeps.ended_at IS 'NULL: running, or ended without a word';
COMMENT ON COLUMN sweeps.exit_code IS '0: all trials ended, and none was removed since';
COMMENT ON COLUMN sweeps.config IS 'what was to be played, by whom, with which parameters';
COMMENT ON COLUMN sweeps.git_commit IS 'of the program, or its installed version';
COMMENT ON COLUMN sweeps.git_dirty IS 'whether the program had uncommitted changes';
COMMENT ON COLUMN sweeps.versions IS 'of Python and the packages';

CREATE TABLE sweep_trials (
    sweep_id VARCHAR NOT NULL,
    trial_id VARCHAR NOT NULL,
    spec_hash VARCHAR NOT NULL
);
COMMENT ON TABLE sweep_trials IS 'The trials of each run of a sweep.';

CREATE TABLE specs (
    spec_hash VARCHAR PRIMARY KEY,
    spec JSON NOT NULL
);
COMMENT ON TABLE specs IS 'What a spec_hash stands for: both drivers, all parameters and prompt '
    'texts, the sample set.';
COMMENT ON COLUMN specs.spec IS 'both drivers, all parameters, prompt texts, sample set';

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
COMMENT ON TABLE trials IS 'A trial.';
COMMENT ON COLUMN trials.trial_id IS 'drivers/variant/condition/repetition, and the sample set; the '
    'variant without levels of words, which stand behind it with those of other factors';
COMMENT ON COLUMN trials.spec_hash IS 'of what determines the result, but condition and rep';
COMMENT ON COLUMN trials.pair IS 'human pairs only';
COMMENT ON COLUMN trials.source IS 'llm, driver, human; seat: asked without the loop';
COMMENT ON COLUMN trials.model_left IS 'who drove on the left: a model of the registry or a program';
COMMENT ON COLUMN trials.model_right IS 'who drove on the right';
COMMENT ON COLUMN trials.variant IS 'of the prompt, and the levels of words that it has';
COMMENT ON COLUMN trials.condition IS 'of the experiment';
COMMENT ON COLUMN trials.projected_headway_m IS 'of the condition, left minus right';
COMMENT ON COLUMN trials.relative_velocity_mps IS 'of the condition, left minus right';
COMMENT ON COLUMN trials.rep IS 'the repetition, from 1';
COMMENT ON COLUMN trials.sample_set IS 'another number is a fresh set of samples';
COMMENT ON COLUMN trials.status IS 'finished, collided, timeout, failed';
COMMENT ON COLUMN trials.merged_first IS 'left, right, NULL: collided, failed, or nobody merged';
COMMENT ON COLUMN trials.end_time_s IS 'when the trial ended';
COMMENT ON COLUMN trials.error IS 'why it failed';
COMMENT ON COLUMN trials.scripted IS 'a scripted stand-in answered on a side, and no model';
COMMENT ON COLUMN trials.focal IS 'left, right: the side of the ego, where the two drivers are given '
    'different words, parameters or perceptions; NULL: they are given the same';

CREATE TABLE trial_factors (
    trial_id VARCHAR NOT NULL,
    spec_hash VARCHAR NOT NULL,
    factor VARCHAR NOT NULL,
    value VARCHAR NOT NULL,
    words BOOLEAN NOT NULL
);
COMMENT ON TABLE trial_factors IS 'A level of a factor of a trial''s study.';
COMMENT ON COLUMN trial_factors.trial_id IS 'of trials';
COMMENT ON COLUMN trial_factors.spec_hash IS 'of trials';
COMMENT ON COLUMN trial_factors.factor IS 'as the study''s file names it';
COMMENT ON COLUMN trial_factors.value IS 'the level: a text as it is, anything else as JSON';
COMMENT ON COLUMN trial_factors.words IS 'it is a level of words, which the prompt''s variant names';

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
COMMENT ON TABLE states IS 'A vehicle at a sample.';
COMMENT ON COLUMN states.step IS 'of the simulation, 0 where the drivers take control';
COMMENT ON COLUMN states.time_s IS '0 where the drivers take control';
COMMENT ON COLUMN states.side IS 'left, right';
COMMENT ON COLUMN states.position_m IS 'travelled along the own branch; see geometry';
COMMENT ON COLUMN states.velocity_mps IS 'along the own branch';
COMMENT ON COLUMN states.acceleration_mps2 IS 'realised over the step before this sample';

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
    told_own_position_m DOUBLE,
    told_own_speed_mps DOUBLE,
    told_distance_m DOUBLE,
    told_other_speed_mps DOUBLE,
    told_other_acceleration_mps2 DOUBLE,
    told_other_speeds_mps DOUBLE[]
);
COMMENT ON TABLE decisions IS 'A driver at a decision instant.';
COMMENT ON COLUMN decisions.decision IS 'counts the instants of this driver''s pace from 0, the '
    'start of control, and begins above 0 where it leaves its tunnel later (control_start own_exit)';
COMMENT ON COLUMN decisions.valid IS 'whether the reply holds a plan';
COMMENT ON COLUMN decisions.failure IS 'why it is invalid; no_decision: it is valid, and lacks the '
    'tactical decision asked for';
COMMENT ON COLUMN decisions.tactical IS 'M, Y';
COMMENT ON COLUMN decisions.rationale IS 'the reason in the reply';
COMMENT ON COLUMN decisions.plan IS 'normalised to [-1, 1], the whole horizon';
COMMENT ON COLUMN decisions.applied IS 'normalised, what was driven';
COMMENT ON COLUMN decisions.fallback IS 'applied comes from an older plan, or is 0';
COMMENT ON COLUMN decisions.prompt IS 'the situation as the driver was told it';
COMMENT ON COLUMN decisions.prompt_hash IS 'SHA-256 of the prompt';
COMMENT ON COLUMN decisions.call_key IS 'leads to the call; NULL: a program decided';
COMMENT ON COLUMN decisions.other_seen IS 'whether it saw the other; NULL: it was told the truth';
COMMENT ON COLUMN decisions.told_own_position_m IS 'what it was told; NULL: the truth';
COMMENT ON COLUMN decisions.told_own_speed_mps IS 'what it was told; NULL: the truth';
COMMENT ON COLUMN decisions.told_distance_m IS 'how far ahead the other is, it was told; NULL: not seen';
COMMENT ON COLUMN decisions.told_other_speed_mps IS 'what it was told; NULL: the truth, or not seen';
COMMENT ON COLUMN decisions.told_other_acceleration_mps2 IS 'what programs were told; NULL as above';
COMMENT ON COLUMN decisions.told_other_speeds_mps IS 'the history that it was told; NULL as above';

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
COMMENT ON TABLE calls IS 'An attempt at a call.';
COMMENT ON COLUMN calls.call_key IS 'a hash of the request and its slot among the samples';
COMMENT ON COLUMN calls.attempt IS 'counts those at this call from 1';
COMMENT ON COLUMN calls.provider IS 'whose format was spoken';
COMMENT ON COLUMN calls.model_requested IS 'the id that was asked for';
COMMENT ON COLUMN calls.model_served IS 'the id that the reply names';
COMMENT ON COLUMN calls.http_status IS 'NULL: no reply came';
COMMENT ON COLUMN calls.outcome IS 'ok, refusal, truncated, empty, unknown, or why it failed';
COMMENT ON COLUMN calls.cached IS 'made before this run, which did not pay for it';
COMMENT ON COLUMN calls.started_at IS 'when it was made, maybe long before this run';
COMMENT ON COLUMN calls.latency_s IS 'from the request to the end of the reply';
COMMENT ON COLUMN calls.input_tokens IS 'includes the cached ones';
COMMENT ON COLUMN calls.cached_input_tokens IS 'read from the provider''s cache';
COMMENT ON COLUMN calls.output_tokens IS 'includes the reasoning ones';
COMMENT ON COLUMN calls.reasoning_tokens IS 'of which the reply shows nothing';
COMMENT ON COLUMN calls.cost_usd IS 'what it cost when it was made; NULL: unknown';
COMMENT ON COLUMN calls.finish_reason IS 'as the provider says it';
COMMENT ON COLUMN calls.request IS 'the body that was sent';
COMMENT ON COLUMN calls.reply IS 'the body that came';
COMMENT ON COLUMN calls.scripted IS 'a scripted stand-in answered, whoever was asked';
COMMENT ON COLUMN calls.batch_id IS 'the provider''s batch that it was a line of; NULL: of none';

-- How a driver is named: by its model, and by its endpoint where that is not the provider's own.
CREATE MACRO driver_name(model, endpoint) AS
    model || coalesce(' at ' || nullif(regexp_extract(endpoint, '://([^/]+)', 1), ''), '');

CREATE VIEW perceptions AS
SELECT trial_id, spec_hash, decision, decisions.time_s, decisions.side, other_seen,
    other.position_m - own.position_m AS distance_m,
    told_distance_m,
    other.velocity_mps AS other_speed_mps,
    told_other_speed_mps,
    own.position_m AS own_position_m,
    told_own_position_m,
    own.velocity_mps AS own_speed_mps,
    told_own_speed_mps
FROM decisions
JOIN states AS own USING (trial_id, spec_hash, time_s, side)
JOIN states AS other USING (trial_id, spec_hash, step)
WHERE other_seen IS NOT NULL AND other.side <> own.side;
COMMENT ON VIEW perceptions IS 'What was so beside what a driver with imperfect perception was '
    'told, for each of its decisions.';
COMMENT ON COLUMN perceptions.distance_m IS 'how far ahead the other was';
COMMENT ON COLUMN perceptions.other_speed_mps IS 'how fast the other was';
COMMENT ON COLUMN perceptions.own_position_m IS 'where the own vehicle was';
COMMENT ON COLUMN perceptions.own_speed_mps IS 'how fast the own vehicle was';

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
COMMENT ON VIEW trial_drivers IS 'Who drove: two different drivers are joined by a plus, the ego '
    'first, whichever side it sat on; another sample set has its number, and so has each level of a '
    'study''s factors but the prompt, with its words, and the opponent, which are named already.';
COMMENT ON COLUMN trial_drivers.driver IS 'the model, with its endpoint if that is not the provider''s own';
COMMENT ON COLUMN trial_drivers.ego IS 'the side of the driver that is named first, whose odds are '
    'told: the focal one; else of two different ones that which its study does not call the opponent, '
    'else a language model before a program, else the first in the alphabet; of two equal ones, and '
    'of humans, the left one';

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
COMMENT ON VIEW trial_levels IS 'What was designed: a row for each factor of a driven trial, those of its '
    'study, and the model and the prompt that it had. Who meets an opponent is the model; of a pair '
    'without one both are, the ego first.';

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
COMMENT ON VIEW attempts IS 'The ledger of attempts: what became of each. retried: another one '
    'followed; driven: its plan was; fallback: it gave no valid plan (see failure), so that an older '
    'plan or 0 was driven; lost: its call ended without an answer, and with it the trial.';
COMMENT ON COLUMN attempts.model IS 'who was asked: a model of the registry';
COMMENT ON COLUMN attempts.fate IS 'retried, driven, fallback or lost: see the view';

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
COMMENT ON VIEW trial_costs IS 'What the replies of a trial cost, whoever paid, and what of it the '
    'run that played it paid.';
COMMENT ON COLUMN trial_costs.attempts IS 'how many attempts there were';
COMMENT ON COLUMN trial_costs.calls IS 'how many calls there were';
COMMENT ON COLUMN trial_costs.cost_usd IS 'what the replies cost when they were made, whoever paid';
COMMENT ON COLUMN trial_costs.paid_usd IS 'the part paid by the run that played the trial';
COMMENT ON COLUMN trial_costs.attempts_of_unknown_cost IS 'how many of the attempts have no known cost';

CREATE VIEW sweep_costs AS
SELECT sweep_id,
    count(*) AS trials,
    sum(calls) AS calls, sum(attempts) AS attempts,
    sum(cost_usd) AS cost_usd, sum(attempts_of_unknown_cost) AS attempts_of_unknown_cost
FROM (SELECT DISTINCT * FROM sweep_trials) JOIN trial_costs USING (trial_id, spec_hash)
GROUP BY ALL;
COMMENT ON VIEW sweep_costs IS 'The sums of trial_costs over the trials of a sweep.';
COMMENT ON COLUMN sweep_costs.trials IS 'how many trials the sweep has';
