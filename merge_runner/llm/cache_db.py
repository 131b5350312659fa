"""The file under the cache: texts by name, in the one SQLite file of a diskcache.

diskcache unpickles keys and values, opens and removes the files that rows name, and applies the
settings that it finds in a file. So ``TextDisk`` takes and gives texts alone, and a file with
other settings than ours is refused before diskcache opens it.
"""

from __future__ import annotations

import contextlib
import os
import sqlite3
import tempfile
from collections.abc import Iterator
from pathlib import Path

import diskcache
from diskcache.core import METADATA, MODE_PICKLE, MODE_RAW, UNKNOWN

from merge_runner.errors import RecordingError, UsageError
from merge_runner.text_safety import one_line

FILE = "cache.db"
FORMAT = "4"
_FORMAT, _OPENED = "format", "opened"
BUSY_S = 600.0  # another process may be writing long replies to a slow disk
FAILURES = (OSError, sqlite3.Error, UnicodeDecodeError)
_GET = "SELECT mode, filename, value FROM Cache WHERE key = ? AND raw = 1"
_SETTINGS = diskcache.DEFAULT_SETTINGS | {
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
        if mode == MODE_PICKLE:
            raise RecordingError("the cache holds a pickled value, which is not ours: refused")
        if filename is not None:
            raise RecordingError(
                "the cache names a file in place of a text, which is not ours: refused"
            )
        if mode != MODE_RAW or not isinstance(value, str):
            raise RecordingError("the recorded reply is damaged: it is no text")
        return value

    def remove(self, file_path: object) -> None:
        """Leave a file that a row names where it is: we wrote none."""


class TextStore:
    """The texts of a folder's file."""

    def __init__(self, folder: Path, *, read_only: bool = False) -> None:
        """Open the file; raises UsageError for one of another version or program, or FAILURES."""
        self._file = folder / FILE
        self._disk = TextDisk(str(folder))
        self._store: diskcache.Cache | None = None
        uri = f"{self._file.absolute().as_uri()}?mode=ro"
        self._reading = sqlite3.connect(uri, uri=True, timeout=BUSY_S, isolation_level=None)
        try:
            self._refuse_others()
        except (UsageError, *FAILURES):
            self._reading.close()
            raise
        self._own = self._identity()  # that of the file which was opened to be written
        if not read_only:
            self._reading.close()
            self._store = _opened(folder)

    def get(self, name: str) -> str | None:
        """Return the text under a name; raises RecordingError where it is damaged."""
        with _no_other_bytes():
            row = self._execute(_GET, name).fetchone()
        return None if row is None else self._disk.fetch(*row)

    def set(self, name: str, text: str) -> None:
        """Keep a text, in place of any other."""
        self._written.set(name, text)

    def delete(self, name: str) -> None:
        """Forget a text."""
        self._written.delete(name)

    def quarantine(self, name: str, to: str) -> None:
        """Give what lies under a name another one, or a number behind it: nothing of it is read."""
        taken, free, number = set(self.names(to)), to, 2
        while free in taken:
            free, number = f"{to} {number}", number + 1
        self._execute("UPDATE Cache SET key = ? WHERE key = ? AND raw = 1", free, name)

    def names(self, prefix: str) -> list[str]:
        """Return the names that begin so; damaged ones do not."""
        rows = self._execute(
            "SELECT CAST(key AS BLOB) FROM Cache WHERE typeof(key) = 'text' AND key >= ? "
            "AND key < ? ORDER BY key",
            prefix,
            prefix + chr(0x10FFFF),
        )
        found = []
        for (key,) in rows:
            with contextlib.suppress(UnicodeDecodeError):
                found.append(key.decode())
        return found

    def calls(self) -> Iterator[tuple[str, str] | RecordingError]:
        """Yield the name and text of every row that may be a call's, or what is wrong with it.

        A call's name has 64 characters, without a space.
        """
        for (rowid,) in self._execute(
            "SELECT rowid FROM Cache NOT INDEXED WHERE typeof(key) != 'text' OR raw IS NOT 1 "
            "OR length(CAST(key AS BLOB)) = 64 AND NOT instr(key, ' ')"
        ):
            try:
                row = self._call(rowid)
            except RecordingError as exc:
                yield exc
            else:
                yield row

    @contextlib.contextmanager
    def transaction(self) -> Iterator[None]:
        """All or nothing, durable at the end; raises OSError where the file is no longer there."""
        try:
            with self._written.transact():
                yield
                if not self.in_place:
                    raise FileNotFoundError("it is no longer there")
        except diskcache.Timeout as exc:
            raise OSError("it cannot be locked to be written") from exc

    @property
    def in_place(self) -> bool:
        """Whether the file is still the one that was opened: SQLite writes on where it is gone."""
        try:
            return self._identity() == self._own
        except OSError:
            return False

    def close(self) -> None:
        """Close what this thread has opened."""
        self._reading.close()
        if self._store is not None:
            self._store.close()

    @property
    def _written(self) -> diskcache.Cache:
        if self._store is None:
            raise sqlite3.OperationalError("it was opened to be read alone")
        return self._store

    def _execute(self, sql: str, *values: object) -> sqlite3.Cursor:
        connection = self._reading if self._store is None else self._store._con
        cursor: sqlite3.Cursor = connection.execute(sql, values)
        return cursor

    def _call(self, rowid: int) -> tuple[str, str]:
        with _no_other_bytes():
            key, raw, *row = self._execute(
                "SELECT key, raw, mode, filename, value FROM Cache WHERE rowid = ?", rowid
            ).fetchone()
        return self._disk.get(key, raw), self._disk.fetch(*row)

    def _identity(self) -> tuple[int, int]:
        status = os.stat(self._file)
        return status.st_dev, status.st_ino

    def _refuse_others(self) -> None:
        """Raise UsageError for settings that we do not write, and for the file of another version.

        diskcache would obey such settings; the first version left no mark.
        """
        for key, value in self._execute("SELECT key, value FROM Settings").fetchall():
            if key not in METADATA and (key not in _SETTINGS or value != _SETTINGS[key]):
                raise UsageError(
                    f"{self._file} has the setting {one_line(repr(key))[:40]} of another program: "
                    "name another folder with --cache"
                )
        try:
            mark = self.get(_FORMAT) or "1"
        except RecordingError:
            return  # damaged, and each entry is checked
        if mark != FORMAT:
            raise UsageError(
                f"the cache {self._file.parent} has format {one_line(mark[:9])}, and this "
                f"merge-runner has format {FORMAT}: name another folder with --cache; "
                "`merge-runner recording import FILE --cache NEW` makes one from a recording of "
                "its replies"
            )


def open_store(folder: Path) -> TextStore:
    """Open or make the folder and see that it can be written; raises UsageError."""
    with _usable(folder):
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        folder.chmod(0o700)
        if not (folder / FILE).exists():
            _make(folder / FILE)
        store = TextStore(folder)
        with store.transaction():
            store.set(_OPENED, "")
    return store


def open_read_only(folder: Path) -> TextStore:
    """Open a folder to read it alone; raises UsageError."""
    if not (folder / FILE).exists():
        raise UsageError(f"there is no cache in {folder}")
    with _usable(folder):
        return TextStore(folder, read_only=True)


@contextlib.contextmanager
def _usable(folder: Path) -> Iterator[None]:
    """Raise UsageError for what SQLite and the system say of a folder."""
    try:
        yield
    except FAILURES as exc:
        raise UsageError(
            f"the cache {folder} cannot be used: {exc}. Put a copy of it back, or name another "
            "folder with --cache, into which `merge-runner recording import FILE` takes the "
            "replies of a recording"
        ) from exc


@contextlib.contextmanager
def _no_other_bytes() -> Iterator[None]:
    """Raise RecordingError for a text that is no UTF-8."""
    try:
        yield
    except (sqlite3.OperationalError, UnicodeDecodeError) as exc:
        if isinstance(exc, sqlite3.OperationalError) and "UTF-8" not in str(exc):
            raise
        raise RecordingError("the recorded reply is damaged: it is no text") from exc


def _make(file: Path) -> None:
    """Make the file whole or not at all, so that an empty one is never one that is being made."""
    with tempfile.TemporaryDirectory(prefix="new-", dir=file.parent) as folder:
        _lay_out(Path(folder))
        try:
            os.link(Path(folder) / FILE, file)
        except FileExistsError:
            pass  # another process was quicker
        except OSError:  # a file system without links
            _lay_out(file.parent)
    # The name of a new file is durable only when its folder is.
    descriptor = os.open(file.parent, os.O_RDONLY)
    os.fsync(descriptor)
    os.close(descriptor)


def _lay_out(folder: Path) -> None:
    """Make what is missing of a file; one that another process has made stays as it is."""
    made = _opened(folder)
    made.add(_FORMAT, FORMAT)
    made.close()


def _opened(folder: Path) -> diskcache.Cache:
    return diskcache.Cache(str(folder), timeout=BUSY_S, disk=TextDisk, **_SETTINGS)
