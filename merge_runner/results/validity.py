"""How many of the decisions that a model was asked for are invalid, and how many are too many."""

from __future__ import annotations

MOST_INVALID_SHARE = 0.2
# One row a trial that ended and a model that was asked in it. An invalid decision is a fallback.
ASKED_DECISIONS = """
SELECT trial_id, spec_hash, if(side = 'left', model_left, model_right) AS model,
    count(*) AS asked, count(*) FILTER (NOT valid) AS invalid
FROM decisions JOIN trials USING (trial_id, spec_hash)
WHERE call_key IS NOT NULL AND status <> 'failed' GROUP BY ALL
"""


def not_judged(model: str, invalid: int, asked: int) -> str:
    """Why nothing is concluded from a model's trials; empty where few enough are invalid."""
    if invalid <= MOST_INVALID_SHARE * asked:
        return ""
    return (
        f"not judged: {invalid} of the {asked} decisions of {model} are invalid "
        f"({100 * invalid / asked:.1f} %, more than {100 * MOST_INVALID_SHARE:.0f} %)"
    )
