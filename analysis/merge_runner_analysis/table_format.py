"""The output formats of tables: without an import, so that the command line starts at once."""

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
        """Suffix of its files."""
        return {"text": "txt", "latex": "tex"}.get(self, self.value)
