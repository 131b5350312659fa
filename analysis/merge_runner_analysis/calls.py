"""Outcomes of the calls and decisions of each trial, for tables, pages and the report."""

from merge_runner.records import ANSWERS, NO_DECISION

# One row a trial. A call is asked at one decision, in attempts from 1 on; the last one is its
# answer, which a lost call has not; ``faults`` are attempts without one. ``answers`` are replies,
# ``others`` come from another model, as the condition on a row of calls has it that stands for it.
# ``failures`` has in lines what each answer lacks, a valid plan or the decision asked for.
COUNTED = f"""
SELECT trial_id, spec_hash,
    coalesce(decisions, 0) AS decisions, coalesce(asked, 0) AS asked,
    coalesce(invalid, 0) AS invalid, coalesce(fallbacks, 0) AS fallbacks,
    coalesce(no_decision, 0) AS no_decision, failures,
    coalesce(attempts, 0) AS attempts, coalesce(calls, 0) AS calls,
    coalesce(retried, 0) AS retried, greatest(coalesce(calls - coalesce(asked, 0), 0), 0) AS lost,
    coalesce(faults, 0) AS faults, coalesce(unknown, 0) AS unknown,
    coalesce(answers, 0) AS answers, coalesce(others, 0) AS others,
    coalesce(unpriced, 0) AS unpriced, cost_usd
FROM trials LEFT JOIN (
    SELECT trial_id, spec_hash, count(*) AS decisions, count(call_key) AS asked,
        count(*) FILTER (NOT valid) AS invalid, count(*) FILTER (fallback) AS fallbacks,
        count(*) FILTER (failure = '{NO_DECISION}') AS no_decision,
        string_agg(failure, chr(10)) AS failures
    FROM decisions GROUP BY ALL
) USING (trial_id, spec_hash) LEFT JOIN (
    SELECT trial_id, spec_hash, count(*) AS attempts, count(*) FILTER (attempt = 1) AS calls,
        count(*) FILTER (attempt > 1) AS retried,
        count(*) FILTER (outcome NOT IN {ANSWERS}) AS faults,
        count(*) FILTER (outcome = 'unknown') AS unknown,
        count(*) FILTER (http_status = 200) AS answers,
        count(*) FILTER (http_status = 200 AND {{others}}) AS others,
        count(*) FILTER (cost_usd IS NULL) AS unpriced, sum(cost_usd) AS cost_usd
    FROM calls GROUP BY ALL
) USING (trial_id, spec_hash)
"""  # noqa: S608 # constants
