"""Replies of another cache folder: each is verified, and nothing else of it is used."""

from __future__ import annotations

import contextlib
from pathlib import Path

from merge_runner.errors import RecordingError, UsageError
from merge_runner.llm.cache import ResponseCache


def import_folder(folder: Path, cache: ResponseCache) -> tuple[int, int]:
    """Add what the cache lacks; returns (added, already there). The folder is only read.

    Raises RecordingError, when all others are added, if any was damaged or none of ours.
    """
    if folder.resolve() == cache.folder.resolve():
        raise UsageError(f"{folder} is the cache itself: name another one with --cache")
    left_out: list[str] = []
    with contextlib.closing(ResponseCache(folder, read_only=True)) as source:
        added, there = cache.add_missing(source.entries(left_out))
    if left_out:
        raise RecordingError(
            f"{added} calls of {folder} added to {cache.folder}, {there} were there already, and "
            f"{len(left_out)} rows are left out, the first: {left_out[0]}"
        )
    return added, there
