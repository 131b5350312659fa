"""The levels of the trials of drivers, as a query."""

# One row a trial and factor: those of its study, and the model and the prompt that it had.
LEVELS = """
WITH own AS (FROM trial_factors WHERE factor <> 'prompt')
FROM own SEMI JOIN trials USING (trial_id, spec_hash)
UNION ALL
SELECT trial_id, spec_hash, unnest(['model', 'prompt']),
    unnest([if(model_left = model_right OR coalesce(opponent, 'self') <> 'self', model_left,
        model_left || '+' || model_right), variant])
FROM trials LEFT JOIN (
    SELECT trial_id, spec_hash, value AS opponent FROM own WHERE factor = 'opponent'
) USING (trial_id, spec_hash)
WHERE source <> 'human'
"""
