-- Checks that a replay cannot make. Each block is a query by name: DuckDB would plan a view twice.

-- tables: the audited sweep, its planned trials (if subject.known), the trials that were audited
-- before, and pairs of models that do not match; then the ids of replies, and the requests that they
-- name; hashes of the answers whose id another call has too.
CREATE OR REPLACE TEMP TABLE subject (sweep_id VARCHAR, finished BOOLEAN, known BOOLEAN);
CREATE OR REPLACE TEMP TABLE planned (trial_id VARCHAR, spec_hash VARCHAR);
CREATE OR REPLACE TEMP TABLE done (trial_id VARCHAR, spec_hash VARCHAR);
CREATE OR REPLACE TEMP TABLE other_models (model_requested VARCHAR, model_served VARCHAR);
CREATE OR REPLACE TEMP TABLE ids (call_rowid BIGINT, reply_id VARCHAR, answered JSON);
CREATE OR REPLACE TEMP TABLE reply_ids (
    call_rowid BIGINT, trial_id VARCHAR, spec_hash VARCHAR, side VARCHAR, decision INTEGER,
    call_key VARCHAR, provider VARCHAR, model_requested VARCHAR, endpoint VARCHAR, reply_id VARCHAR);
CREATE OR REPLACE TEMP TABLE contents (call_rowid BIGINT, content VARCHAR);
CREATE OR REPLACE TEMP TABLE repeated_ids (
    endpoint VARCHAR, model_requested VARCHAR, reply_id VARCHAR, telling BOOLEAN);
CREATE OR REPLACE TEMP MACRO text_of(json) AS if(json_type(json) = 'VARCHAR', json->>'$', NULL);

-- trials: the sweep's list of trials, the planned ones that it does not list (elsewhere: another sweep
-- played it after this one stopped), and its stored trials that were not audited before.
CREATE OR REPLACE TEMP TABLE linked AS
SELECT trial_id, spec_hash, count(*) AS links FROM sweep_trials SEMI JOIN subject USING (sweep_id)
GROUP BY ALL;
CREATE OR REPLACE TEMP TABLE unplayed AS
SELECT trial_id, trials.status IS NOT NULL AS elsewhere
FROM planned ANTI JOIN linked USING (trial_id)
LEFT JOIN (
    FROM trials SEMI JOIN sweep_trials USING (trial_id, spec_hash) WHERE status <> 'failed'
) AS trials USING (trial_id, spec_hash);
CREATE OR REPLACE TEMP TABLE audited AS
SELECT trial_id, spec_hash FROM linked SEMI JOIN trials USING (trial_id, spec_hash)
ANTI JOIN done USING (trial_id, spec_hash);

-- drivers: made for the first query that reads them, since few do; each would plan the view anew.
CREATE TEMP TABLE IF NOT EXISTS drivers AS SELECT trial_id, spec_hash, driver FROM trial_drivers;

-- list_findings: faults of the sweep's list of trials.
SELECT 'missing' AS kind, trial_id, 'it was not played' AS text
FROM unplayed WHERE NOT elsewhere AND (SELECT finished FROM subject)
UNION ALL SELECT 'failed', trial_id, coalesce(error, 'it failed')
FROM trials SEMI JOIN linked USING (trial_id, spec_hash)
WHERE status = 'failed' AND (SELECT finished FROM subject)
UNION ALL SELECT 'unplanned', trial_id, 'the plan of the sweep has no such trial'
FROM linked ANTI JOIN planned USING (trial_id) WHERE (SELECT known FROM subject)
UNION ALL SELECT 'unplanned', trial_id, format('the sweep lists it {} times', sum(links))
FROM linked GROUP BY trial_id HAVING sum(links) > 1
UNION ALL SELECT 'orphan', trial_id, 'the sweep lists it, and it is not among the trials'
FROM linked ANTI JOIN trials USING (trial_id, spec_hash)
UNION ALL SELECT 'config', NULL, 'its id does not match its name, drivers and start'
FROM sweeps SEMI JOIN subject USING (sweep_id)
WHERE json_valid(config) AND sweep_id <> concat_ws(
    '-', name, config->>'$.model', strftime(started_at, '%Y%m%dT%H%M%S%f'));

-- served_findings: one for each pair of models, at its first reply.
SELECT 'served' AS kind, arg_min(trial_id, (trial_id, decision, side)) AS trial_id,
    arg_min(side, (trial_id, decision, side)) AS side,
    arg_min(decision, (trial_id, decision, side)) AS decision,
    format('{} -> {}: another model answered than was asked for ({} replies)',
        model_requested, model_served, count(*)) AS text
FROM calls SEMI JOIN audited USING (trial_id, spec_hash)
SEMI JOIN other_models USING (model_requested, model_served)
WHERE http_status = 200 GROUP BY model_requested, model_served;

-- attempt_findings: an empty reply may be requested again; any other reply is the last attempt.
SELECT 'attempt' AS kind, trial_id, side, decision, text FROM (
    SELECT trial_id, side, decision, CASE
        WHEN list(attempt ORDER BY attempt) <> range(1, count(*) + 1)
            THEN format('its attempts are numbered {}', list(attempt ORDER BY attempt)::VARCHAR)
        WHEN min(attempt) FILTER (outcome IN ('ok', 'refusal', 'truncated')) < max(attempt)
            THEN 'a reply was followed by another attempt' END AS text
    FROM calls SEMI JOIN audited USING (trial_id, spec_hash)
    GROUP BY trial_id, spec_hash, side, decision, call_key
) WHERE text IS NOT NULL;

-- ids: of the replies of the sweep in the variable sweep_id, or of all, and the requests that they
-- name. They are read once and without any other column, from first_row to last_row: replies may be
-- long.
INSERT INTO ids
SELECT call_rowid, coalesce(nullif(text_of(members[1]), ''), text_of(members[2])) AS reply_id,
    members[3] AS answered
FROM (
    SELECT rowid AS call_rowid,
        json_extract(reply, ['$.id', '$.responseId', '$.merge_runner_request']) AS members
    FROM calls WHERE rowid BETWEEN getvariable('first_row') AND getvariable('last_row')
    AND (getvariable('sweep_id') IS NULL OR (trial_id, spec_hash) IN (
        SELECT (trial_id, spec_hash) FROM sweep_trials WHERE sweep_id = getvariable('sweep_id')))
) WHERE reply_id IS NOT NULL OR answered IS NOT NULL;

-- exchanged_findings: each reply of the emulator names the request that it answers.
SELECT 'exchanged' AS kind, trial_id, calls.side, calls.decision,
    'its reply names another request' AS text
FROM calls JOIN (FROM ids WHERE answered IS NOT NULL) ON calls.rowid = call_rowid
SEMI JOIN audited USING (trial_id, spec_hash) JOIN trials USING (trial_id, spec_hash)
WHERE answered->>'$.body_sha256' <> sha256(request::VARCHAR)
    OR [answered->>'$.slot.condition', answered->>'$.slot.repetition', answered->>'$.slot.side',
        answered->>'$.slot.decision', answered->>'$.slot.sample_set']
        <> [condition, rep::VARCHAR, calls.side, calls.decision::VARCHAR, sample_set::VARCHAR]
    AND json_type(answered, '$.slot') = 'OBJECT';

-- reply_ids: they are compared within an endpoint, since two emulators give equal requests equal ids.
INSERT INTO reply_ids
SELECT call_rowid, calls.trial_id, calls.spec_hash, calls.side, decision, call_key, provider,
    model_requested,
    coalesce(json_extract_string(spec, '$.' || side || '.endpoint'), '') AS endpoint, reply_id
FROM calls JOIN ids ON calls.rowid = call_rowid LEFT JOIN specs USING (spec_hash)
WHERE http_status = 200 AND reply_id IS NOT NULL;

-- repeated_replies: the replies whose id another call has too.
SELECT call_rowid FROM reply_ids SEMI JOIN (
    SELECT endpoint, model_requested, reply_id FROM reply_ids
    GROUP BY ALL HAVING min(call_key) <> max(call_key)
) USING (endpoint, model_requested, reply_id) ORDER BY call_rowid;

-- repeated_ids: some servers draw ids out of a thousand, or have only one. An id with different answers
-- proves nothing; neither does an id of a server most of whose repeated ids are such, nor an id of a
-- local server, which need not be unique.
INSERT INTO repeated_ids
SELECT endpoint, model_requested, reply_id, same AND provider <> 'local'
    AND count(*) FILTER (same) OVER server >= count(*) FILTER (NOT same) OVER server AS telling
FROM (
    SELECT endpoint, model_requested, reply_id, any_value(provider) AS provider,
        min(content) = max(content) AS same
    FROM reply_ids JOIN contents USING (call_rowid) GROUP BY ALL
) WINDOW server AS (PARTITION BY endpoint, model_requested);

-- shared_findings: two slots of one spec with one call, and two calls of any spec with one reply: a
-- caching proxy answers a repetition, or a new sample set, with an old reply. Drivers of a study may
-- make the same request in the same slot: that is no finding.
WITH shared AS (
    SELECT 'shares its call with' AS text,
        list(DISTINCT (trial_id, side, decision) ORDER BY (trial_id, side, decision)) AS places,
        list(DISTINCT (trial_id, spec_hash)) AS trials
    FROM decisions SEMI JOIN (
        SELECT call_key FROM decisions GROUP BY call_key HAVING count(*) > 1
    ) USING (call_key) JOIN drivers USING (trial_id, spec_hash)
    GROUP BY spec_hash, driver, call_key HAVING count(*) > 1
    UNION ALL SELECT 'shares its reply, and the provider''s id of it, with',
        list(place ORDER BY place), list(DISTINCT trial)
    FROM (
        SELECT endpoint, model_requested, reply_id, min((trial_id, side, decision)) AS place,
            arg_min((trial_id, spec_hash), (trial_id, side, decision)) AS trial
        FROM reply_ids SEMI JOIN (FROM repeated_ids WHERE telling)
            USING (endpoint, model_requested, reply_id)
        GROUP BY endpoint, model_requested, reply_id, call_key
    ) GROUP BY endpoint, model_requested, reply_id
)
SELECT 'shared' AS kind, places[1][1] AS trial_id, places[1][2] AS side, places[1][3] AS decision,
    format('{} {}{}', text, array_to_string(
        [format('{}, {}, decision {}', p[1], p[2], p[3]) FOR p IN places[2:4]], '; '),
        if(len(places) > 4, format(' and {} more', len(places) - 4), '')) AS text
FROM shared WHERE len(places) > 1
    AND list_has_any(trials, (SELECT list((trial_id, spec_hash)) FROM audited))
    AND NOT coalesce(list_has_any(trials, (SELECT list((trial_id, spec_hash)) FROM done)), false);

-- alike: number of replies to repeated prompts, if all of them are identical and there are at least
-- five. A model that samples does not only repeat replies. A caching proxy with new ids does, and so
-- does a model at temperature 0: in both cases the replies are no samples.
SELECT if(count(*) FILTER (different > 1) = 0 AND sum(times - 1) >= 5, sum(times - 1), 0)::BIGINT
    AS answers
FROM (
    SELECT count(*) AS times, count(DISTINCT answer) AS different
    FROM (
        SELECT DISTINCT ON (model_left, model_right, side, prompt_hash, call_key)
            model_left, model_right, side, prompt_hash,
            hash(coalesce(rationale, ''), plan) AS answer
        FROM decisions SEMI JOIN audited USING (trial_id, spec_hash)
        JOIN trials USING (trial_id, spec_hash) WHERE valid AND call_key IS NOT NULL
    ) GROUP BY model_left, model_right, side, prompt_hash
);

-- counts: numbers of what is checked, by name.
SELECT 'stored' AS name, count(*) AS number
FROM linked SEMI JOIN trials USING (trial_id, spec_hash)
UNION ALL SELECT 'missing', count(*) FROM unplayed WHERE NOT elsewhere
UNION ALL SELECT 'failed', count(*)
FROM linked SEMI JOIN (FROM trials WHERE status = 'failed') USING (trial_id, spec_hash)
UNION ALL SELECT unnest(['decisions', 'invalid']), unnest([count(*), count(*) FILTER (NOT valid)])
FROM decisions SEMI JOIN audited USING (trial_id, spec_hash)
UNION ALL SELECT unnest(['calls', 'attempts', 'attempts answered by a mock model']),
    unnest([count(DISTINCT call_key), count(*), count(*) FILTER (scripted)])
FROM calls SEMI JOIN audited USING (trial_id, spec_hash)
UNION ALL SELECT 'reply ids', count(DISTINCT reply_id)
FROM reply_ids SEMI JOIN audited USING (trial_id, spec_hash);

-- possible: the blocks that may have a row, attempt_findings also if there are more attempts than
-- calls. To plan the others would take longer than to look here.
SELECT 'attempt_findings' AS block FROM calls HAVING min(attempt) <> 1 OR max(attempt) <> 1
UNION ALL SELECT 'shared_findings' FROM decisions HAVING count(call_key) > count(DISTINCT call_key)
UNION ALL SELECT unnest(['shared_findings', 'notes']) FROM repeated_ids
UNION ALL SELECT 'notes' FROM unplayed WHERE elsewhere
UNION ALL SELECT 'notes' FROM sweeps HAVING count(*) > 1
UNION ALL SELECT 'served_findings' FROM other_models;

-- notes: no findings. Earlier runs that played trials of this one are runs of the same name and
-- drivers, which it resumes, or other sweeps.
WITH played_before AS (
    SELECT DISTINCT trial_id, spec_hash, own.sweep_id, earlier.sweep_id AS earlier,
        earlier.started_at AS began_at,
        regexp_replace(own.sweep_id, '-[^-]*$', '') = regexp_replace(earlier.sweep_id, '-[^-]*$', '')
            AS resumed
    FROM linked JOIN sweep_trials USING (trial_id, spec_hash) JOIN sweeps AS earlier USING (sweep_id),
        subject JOIN sweeps AS own ON own.sweep_id = subject.sweep_id
    WHERE earlier.started_at < own.started_at
)
SELECT format('goes on from {} of {}: {} of its trials were stored before',
    if(count(DISTINCT earlier) = 1, 'the run', format('{} runs, the first', count(DISTINCT earlier))),
    strftime(min(began_at), '%Y-%m-%d %H:%M'), count(DISTINCT (trial_id, spec_hash)))
FROM played_before WHERE resumed GROUP BY sweep_id
UNION ALL FROM (
    SELECT format('{} and {} share {} trials', sweep_id, earlier, count(*))
    FROM played_before WHERE NOT resumed GROUP BY sweep_id, earlier ORDER BY ALL
)
UNION ALL SELECT format('{} of its trials were played by another sweep', count(*))
FROM unplayed WHERE elsewhere HAVING count(*) > 0
-- A later run of the same study resumes it, with a note of its own.
UNION ALL SELECT format('{} of its trials are checked with a later sweep that has them too', count(*))
FROM linked SEMI JOIN done USING (trial_id, spec_hash) ANTI JOIN (
    sweep_trials JOIN sweeps AS later USING (sweep_id)
    JOIN sweeps AS own ON own.name = later.name AND own.started_at < later.started_at
    JOIN subject ON subject.sweep_id = own.sweep_id
) USING (trial_id, spec_hash) HAVING count(*) > 0
UNION ALL SELECT format('{} replies of {} at {} have an id that the server gave more than once: its ids '
    'do not tell whether a reply was given twice', count(DISTINCT call_key), model_requested,
    coalesce(nullif(endpoint, ''), 'its endpoint'))
FROM reply_ids JOIN repeated_ids USING (endpoint, model_requested, reply_id)
SEMI JOIN audited USING (trial_id, spec_hash)
WHERE NOT telling GROUP BY model_requested, endpoint;
