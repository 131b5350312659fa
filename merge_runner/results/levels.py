"""What was designed, as queries: descriptions of studies, and levels of the trials of drivers."""

DESCRIPTIONS = """
SELECT config->>'$.description' AS description FROM sweeps
WHERE description <> '' GROUP BY ALL ORDER BY min(started_at)
"""

# One row a trial and factor: those of its study, and the model and the prompt that it had. Who
# meets an opponent is the model; of a pair without one both are, the ego first.
LEVELS = """
WITH own AS (FROM trial_factors WHERE factor <> 'prompt')
FROM own SEMI JOIN trials USING (trial_id, spec_hash)
UNION ALL
SELECT trial_id, spec_hash, unnest(['model', 'prompt']),
    unnest([if(model_left = model_right OR coalesce(opponent, 'self') <> 'self', one,
        one || '+' || other), variant])
FROM (
    SELECT *, if(ego = 'left', model_left, model_right) AS one,
        if(ego = 'left', model_right, model_left) AS other
    FROM trials JOIN trial_drivers USING (trial_id, spec_hash)
) AS trials LEFT JOIN (
    SELECT trial_id, spec_hash, value AS opponent FROM own WHERE factor = 'opponent'
) USING (trial_id, spec_hash)
WHERE source <> 'human'
"""
