"""What drivers did first where they were only asked (source ``seat``), as a query."""

# One row a trial and side, but for trials that failed: ``model`` was asked, or is a program. The
# velocity is the driver's own, minus the other's; the action is the net acceleration over the first
# step, of the fallback where the reply was invalid.
FIRST_LOOKS = """
SELECT trial_id, spec_hash, side, variant, if(side = 'left', model_left, model_right) AS model,
    valid, tactical, if(side = 'left', 1, -1) * relative_velocity_mps + 0 AS velocity_mps,
    action_mps2
FROM (FROM decisions WHERE decision = 0)
JOIN (FROM trials WHERE source = 'seat' AND status <> 'failed') USING (trial_id, spec_hash)
JOIN (
    SELECT trial_id, spec_hash, side, min_by(acceleration_mps2, step) AS action_mps2
    FROM states WHERE time_s > 0 GROUP BY ALL
) USING (trial_id, spec_hash, side)
"""
