"""Texts by name in the one SQLite file of a diskcache, whoever wrote that file.

diskcache unpickles keys and values, opens and removes the files that rows name, and applies the
settings that it finds in a file. So ``TextDisk`` takes and gives texts alone, and a file with
other settings than ours is refused before diskcache opens it.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import sqlite3
from collections.abc import Iterator
from pathlib import Path

import diskcache
from diskcache.core import METADATA, MODE_RAW, UNKNOWN

from merge_runner.errors import RecordingError, UsageError
from merge_runner.text_safety import one_line

FILE = "cache.db"
FORMAT_KEY, FORMAT = "format", "5"
BUSY_S = 600.0  # another process may be writing long replies to a slow disk
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
            raise RecordingError(
                "the cache holds a key that is no text, which is not ours: refused"
            )
        return key

    def store(self, value: object, read: bool, key: object = UNKNOWN) -> tuple[int, int, None, str]:
        """Return a row's size, mode, file name and value; raises TypeError unless it is a text."""
        if not isinstance(value, str):
            raise TypeError("the cache stores texts alone")
        return 0, MODE_RAW, None, value

    def fetch(self, mode: object, filename: object, value: object, read: bool = False) -> str:
        """Return the text of a row; raises RecordingError unless it holds one."""
        if filename is not None or mode != MODE_RAW:
            raise RecordingError(
                "the cache holds a pickle or names a file, which is not ours: refused"
            )
        if not isinstance(value, str):
            raise RecordingError("the recorded reply is damaged: it is no text")
        return value

    def remove(self, file_path: object) -> None:
        """Leave a file that a row names where it is: we wrote none."""


def open_texts(folder: Path) -> diskcache.Cache:
    """Return the diskcache of a folder, whose file is made if there is none."""
    return diskcache.Cache(str(folder), timeout=BUSY_S, disk=TextDisk, **SETTINGS)


@contextlib.contextmanager
def making(folder: Path) -> Iterator[None]:
    """Keep other processes from making a file in a folder; its name is durable afterwards."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def connect(file: Path, mode: str = "ro") -> sqlite3.Connection:
    """Return a connection of our own to an SQLite file, for any thread; ``mode`` is SQLite's."""
    uri = f"{file.absolute().as_uri()}?mode={mode}"
    return sqlite3.connect(
        uri, uri=True, timeout=BUSY_S, isolation_level=None, check_same_thread=False
    )


def refuse_others(folder: Path, connection: sqlite3.Connection) -> None:
    """Raise UsageError for settings that we do not write, and for the file of another version.

    diskcache would obey such settings; the first version left no mark.
    """
    for key, value in connection.execute("SELECT key, value FROM Settings").fetchall():
        if key not in METADATA and (key not in SETTINGS or value != SETTINGS[key]):
            raise UsageError(
                f"{folder / FILE} has the setting {one_line(repr(key))[:40]} of another program: "
                "name another folder with --cache"
            )
    sql = "SELECT CAST(value AS BLOB) FROM Cache WHERE key = ? AND raw = 1"
    (mark,) = connection.execute(sql, [FORMAT_KEY]).fetchone() or (b"1",)
    # Where the mark is damaged, each entry is checked all the same.
    if mark is not None and mark.isascii() and mark != FORMAT.encode():
        raise UsageError(
            f"the cache {folder} has format {one_line(mark.decode()[:9])}, and this merge-runner "
            f"has format {FORMAT}: `merge-runner recording import FILE --cache NEW` makes a new one"
        )


@contextlib.contextmanager
def damage_told() -> Iterator[None]:
    """Raise RecordingError for a text that is no UTF-8, of which SQLite says no more."""
    try:
        yield
    except (sqlite3.OperationalError, UnicodeDecodeError) as exc:
        if isinstance(exc, sqlite3.OperationalError) and "UTF-8" not in str(exc):
            raise
        raise RecordingError("the recorded reply is damaged: it is no text") from exc
