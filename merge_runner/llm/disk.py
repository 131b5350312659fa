"""The folder under the cache: diskcache over SQLite, text alone, of a known format."""

from __future__ import annotations

import sqlite3
from pathlib import Path
from typing import Any

import diskcache
from diskcache.core import MODE_PICKLE

from merge_runner.errors import RecordingError, UsageError

FORMAT = 3
_FORMAT, _OPENED = "format", "opened"


class TextDisk(diskcache.Disk):  # type: ignore[misc] # diskcache ships no types
    """Stores text alone, and refuses a pickled value: reading one would execute code."""

    def store(self, value: object, read: bool, key: object = diskcache.UNKNOWN) -> Any:  # noqa: ANN401 # diskcache's signature
        """Store a text."""
        if not isinstance(value, str):
            raise TypeError("the cache stores text only")
        return super().store(value, read, key=key)

    def get(self, key: object, raw: bool) -> Any:  # noqa: ANN401 # diskcache's signature
        """Read back a key."""
        if not raw or not isinstance(key, str):
            raise RecordingError(
                "the cache holds a key that is no text, which is not ours: refused"
            )
        return super().get(key, raw)

    def fetch(self, mode: int, filename: str | None, value: object, read: bool) -> Any:  # noqa: ANN401 # diskcache's signature
        """Fetch a text."""
        if mode == MODE_PICKLE:
            raise RecordingError("the cache holds a pickled value, which is not ours: refused")
        return super().fetch(mode, filename, value, read)


def open_disk(folder: Path) -> tuple[diskcache.Cache, int]:
    """Open or make the folder and see that it can be written; returns its format's version too.

    Raises UsageError for a folder that cannot be used, is damaged, or is of a newer format.
    """
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        folder.chmod(0o700)
        disk = diskcache.Cache(
            str(folder),
            disk=TextDisk,
            eviction_policy="none",
            cull_limit=0,
            size_limit=2**62,
            sqlite_synchronous=2,  # FULL: an acknowledged reply survives a power cut
            disk_min_file_size=2**40,  # everything in the one SQLite file
            sqlite_mmap_size=0,  # what is mapped counts as this process's memory
        )
        if not len(disk):
            disk.add(_FORMAT, str(FORMAT))
        version = format_of(disk)
        if version <= FORMAT:
            disk.set(_OPENED, "")  # it can be written
    except (OSError, sqlite3.Error, diskcache.Timeout, ValueError) as exc:
        raise UsageError(
            f"the cache {folder} cannot be used: {exc}. Mend or move the folder, or name another "
            "with --cache; `merge-runner recording import FILE` fills a new one"
        ) from exc
    if version > FORMAT:
        raise UsageError(
            f"the cache {folder} has format {version}, written by a newer merge-runner; this one "
            f"reads up to {FORMAT}: update merge-runner, or name another with --cache"
        )
    return disk, version


def format_of(disk: diskcache.Cache) -> int:
    """The format of a folder; the first one had no mark."""
    return int(disk.get(_FORMAT, 1))


def set_format(disk: diskcache.Cache) -> None:
    """Mark a folder as one of this program's format."""
    disk.set(_FORMAT, str(FORMAT))
