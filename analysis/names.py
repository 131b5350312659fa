"""What stands in results, here without an import, so that light modules can have it too."""

HUMAN = "human"
BASELINE = "baseline"
# Of each study that a database holds, the question that it asks.
DESCRIPTIONS = """
SELECT config->>'$.description' AS description FROM sweeps
WHERE description <> '' GROUP BY ALL ORDER BY min(started_at)
"""
