"""The recordings that ship with the program."""

from __future__ import annotations

from pathlib import Path

from merge_runner.llm.cache import ResponseCache
from merge_runner.paths import SHIPPED_RECORDINGS
from merge_runner.run.plan import Plan


def shipped_recording(plan: Plan, cache: ResponseCache) -> Path | None:
    """The recording of a sweep that ships with the program; None where the cache has replies.

    A user's own replies of the same model are never mixed with those of somebody else.
    """
    file = SHIPPED_RECORDINGS / f"{plan.model}-{plan.name}.parquet"
    own = any(cache.stats(entry.id).totals for entry in plan.entries.values())
    return file if file.is_file() and not own else None
