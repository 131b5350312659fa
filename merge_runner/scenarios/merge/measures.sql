-- Measures of a trial. The numbers of the human experiment are macros such as merge_point_m(), which
-- measures.py writes before this text.

-- Overlap of boxes: with half lengths l, half widths w and each branch at the angle phi from the
-- centreline, the four separating axes are along and across either vehicle. Two vehicles at the
-- distances u and v before the merge point overlap if
--     |v - u cos 2phi|, |u - v cos 2phi| < along2 = l (1 + cos 2phi) + w sin 2phi
--     u sin 2phi, v sin 2phi < across2 = w (1 + cos 2phi) + l sin 2phi
-- and one at u before it, the other at d behind it, with along and across likewise of phi, if
--     u + d cos phi, u cos phi + d < along;  u sin phi, d sin phi < across
-- The contact point is the first point at which two vehicles touch that are both before the merge
-- point.
CREATE OR REPLACE VIEW geometry AS
WITH sizes AS (
    SELECT spec_hash,
        coalesce((spec->>'$.scenario.vehicle_length_m')::DOUBLE, usual_length_m()) AS length_m,
        coalesce((spec->>'$.scenario.vehicle_width_m')::DOUBLE, usual_width_m()) AS width_m,
        merge_point_m() AS merge_point_m,
        track_end_m() AS end_m,
        branch_sine() AS sin1
    FROM specs
), angles AS (
    SELECT *,
        sqrt(1 - sin1 ** 2) AS cos1,
        2 * sin1 * cos1 AS sin2, 1 - 2 * sin1 ** 2 AS cos2
    FROM sizes
), reaches AS (
    SELECT *,
        (length_m * (1 + cos1) + width_m * sin1) / 2 AS along,
        (width_m * (1 + cos1) + length_m * sin1) / 2 AS across,
        (length_m * (1 + cos2) + width_m * sin2) / 2 AS along2,
        (width_m * (1 + cos2) + length_m * sin2) / 2 / sin2 AS contact
    FROM angles
)
SELECT
    spec_hash,
    length_m,
    width_m,
    merge_point_m,
    end_m,
    merge_point_m - length_m / 2 AS front_m,
    merge_point_m + length_m / 2 AS rear_m,
    merge_point_m - contact AS contact_m,
    CASE WHEN contact < along THEN merge_point_m + (along - contact) / cos1
        ELSE contact_m + length_m END AS contact_high_m,
    merge_point_m - least(along2, contact) AS merge_low_m,
    merge_point_m + least(along, across / sin1) AS merge_high_m
FROM reaches;
COMMENT ON VIEW geometry IS 'One row per spec: size of the vehicles (for human recordings '
    'as in the experiment), the track, and where the vehicles'' boxes overlap (collision.py).';
COMMENT ON COLUMN geometry.length_m IS 'length of both vehicles';
COMMENT ON COLUMN geometry.width_m IS 'width of both vehicles';
COMMENT ON COLUMN geometry.merge_point_m IS 'distance at which the branches meet, along either';
COMMENT ON COLUMN geometry.end_m IS 'end of the track';
COMMENT ON COLUMN geometry.front_m IS 'centre of a vehicle whose front is at the merge point';
COMMENT ON COLUMN geometry.rear_m IS 'centre of a vehicle whose rear has left the merge point';
COMMENT ON COLUMN geometry.contact_m IS 'first position at which two vehicles can overlap: if '
    'one is there, the other overlaps it from contact_m to contact_high_m; if one is at the merge '
    'point, the other overlaps it from merge_low_m to merge_high_m';
COMMENT ON COLUMN geometry.contact_high_m IS 'see contact_m';
COMMENT ON COLUMN geometry.merge_low_m IS 'see contact_m';
COMMENT ON COLUMN geometry.merge_high_m IS 'see contact_m';

-- True on a collision course for a point: when a vehicle reaches it at its present speed, the other is
-- within the bounds of an overlap of their boxes (Siebinga et al., conflict_signal.py).
CREATE OR REPLACE MACRO on_course(at_m, low_m, high_m, own_m, own_mps, other_m, other_mps) AS
    coalesce(own_m < at_m AND own_mps > 0
        AND other_m + other_mps * (at_m - own_m) / own_mps BETWEEN low_m AND high_m, false);

-- Time at which a vehicle passes a level, linear within the step; NULL in other steps.
CREATE OR REPLACE MACRO passing_s(level_m, before_m, now_m, before_s, now_s) AS
    CASE WHEN before_m < level_m AND now_m >= level_m
    THEN before_s + (now_s - before_s) * (level_m - before_m) / (now_m - before_m) END;

CREATE OR REPLACE VIEW vehicle_pairs AS
WITH pairs AS (
    SELECT trial_id, spec_hash, step, time_s,
        max(position_m) FILTER (side = 'left') AS left_m,
        max(position_m) FILTER (side = 'right') AS right_m,
        max(velocity_mps) FILTER (side = 'left') AS left_mps,
        max(velocity_mps) FILTER (side = 'right') AS right_mps,
        max(abs(acceleration_mps2)) AS hardest_mps2
    FROM states GROUP BY ALL
)
SELECT *,
    lag(time_s) OVER trial AS time_before_s,
    lag(left_m) OVER trial AS left_before_m,
    lag(right_m) OVER trial AS right_before_m,
    first_value(left_mps) OVER trial AS left_first_mps,
    first_value(right_mps) OVER trial AS right_first_mps
FROM pairs WINDOW trial AS (PARTITION BY trial_id, spec_hash ORDER BY step);
COMMENT ON VIEW vehicle_pairs IS 'One row per sample: both vehicles, the sample before, and the '
    'first speeds.';
COMMENT ON COLUMN vehicle_pairs.left_m IS 'position of the left vehicle';
COMMENT ON COLUMN vehicle_pairs.right_m IS 'position of the right vehicle';
COMMENT ON COLUMN vehicle_pairs.left_mps IS 'speed of the left vehicle';
COMMENT ON COLUMN vehicle_pairs.right_mps IS 'speed of the right vehicle';
COMMENT ON COLUMN vehicle_pairs.hardest_mps2 IS 'larger of the absolute accelerations';
COMMENT ON COLUMN vehicle_pairs.time_before_s IS 'time of the sample before';
COMMENT ON COLUMN vehicle_pairs.left_before_m IS 'left position at the sample before';
COMMENT ON COLUMN vehicle_pairs.right_before_m IS 'right position at the sample before';
COMMENT ON COLUMN vehicle_pairs.left_first_mps IS 'left speed at the first sample';
COMMENT ON COLUMN vehicle_pairs.right_first_mps IS 'right speed at the first sample';

-- Macros with the names of samples or times as parameters: trial_metrics computes its samples once,
-- which is most of its work.
CREATE OR REPLACE MACRO merge_times_in(pairs) AS TABLE
SELECT *,
    least(left_s, right_s) AS first_s,
    CASE WHEN left_s IS NOT NULL AND right_s IS NOT NULL THEN greatest(left_s, right_s) END
        AS both_s
FROM (SELECT trial_id, spec_hash,
    min(passing_s(merge_point_m(), left_before_m, left_m, time_before_s, time_s)) AS left_s,
    min(passing_s(merge_point_m(), right_before_m, right_m, time_before_s, time_s)) AS right_s,
    min(passing_s(front_m, left_before_m, left_m, time_before_s, time_s)) AS left_front_s,
    min(passing_s(front_m, right_before_m, right_m, time_before_s, time_s)) AS right_front_s,
    min(passing_s(rear_m, left_before_m, left_m, time_before_s, time_s)) AS left_rear_s,
    min(passing_s(rear_m, right_before_m, right_m, time_before_s, time_s)) AS right_rear_s
FROM query_table(pairs) LEFT JOIN geometry USING (spec_hash) GROUP BY ALL);

CREATE OR REPLACE VIEW merge_times AS FROM merge_times_in('vehicle_pairs');
COMMENT ON VIEW merge_times IS 'One row per trial: when the centre, the front and the rear of '
    'each vehicle pass the merge point; NULL: never.';
COMMENT ON COLUMN merge_times.left_s IS 'when the left vehicle''s centre passes the merge point';
COMMENT ON COLUMN merge_times.right_s IS 'when the right vehicle''s centre passes it';
COMMENT ON COLUMN merge_times.left_front_s IS 'when the left vehicle''s front passes it';
COMMENT ON COLUMN merge_times.right_front_s IS 'when the right vehicle''s front passes it';
COMMENT ON COLUMN merge_times.left_rear_s IS 'when the left vehicle''s rear passes it';
COMMENT ON COLUMN merge_times.right_rear_s IS 'when the right vehicle''s rear passes it';
COMMENT ON COLUMN merge_times.first_s IS 'when the first centre passes it';
COMMENT ON COLUMN merge_times.both_s IS 'when the second centre passes it';

-- Squares are added in the order of time: threads would add them in any order, and round differently.
CREATE OR REPLACE MACRO speed_deviations_in(pairs, times) AS TABLE
SELECT *,
    (rmse_left_mps + rmse_right_mps) / 2 AS rmse_mps,
    least(rmse_left_mps, rmse_right_mps) >= 0.5 AS joint
FROM (SELECT trial_id, spec_hash, time_window,
    sqrt(avg((left_mps - CASE source WHEN 'human'
        THEN mean_speed_mps() + relative_velocity_mps / 2 ELSE left_first_mps END) ** 2
        ORDER BY step)) AS rmse_left_mps,
    sqrt(avg((right_mps - CASE source WHEN 'human'
        THEN mean_speed_mps() - relative_velocity_mps / 2 ELSE right_first_mps END) ** 2
        ORDER BY step)) AS rmse_right_mps
FROM query_table(pairs)
JOIN trials USING (trial_id, spec_hash)
JOIN query_table(times) USING (trial_id, spec_hash)
CROSS JOIN (VALUES ('first_merge'), ('both_merges'), ('end'), ('whole')) AS windows (time_window)
WHERE status = 'finished' AND CASE time_window
    WHEN 'first_merge' THEN time_s >= 0 AND coalesce(time_before_s < first_s, true)
    WHEN 'both_merges' THEN time_s >= 0 AND both_s IS NOT NULL
        AND coalesce(time_before_s < both_s, true)
    WHEN 'end' THEN time_s >= 0
    ELSE true END
GROUP BY ALL);

CREATE OR REPLACE VIEW speed_deviations AS
FROM speed_deviations_in('vehicle_pairs', 'merge_times');
COMMENT ON VIEW speed_deviations IS 'One row per finished trial and time_window: RMSE of each '
    'vehicle''s speed from its initial speed, from the start of control to the first merge, to '
    'both merges, to the end, or in the whole recording, tunnel included. A window ends with the '
    'first sample at which it is over. A human''s initial speed is the condition''s.';
COMMENT ON COLUMN speed_deviations.time_window IS 'first_merge, both_merges, end, whole';
COMMENT ON COLUMN speed_deviations.rmse_left_mps IS 'RMSE of the left vehicle''s speed in the window';
COMMENT ON COLUMN speed_deviations.rmse_right_mps IS 'RMSE of the right vehicle''s speed in the window';

CREATE OR REPLACE VIEW trial_metrics AS
WITH pairs AS MATERIALIZED (FROM vehicle_pairs),
-- Not materialized: else a query of one trial would read the samples of all.
times AS NOT MATERIALIZED (FROM merge_times_in('pairs')),
distances AS (
    SELECT trial_id, spec_hash,
        abs(left_before_m - right_before_m
            + (first_s - time_before_s) / (time_s - time_before_s)
            * (left_m - left_before_m - right_m + right_before_m)) AS merge_m
    FROM pairs JOIN times USING (trial_id, spec_hash)
    WHERE time_before_s < first_s AND first_s <= time_s
), sampled_distances AS (
    SELECT trial_id, spec_hash,
        arg_min(abs(left_m - right_m), step)
            FILTER (greatest(left_m, right_m) >= merge_point_m()) AS first_sample_m,
        arg_min(abs(left_m - right_m), step)
            FILTER (left_m + right_m >= 2 * merge_point_m()) AS mean_at_merge_m,
        max(hardest_mps2) FILTER (time_s > 0) AS max_acceleration_mps2
    FROM pairs GROUP BY ALL
), collision_times AS (
    SELECT trial_id, spec_hash, min((abs(left_m - right_m) - length_m) / closing_mps) AS min_ttc_s
    FROM (
        SELECT *, CASE WHEN left_m > right_m THEN right_mps - left_mps
            ELSE left_mps - right_mps END AS closing_mps
        FROM pairs JOIN geometry USING (spec_hash)
        WHERE greatest(left_m, right_m) >= merge_point_m
    )
    WHERE closing_mps > no_conflict_mps() AND abs(left_m - right_m) > length_m
    GROUP BY ALL
), resolutions AS (
    SELECT trial_id, spec_hash, min(time_s) AS conflict_resolution_s
    FROM pairs JOIN geometry USING (spec_hash)
    WHERE time_s >= 0 AND NOT (
        on_course(contact_m, contact_m, contact_high_m, left_m, left_mps, right_m, right_mps)
        OR on_course(contact_m, contact_m, contact_high_m, right_m, right_mps, left_m, left_mps)
        OR on_course(merge_point_m, merge_low_m, merge_high_m,
            left_m, left_mps, right_m, right_mps)
        OR on_course(merge_point_m, merge_low_m, merge_high_m,
            right_m, right_mps, left_m, left_mps)
        OR on_course(end_m, end_m - length_m, end_m + length_m,
            left_m, left_mps, right_m, right_mps)
        OR on_course(end_m, end_m - length_m, end_m + length_m,
            right_m, right_mps, left_m, left_mps))
    GROUP BY ALL
)
SELECT
    trials.trial_id,
    trials.spec_hash,
    CASE WHEN finished THEN merge_m - length_m END AS gap_m,
    CASE WHEN finished THEN first_sample_m - length_m END AS gap_first_sample_m,
    CASE WHEN finished THEN mean_at_merge_m - length_m END AS gap_mean100_m,
    rmse_left_mps,
    rmse_right_mps,
    rmse_mps,
    joint,
    first_s AS time_to_merge_s,
    CASE WHEN finished THEN abs(left_s - right_s) END AS merge_interval_s,
    -- At the end, the front of the second vehicle may have arrived and its centre not.
    CASE WHEN finished AND (left_s < right_s OR right_s IS NULL) THEN right_front_s - left_rear_s
        WHEN finished THEN left_front_s - right_rear_s END AS post_encroachment_s,
    min_ttc_s,
    max_acceleration_mps2,
    CASE WHEN status <> 'collided' THEN conflict_resolution_s END AS conflict_resolution_s
FROM (SELECT *, status = 'finished' AS finished FROM trials) AS trials
LEFT JOIN times USING (trial_id, spec_hash)
LEFT JOIN geometry USING (spec_hash)
LEFT JOIN distances USING (trial_id, spec_hash)
LEFT JOIN sampled_distances USING (trial_id, spec_hash)
LEFT JOIN (FROM speed_deviations_in('pairs', 'times') WHERE time_window = 'first_merge')
    USING (trial_id, spec_hash)
LEFT JOIN collision_times USING (trial_id, spec_hash)
LEFT JOIN resolutions USING (trial_id, spec_hash);
COMMENT ON VIEW trial_metrics IS 'One row per trial. A measure without a value is NULL: gaps, '
    'speed deviations and joint cover finished trials only (arXiv 2604.09609, sec. II-G).';
COMMENT ON COLUMN trial_metrics.gap_m IS 'net gap, |s_left - s_right| less the vehicle length of '
    'the trial''s spec, when the first vehicle reaches the merge point, interpolated linearly '
    'within the step; finished trials';
COMMENT ON COLUMN trial_metrics.gap_first_sample_m IS 'net gap at the first sample at or after '
    'that instant';
COMMENT ON COLUMN trial_metrics.gap_mean100_m IS 'net gap at the first sample at which the mean '
    'position has reached the merge point (Siebinga et al.; 100 m in the human experiment)';
COMMENT ON COLUMN trial_metrics.rmse_left_mps IS 'RMSE of the left vehicle''s speed from its '
    'initial speed, from the start of control to the first sample after the first merge';
COMMENT ON COLUMN trial_metrics.rmse_right_mps IS 'the same of the right vehicle';
COMMENT ON COLUMN trial_metrics.rmse_mps IS 'mean of both';
COMMENT ON COLUMN trial_metrics.joint IS 'whether both are at least 0.5 m/s';
COMMENT ON COLUMN trial_metrics.time_to_merge_s IS 'when the first vehicle reaches the merge point';
COMMENT ON COLUMN trial_metrics.merge_interval_s IS 'time between the two vehicles'' arrivals at '
    'the merge point';
COMMENT ON COLUMN trial_metrics.post_encroachment_s IS 'time from when the first vehicle''s rear '
    'has left the merge point to when the second''s front is there';
COMMENT ON COLUMN trial_metrics.min_ttc_s IS 'smallest time to collision once a vehicle is past '
    'the merge point; NULL: they never close in faster than 0.01 m/s';
COMMENT ON COLUMN trial_metrics.max_acceleration_mps2 IS 'largest absolute acceleration of either '
    'vehicle under the drivers'' control';
COMMENT ON COLUMN trial_metrics.conflict_resolution_s IS 'when the vehicles are first off a '
    'collision course; NULL after a collision';
