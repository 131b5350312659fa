"""Prompts that were sent: on which road, and whether each asks for a tactical decision."""

from __future__ import annotations

import json

import duckdb

from merge_runner.prompts.blocks import BLOCKS
from merge_runner.prompts.texts import TACTICAL
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner_analysis.web.reading import records
from merge_runner_analysis.web.trial.prompt_parts import digests_of, parts_of

# One row per prompt, by its ``place`` among the decisions. A prompt changes with the road, as
# ``World.observe`` has it: on the straight one its driver, or both, passed the merge point.
SENT = f"""
CREATE TABLE sent AS
WITH passed AS (
    SELECT trial_id, spec_hash, min(time_s) FILTER (side = 'left') AS left_s,
        min(time_s) FILTER (side = 'right') AS right_s
    FROM states WHERE position_m >= {TRACK.merge_point_m} GROUP BY ALL
), prompts AS (
    SELECT spec_hash, spec->>'$.prompt_blocks' AS blocks,
        coalesce(spec->>'$.scenario.straight_after', 'own') = 'both' AS waits FROM specs
)
SELECT decisions.rowid AS place, trial_id, spec_hash, variant, condition, side, decision,
    coalesce(blocks, '{{}}') AS blocks,
    CASE WHEN focal IS NULL THEN 'both' WHEN side = focal THEN 'ego' ELSE 'other' END AS reader,
    if(CASE WHEN side = 'left' AND NOT waits THEN decisions.time_s > left_s - 1e-6
        WHEN side = 'right' AND NOT waits THEN decisions.time_s > right_s - 1e-6
        ELSE decisions.time_s > left_s - 1e-6 AND decisions.time_s > right_s - 1e-6 END,
        'straight', 'merge') AS road
FROM decisions JOIN trials USING (trial_id, spec_hash) LEFT JOIN passed USING (trial_id, spec_hash)
LEFT JOIN prompts USING (spec_hash) WHERE prompt IS NOT NULL
"""  # noqa: S608 # constants
# Prompts of the same blocks on the same road differ in values alone.
SAMPLES = """
SELECT blocks, side, road, prompt
FROM (SELECT blocks, side, road, min(place) AS place FROM sent GROUP BY ALL) AS samples
JOIN (SELECT rowid AS place, prompt FROM decisions) USING (place)
"""
# A decision without a stored prompt may have been asked for.
UNASKED = """
CREATE TABLE unasked AS SELECT place FROM sent SEMI JOIN (
    SELECT unnest(?::VARCHAR[]) AS blocks, unnest(?::VARCHAR[]) AS side,
        unnest(?::VARCHAR[]) AS road
) USING (blocks, side, road)
"""


def list_sent(connection: duckdb.DuckDBPyConnection) -> None:
    """List the prompts that were sent, and the decisions whose prompt asks for no M or Y."""
    connection.execute(SENT)
    samples = records(connection, SAMPLES, ())
    unasked = [
        (row["blocks"], row["side"], row["road"])
        for row in samples
        if not asks(row["prompt"], digests_of(json.loads(row["blocks"]), row["side"]))
    ]
    connection.execute(UNASKED, [[row[place] for row in unasked] for place in range(3)])


def asks(prompt: str, digests: dict[str, str]) -> bool:
    """Return whether a prompt asks for a tactical decision; ``digests`` are its blocks'."""
    names = {part.name for part in parts_of(prompt, None, digests)}
    # A study's own words with values in them are in no known block.
    is_own = digests.get(TACTICAL, BLOCKS[TACTICAL].digest) != BLOCKS[TACTICAL].digest
    return TACTICAL in names or (is_own and "" in names)
