"""Texts by name in the one SQLite file of a diskcache, whoever wrote that file.

diskcache unpickles keys and values, opens and removes the files that rows name, and applies the
settings that it finds in a file. So ``TextDisk`` takes and gives texts alone, and a file with
other settings than ours is refused before diskcache opens it.
"""

from __future__ import annotations

import contextlib
from pathlib import Path

import diskcache
from diskcache.core import METADATA, MODE_RAW, UNKNOWN

from merge_runner.errors import RecordingError, UsageError
from merge_runner.llm.durable import BUSY_S, connect
from merge_runner.text_safety import one_line

FILE = "cache.db"
FORMAT_KEY, FORMAT = "format", "5"
NEW_CACHE = "`merge-runner recording import FILE --cache NEW` makes one from a recording"
SETTINGS = diskcache.DEFAULT_SETTINGS | {
    "eviction_policy": "none",
    "cull_limit": 0,
    "size_limit": 2**62,
    "sqlite_synchronous": 2,  # FULL: an acknowledged reply survives a power cut
    "disk_min_file_size": 2**40,  # everything in the one SQLite file
    "sqlite_mmap_size": 0,  # what is mapped counts as this process's memory
}


class TextDisk(diskcache.Disk):  # type: ignore[misc] # diskcache ships no types
    """Texts alone: nothing is unpickled, and no file that a row names is opened or removed."""

    def put(self, key: object) -> tuple[str, bool]:
        """Return the key as it is stored; raises TypeError unless it is a text."""
        if not isinstance(key, str):
            raise TypeError("the cache has texts alone as keys")
        return key, True

    def get(self, key: object, raw: object) -> str:
        """Return a stored key; raises RecordingError unless it is a text."""
        if not (raw and isinstance(key, str)):
            raise RecordingError("the cache holds a key that is no text: it is not ours")
        return key

    def store(self, value: object, read: bool, key: object = UNKNOWN) -> tuple[int, int, None, str]:
        """Return a row's size, mode, file name and value; raises TypeError unless it is a text."""
        if not isinstance(value, str):
            raise TypeError("the cache stores texts alone")
        return 0, MODE_RAW, None, value

    def fetch(self, mode: object, filename: object, value: object, read: bool = False) -> str:
        """Return the text of a row; raises RecordingError unless it holds one."""
        if filename is not None or mode != MODE_RAW:
            raise RecordingError("the cache holds a pickle or names a file: it is not ours")
        if not isinstance(value, str):
            raise RecordingError("the recorded reply is damaged: it is no text")
        return value

    def remove(self, file_path: object) -> None:
        """Leave a file that a row names where it is: we wrote none."""


def open_texts(folder: Path) -> diskcache.Cache:
    """Return the diskcache of a folder, whose file is made if there is none."""
    return diskcache.Cache(str(folder), timeout=BUSY_S, disk=TextDisk, **SETTINGS)


def refuse_others(folder: Path) -> None:
    """Raise UsageError for settings that we do not write, and for the file of another version.

    diskcache would obey such settings; the first version left no mark.
    """
    sql = "SELECT CAST(value AS BLOB) FROM Cache WHERE key = ? AND raw = 1"
    with contextlib.closing(connect(folder / FILE)) as connection:
        settings = connection.rows("SELECT key, value FROM Settings")
        ((mark,),) = connection.rows(sql, FORMAT_KEY) or [(b"1",)]
    for key, value in settings:
        if key not in METADATA and (key not in SETTINGS or value != SETTINGS[key]):
            name = one_line(repr(key))[:40]
            raise UsageError(f"{folder / FILE} has the setting {name} of another program")
    # Where the mark is damaged, each entry is checked all the same.
    if mark is not None and mark.isascii() and mark != FORMAT.encode():
        raise UsageError(
            f"the cache {folder} has format {one_line(mark.decode()[:9])}, and this merge-runner "
            f"has format {FORMAT}: {NEW_CACHE}"
        )
