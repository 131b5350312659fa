"""Names that stand in results, and the forms of tables: without an import, for light modules."""

from enum import StrEnum

HUMAN = "human"
BASELINE = "baseline"
# Of each study that a database holds, the question that it asks.
DESCRIPTIONS = """
SELECT config->>'$.description' AS description FROM sweeps
WHERE description <> '' GROUP BY ALL ORDER BY min(started_at)
"""


class TableFormat(StrEnum):
    """Output formats of the paper's tables."""

    TEXT = "text"
    CSV = "csv"
    JSON = "json"
    MD = "md"
    LATEX = "latex"

    @property
    def suffix(self) -> str:
        """That of its files."""
        return {"text": "txt", "latex": "tex"}.get(self, self.value)
