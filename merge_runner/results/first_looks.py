"""What drivers did first where they were only asked (source ``seat``), as a query."""

# One row a trial and side, but for trials that failed: ``model`` was asked, or is a program.
# Headway and velocity are the driver's own, minus the other's; the action is the net acceleration
# over the first step, the mean that up to one second, NULL
# where the trial ends before. Both are the fallback's where the reply was
# invalid.
FIRST_LOOKS = """
SELECT trial_id, spec_hash, side, variant, condition, rep,
    if(side = 'left', model_left, model_right) AS model, model_left <> model_right AS mixed,
    call_key IS NOT NULL AS asked, scripted AND call_key IS NOT NULL AS scripted, valid, tactical,
    own * projected_headway_m + 0 AS headway_m,
    own * relative_velocity_mps + 0 AS velocity_mps, action_mps2, mean_mps2
FROM (SELECT *, if(side = 'left', 1, -1) AS own FROM decisions WHERE decision = 0)
JOIN (FROM trials WHERE source = 'seat' AND status <> 'failed') USING (trial_id, spec_hash)
JOIN (
    SELECT trial_id, spec_hash, side,
        min_by(acceleration_mps2, step) FILTER (step > 0) AS action_mps2,
        CASE WHEN max(time_s) > 1 - 1e-9
            THEN max_by(velocity_mps, step) - min_by(velocity_mps, step) END AS mean_mps2
    FROM states WHERE time_s BETWEEN 0 AND 1 + 1e-9 GROUP BY ALL
) USING (trial_id, spec_hash, side)
"""
