"""The file under the cache: texts by name, in the one SQLite file of a diskcache.

The file may be damaged, or somebody else's. diskcache applies settings that it finds in a file,
reads the files that rows name, and deletes them with their rows: so what it would obey is refused
before it opens a file, rows are read by a statement of ours, and it writes texts alone.
"""

from __future__ import annotations

import contextlib
import os
import sqlite3
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

import diskcache
from diskcache.core import MODE_PICKLE, MODE_RAW

from merge_runner.errors import RecordingError, UsageError
from merge_runner.text_safety import one_line

FILE = "cache.db"
FORMAT = "4"
_FORMAT, _OPENED = "format", "opened"
BUSY_S = 600.0  # another process may be writing long replies to a slow disk
LONGEST = 2**28
"""A row of more bytes was made to do harm."""
# How reading and writing fail; UnicodeDecodeError where SQLite quotes what is damaged.
FAILURES = (OSError, sqlite3.Error, UnicodeDecodeError)
# How a journal ends that names a file which SQLite deletes once it has rolled the journal back.
_SUPER_JOURNAL = bytes.fromhex("d9d505f920a163d7")
_COUNTS = {  # what diskcache counts when a row comes, changes or goes
    ("count", "insert"): "+ 1",
    ("count", "delete"): "- 1",
    ("size", "insert"): "+ NEW.size",
    ("size", "update"): "+ NEW.size - OLD.size",
    ("size", "delete"): "- OLD.size",
}
# What diskcache makes of a file, and needs of it.
TABLES = (
    "CREATE TABLE Settings ( key TEXT NOT NULL UNIQUE, value)",
    "CREATE TABLE Cache ( rowid INTEGER PRIMARY KEY, key BLOB, raw INTEGER, store_time REAL, "
    "expire_time REAL, access_time REAL, access_count INTEGER DEFAULT 0, tag BLOB, "
    "size INTEGER DEFAULT 0, mode INTEGER DEFAULT 0, filename TEXT, value BLOB)",
    "CREATE UNIQUE INDEX Cache_key_raw ON Cache(key, raw)",
)
_LAYOUT = {
    *TABLES,
    *(
        f"CREATE TRIGGER Settings_{what}_{event} AFTER {event.upper()} ON Cache FOR EACH ROW BEGIN "  # noqa: S608 # constants
        f'UPDATE Settings SET value = value {change} WHERE key = "{what}"; END'
        for (what, event), change in _COUNTS.items()
    ),
    *(
        f"CREATE INDEX Cache_{column} ON Cache ({column})"
        for column in ("expire_time", "store_time", "access_time", "access_count")
    ),
    "CREATE INDEX Cache_tag_rowid ON Cache(tag, rowid)",
}
_GET = "SELECT mode, filename, value FROM Cache WHERE key = ? AND raw = 1"
_CALL = (
    "SELECT CASE WHEN raw = 1 AND typeof(key) = 'text' THEN key END, mode, filename, value "
    "FROM Cache WHERE rowid = ?"
)
# All of them, so that none of the file's is applied.
_SETTINGS = diskcache.DEFAULT_SETTINGS | {
    "eviction_policy": "none",
    "cull_limit": 0,
    "size_limit": 2**62,
    "sqlite_synchronous": 2,  # FULL: an acknowledged reply survives a power cut
    "disk_min_file_size": 2**40,  # everything in the one SQLite file
    "sqlite_mmap_size": 0,  # what is mapped counts as this process's memory
}


class _Texts(diskcache.Disk):  # type: ignore[misc] # diskcache ships no types
    """Writes texts alone, and touches no other file."""

    def store(self, value: object, read: bool, key: object = diskcache.UNKNOWN) -> Any:  # noqa: ANN401 # diskcache's signature
        """Store a text."""
        if not isinstance(value, str):
            raise TypeError("the cache stores text only")
        return super().store(value, read, key=key)

    def fetch(self, mode: int, filename: str | None, value: object, read: bool) -> Any:  # noqa: ANN401 # diskcache's signature
        """Refuse: see TextDisk.get."""
        raise NotImplementedError

    def remove(self, file_path: str) -> None:
        """Leave a file that a row names where it is: we wrote none."""


class _Store(diskcache.Cache):  # type: ignore[misc] # diskcache ships no types
    """A diskcache whose connections take damaged texts as they are."""

    @property
    def _con(self) -> sqlite3.Connection:
        known = getattr(self._local, "con", None)
        connection: sqlite3.Connection = super()._con
        if connection is not known:
            _guard(connection)
        return connection


class TextDisk:
    """The texts of a folder's file."""

    def __init__(self, folder: Path, *, read_only: bool = False) -> None:
        """Open the file; raises UsageError for one that is no cache's, sqlite3.Error, OSError."""
        self._file = folder / FILE
        _refuse_traps(self._file)
        self._store: _Store | None = None
        self._reading = _reading(self._file)
        try:
            _refuse_other_layout(self._file, self._reading)
            self._refuse_other_format()
        except (UsageError, *FAILURES):
            self.close()  # so that SQLite leaves no file beside it
            raise
        self._own = _identity(self._file)  # that of the file which was opened to be written
        if not read_only:
            self._reading.close()
            _drop_other_settings(self._file)
            self._store = _opened(folder)

    def get(self, name: str) -> str | None:
        """The text under a name; raises RecordingError where it is none of ours."""
        try:
            row = self._connection.execute(_GET, (name,)).fetchone()
        except sqlite3.DataError as exc:
            raise RecordingError(f"the recorded reply is damaged: {exc}") from exc
        return None if row is None else _text(*row)

    def set(self, name: str, text: str) -> None:
        """Keep a text, in place of any other."""
        self._written.set(name, text)

    def add(self, name: str, text: str) -> bool:
        """Keep a text; False where there is one already."""
        return bool(self._written.add(name, text))

    def delete(self, name: str) -> None:
        """Forget a text."""
        self._written.delete(name)

    def set_aside(self, name: str, to: str) -> None:
        """Give what lies under a name another one, as it is: nothing of it is read."""
        connection = self._connection
        connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, 2**30)  # it may be too long to be read
        try:
            self._execute(
                "UPDATE Cache SET key = ? WHERE key = ? AND raw = 1", self._free(to), name
            )
        finally:
            connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, LONGEST)

    def names(self, prefix: str) -> list[str]:
        """The names that begin so; damaged ones do not."""
        found = self._execute(
            "SELECT key FROM Cache WHERE typeof(key) = 'text' AND key >= ? AND key < ?",
            prefix,
            prefix + chr(0x10FFFF),
        )
        return [key for (key,) in found.fetchall() if _is_whole(key)]

    def calls(self) -> Iterator[tuple[str, str] | RecordingError]:
        """The name and text of every row that may be a call's; what is none of ours as the error.

        A call's name has 64 characters, without a space.
        """
        try:
            for (rowid,) in self._execute(
                "SELECT rowid FROM Cache NOT INDEXED WHERE typeof(key) != 'text' OR raw IS NOT 1 "
                "OR length(CAST(key AS BLOB)) = 64 AND NOT instr(key, ' ')"
            ):
                yield self._call(rowid)
        except sqlite3.OperationalError:
            raise
        except sqlite3.DatabaseError as exc:  # the rows behind a damaged page cannot be reached
            yield RecordingError(f"the rest of the file is damaged: {exc}")

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
            return _identity(self._file) == self._own
        except OSError:
            return False

    def close(self) -> None:
        """Close what this thread has opened."""
        self._reading.close()
        if self._store is not None:
            self._store.close()

    def _refuse_other_format(self) -> None:
        """Raise UsageError for a folder of another version; the first version left no mark."""
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

    @property
    def _connection(self) -> sqlite3.Connection:
        return self._reading if self._store is None else self._store._con

    @property
    def _written(self) -> _Store:
        if self._store is None:
            raise sqlite3.OperationalError("it was opened to be read alone")
        return self._store

    def _execute(self, sql: str, *values: object) -> sqlite3.Cursor:
        return self._connection.execute(sql, values)

    def _call(self, rowid: int) -> tuple[str, str] | RecordingError:
        try:
            key, *row = self._execute(_CALL, rowid).fetchone()
            return _name(key), _text(*row)
        except sqlite3.DataError as exc:
            return RecordingError(f"the recorded reply is damaged: {exc}")
        except RecordingError as exc:
            return exc

    def _free(self, name: str) -> str:
        """The name, or with the first number behind it under which nothing lies yet."""
        taken, number = set(self.names(name)), 2
        free = name
        while free in taken:
            free, number = f"{name} {number}", number + 1
        return free


def open_disk(folder: Path) -> TextDisk:
    """Open or make the folder and see that it can be written.

    Raises UsageError for a folder that cannot be used, is damaged, or has another format.
    """
    with _usable(folder):
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        folder.chmod(0o700)
        if not (folder / FILE).exists():
            _refuse_traps(folder / FILE)
            _make(folder / FILE)
        disk = TextDisk(folder)
        with disk.transaction():
            disk.set(_OPENED, "")  # it can be written
    return disk


def open_read_only(folder: Path) -> TextDisk:
    """Open a folder, maybe somebody else's, to read it alone; raises UsageError."""
    if not (folder / FILE).exists():
        raise UsageError(f"there is no cache in {folder}")
    with _usable(folder):
        return TextDisk(folder, read_only=True)


@contextlib.contextmanager
def _usable(folder: Path) -> Iterator[None]:
    """Raise UsageError for what SQLite and the system say of a folder."""
    try:
        yield
    except FAILURES as exc:
        raise UsageError(
            f"the cache {folder} cannot be used: {exc}. Repair or move the folder, or name another "
            f"with --cache; `merge-runner recording import {folder}` takes what can be read of it "
            "into that one, as it takes a recording"
        ) from exc


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


def _opened(folder: Path) -> _Store:
    """Open a folder that holds nothing to be refused, or make its file."""
    return _Store(str(folder), timeout=BUSY_S, disk=_Texts, **_SETTINGS)


def _drop_other_settings(file: Path) -> None:
    """Drop names that diskcache would take for its own attributes, such as its folder."""
    known = (*_SETTINGS, *diskcache.core.METADATA)
    places = ", ".join("?" * len(known))
    with contextlib.closing(sqlite3.connect(file, timeout=BUSY_S, isolation_level=None)) as opened:
        _guard(opened)
        opened.execute(f"DELETE FROM Settings WHERE key NOT IN ({places})", known)  # noqa: S608 # constants


def _reading(file: Path) -> sqlite3.Connection:
    """A connection that writes nothing, neither to the file nor beside it."""
    uri = f"file:{quote(str(file.resolve()))}?mode=ro"
    # Without a log of recent writes the file is all there is, and SQLite need not make one.
    if not _size(_beside(file, "-wal")):
        uri += "&immutable=1"
    connection = sqlite3.connect(uri, uri=True, timeout=BUSY_S, isolation_level=None)
    _guard(connection)
    connection.execute("PRAGMA writable_schema = ON")  # it reads on in a file that is cut off
    return connection


def _guard(connection: sqlite3.Connection) -> None:
    """Let a connection read what may be damaged as it is, and follow nothing that it names."""
    connection.text_factory = _as_it_is
    connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, LONGEST)
    connection.execute("PRAGMA trusted_schema = OFF")
    connection.execute("PRAGMA cell_size_check = ON")


def _as_it_is(text: bytes) -> str:
    return text.decode(errors="surrogateescape")


def _refuse_traps(file: Path) -> None:
    """Raise UsageError for what SQLite must not open: links, nothing at all, a trap for others."""
    journal, wal = _beside(file, "-journal"), _beside(file, "-wal")
    for each in (file, journal, wal, _beside(file, "-shm")):
        if each.is_symlink() or (each.exists() and not each.is_file()):
            raise UsageError(
                f"{each} is no file of its own but leads elsewhere: name the folder where the "
                "cache lies with --cache"
            )
    if _size(file) == 0 and (file.exists() or _size(wal)):
        raise UsageError(
            f"{file} is empty: what was recorded and spent is gone from it. Put a copy of it back; "
            f"or, to begin anew with nothing recorded and nothing spent, remove {file.parent} or "
            "name another folder with --cache"
        )
    if _size(journal) and _end(journal, len(_SUPER_JOURNAL)) == _SUPER_JOURNAL:
        raise UsageError(
            f"{journal} names another file, which SQLite would delete: it is not ours. Remove it, "
            f"and take the replies with `merge-runner recording import {file.parent}`"
        )


def _refuse_other_layout(file: Path, connection: sqlite3.Connection) -> None:
    """Raise UsageError unless the file holds a cache's tables, and nothing that could act."""
    made = connection.execute("SELECT sql, name FROM sqlite_master WHERE sql NOT NULL").fetchall()
    found = dict(made)
    if missing := [statement for statement in TABLES if statement not in found]:
        raise UsageError(
            f"{file} is not a cache of merge-runner: "
            f"it lacks {missing[0].partition('(')[0].strip()}"
        )
    if others := [name for sql, name in found.items() if sql not in _LAYOUT]:
        raise UsageError(
            f"{file} holds {one_line(others[0][:40])!r}, which no cache of merge-runner has: it is "
            "not used"
        )


def _beside(file: Path, ending: str) -> Path:
    return file.with_name(file.name + ending)


def _size(file: Path) -> int:
    return file.stat().st_size if file.exists() else 0


def _end(file: Path, length: int) -> bytes:
    with file.open("rb") as opened:
        opened.seek(max(0, _size(file) - length))
        return opened.read()


def _identity(file: Path) -> tuple[int, int]:
    status = os.stat(file)
    return status.st_dev, status.st_ino


def _is_whole(text: str) -> bool:
    """Whether a text was UTF-8; see _as_it_is."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def _name(key: object) -> str:
    if not isinstance(key, str):
        raise RecordingError("the cache holds a key that is no text, which is not ours: refused")
    if not _is_whole(key):
        raise RecordingError("the cache holds a damaged key")
    return key


def _text(mode: object, filename: object, value: object) -> str:
    """The text of a row; raises RecordingError for anything else, which is left unread."""
    if mode == MODE_PICKLE:
        raise RecordingError("the cache holds a pickled value, which is not ours: refused")
    if filename is not None:
        raise RecordingError(
            "the cache names a file in place of a text, which is not ours: refused"
        )
    if mode != MODE_RAW or not isinstance(value, str) or not _is_whole(value):
        raise RecordingError("the recorded reply is damaged: it is no text")
    return value
