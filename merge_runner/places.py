"""Where things lie by default."""

from __future__ import annotations

from pathlib import Path

PROJECT = Path(__file__).resolve().parent.parent
DEFAULT_DB = Path("results/merge.duckdb")
DEFAULT_CACHE = Path("cache/responses")
