"""In which forms tables are written; apart, so that the command line can name them at once."""

from __future__ import annotations

from enum import StrEnum


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
