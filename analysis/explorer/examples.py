"""Queries to begin with: those of the README."""

from __future__ import annotations

EXAMPLES = {
    "Who merged first, and how often did they collide?": """\
select model_left, variant, condition, count(*) as trials,
    count_if(merged_first = 'left') as left_first,
    count_if(merged_first = 'right') as right_first,
    count_if(status = 'collided') as collided
from trials
group by all order by all""",
    "Gap at the merge point, speed deviation, and joint contribution per variant": """\
select variant, count(gap_m) as n, round(avg(gap_m), 2) as gap_m,
    round(avg(rmse_mps), 2) as rmse_mps, round(100 * avg(joint::int), 1) as joint_percent
from trials join trial_metrics using (trial_id, spec_hash)
group by all order by all""",
    "What did the drivers say in the trials that ended in a collision?": """\
select trial_id, side, time_s, tactical, rationale
from decisions join trials using (trial_id, spec_hash)
where status = 'collided'
order by trial_id, decision, side
limit 20""",
}
