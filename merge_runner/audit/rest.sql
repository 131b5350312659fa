-- Checks of a whole database. Each block is a query by name; they read the tables of checks.sql, too.

-- orphans: rows that belong to nothing; a spec's hash is the hash of its text.
SELECT 'orphan' AS kind, trial_id, 'no sweep has this trial' AS text FROM trials
ANTI JOIN sweep_trials USING (trial_id, spec_hash) WHERE source <> 'human'
UNION ALL SELECT 'orphan', trial_id, 'its spec is not stored' FROM trials
ANTI JOIN specs USING (spec_hash)
UNION ALL SELECT 'orphan', trial_id, 'it is listed by a sweep that is not stored' FROM sweep_trials
ANTI JOIN sweeps USING (sweep_id)
UNION ALL SELECT 'orphan', trial_id, format('{} rows of {} belong to no trial', count(*), name)
FROM (
    SELECT 'states' AS name, trial_id, spec_hash FROM states
    UNION ALL SELECT 'decisions', trial_id, spec_hash FROM decisions
    UNION ALL SELECT 'calls', trial_id, spec_hash FROM calls
    UNION ALL SELECT 'trial_factors', trial_id, spec_hash FROM trial_factors
) ANTI JOIN trials USING (trial_id, spec_hash) GROUP BY name, trial_id
UNION ALL SELECT 'spec', NULL, format('the spec stored as {} has another hash', spec_hash)
FROM specs WHERE left(sha256(spec::VARCHAR), 16) <> spec_hash;

-- calls_in_common: identical requests of the same slot.
WITH used AS (
    SELECT DISTINCT call_key, spec_hash, driver || '/' || variant AS name
    FROM decisions JOIN trials USING (trial_id, spec_hash)
    JOIN drivers USING (trial_id, spec_hash) WHERE call_key IS NOT NULL
)
SELECT if(a.name = b.name, format('{} ({})', a.name, a.spec_hash), a.name),
    if(a.name = b.name, format('{} ({})', b.name, b.spec_hash), b.name),
    count(DISTINCT call_key) AS calls
FROM used AS a JOIN used AS b USING (call_key)
WHERE (a.name, a.spec_hash) < (b.name, b.spec_hash)
    AND (a.spec_hash IN (SELECT spec_hash FROM audited)
        OR b.spec_hash IN (SELECT spec_hash FROM audited))
GROUP BY a.name, a.spec_hash, b.name, b.spec_hash ORDER BY ALL;
