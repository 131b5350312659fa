"""The file under the cache: texts by name, in one SQLite file as diskcache lays it out.

The file may be damaged, or somebody else's, so nothing in it is executed and no name in it is
followed. diskcache itself applies settings that it finds in a file, reads the files that rows
name, and deletes them with their rows: its layout alone is used, which earlier versions made.
"""

from __future__ import annotations

import contextlib
import os
import sqlite3
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import quote

from merge_runner.errors import RecordingError, UsageError
from merge_runner.texts import one_line

FILE = "cache.db"
FORMAT = 4
_FORMAT, _OPENED = "format", "opened"
BUSY_S = 600.0
LONGEST = 2**28
"""A row of more bytes was made to harm."""
# How reading and writing fail; UnicodeDecodeError where SQLite quotes what is damaged.
FAILURES = (OSError, sqlite3.Error, UnicodeDecodeError)
# What a row says of its value: that it is a text in the row itself, or a pickle.
_RAW, _PICKLE = 1, 4
# How a journal ends that names a file which SQLite deletes once it has rolled the journal back.
_SUPER_JOURNAL = bytes.fromhex("d9d505f920a163d7")
_COUNTS = {  # what diskcache counts when a row comes, changes or goes
    ("count", "insert"): "+ 1",
    ("count", "delete"): "- 1",
    ("size", "insert"): "+ NEW.size",
    ("size", "update"): "+ NEW.size - OLD.size",
    ("size", "delete"): "- OLD.size",
}
LAYOUT = (
    "CREATE TABLE Settings ( key TEXT NOT NULL UNIQUE, value)",
    "CREATE TABLE Cache ( rowid INTEGER PRIMARY KEY, key BLOB, raw INTEGER, store_time REAL, "
    "expire_time REAL, access_time REAL, access_count INTEGER DEFAULT 0, tag BLOB, "
    "size INTEGER DEFAULT 0, mode INTEGER DEFAULT 0, filename TEXT, value BLOB)",
    "CREATE UNIQUE INDEX Cache_key_raw ON Cache(key, raw)",
    *(
        f"CREATE TRIGGER Settings_{what}_{event} AFTER {event.upper()} ON Cache FOR EACH ROW BEGIN "  # noqa: S608 # constants
        f'UPDATE Settings SET value = value {change} WHERE key = "{what}"; END'
        for (what, event), change in _COUNTS.items()
    ),
)
_INDEXES = {  # which diskcache makes besides, as it is set
    *(
        f"CREATE INDEX Cache_{column} ON Cache ({column})"
        for column in ("expire_time", "store_time", "access_time", "access_count")
    ),
    "CREATE INDEX Cache_tag_rowid ON Cache(tag, rowid)",
}
_GET = "SELECT mode, filename, typeof(value), value FROM Cache WHERE key = ? AND raw = 1"
_CALL = (
    "SELECT CASE WHEN raw = 1 AND typeof(key) = 'text' THEN key END, mode, filename, "
    "typeof(value), value FROM Cache WHERE rowid = ?"
)
# With others diskcache would throw replies out, where a user opens the file with it.
_SETTINGS = {
    "eviction_policy": "none",
    "cull_limit": 0,
    "size_limit": 2**62,
    "sqlite_synchronous": 2,
    "disk_min_file_size": 2**40,
}


class TextDisk:
    """The texts of a folder's file; a connection for each thread."""

    def __init__(self, folder: Path, *, read_only: bool = False) -> None:
        """Open the file; raises UsageError for one that no cache has, sqlite3.Error, OSError."""
        self._file = folder / FILE
        self._mode = "ro" if read_only else "rw"
        self._local = threading.local()
        self._connections: list[sqlite3.Connection] = []
        _refuse_traps(self._file)
        try:
            _refuse_other_layout(self._file, self._connection)
        except (UsageError, *FAILURES):
            self.close()  # and nothing is left beside it
            raise
        self._own = _identity(self._file)  # that of the file which was opened to be written

    def get(self, name: str) -> str | None:
        """The text under a name; raises RecordingError where it is none of ours."""
        try:
            row = self._connection.execute(_GET, (name,)).fetchone()
        except sqlite3.DataError as exc:
            raise RecordingError(f"the recorded reply is damaged: {exc}") from exc
        return None if row is None else _text(*row)

    def set(self, name: str, text: str) -> None:
        """Keep a text, in place of any other."""
        self._insert("DO UPDATE SET mode = 1, filename = NULL, expire_time = NULL, "
                     "value = excluded.value", name, text)  # fmt: skip

    def add(self, name: str, text: str) -> bool:
        """Keep a text; False where there is one already."""
        return self._insert("DO NOTHING", name, text) == 1

    def delete(self, name: str) -> None:
        """Forget a text."""
        self._execute("DELETE FROM Cache WHERE key = ? AND raw = 1", name)

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
        return [key.decode() for (key,) in found.fetchall() if _is_utf8(key)]

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
        connection = self._connection
        connection.execute("BEGIN IMMEDIATE")
        try:
            yield
            if not self.in_place:
                raise FileNotFoundError("it is no longer there")
            connection.execute("COMMIT")
        except BaseException:
            with contextlib.suppress(sqlite3.Error):  # what came first is told
                connection.execute("ROLLBACK")
            raise

    def take(self) -> None:
        """See that the file can be written, and that diskcache throws no reply out of it."""
        self._execute("PRAGMA journal_mode = WAL")
        with self.transaction():
            for pair in _SETTINGS.items():
                self._execute("REPLACE INTO Settings VALUES (?, ?)", *pair)
            self.set(_OPENED, "")

    @property
    def in_place(self) -> bool:
        """Whether the file is still the one that was opened: SQLite writes on where it is gone."""
        try:
            return _identity(self._file) == self._own
        except OSError:
            return False

    def close(self) -> None:
        """Close all connections."""
        for connection in self._connections:
            connection.close()
        self._connections.clear()
        self._local = threading.local()

    @property
    def _connection(self) -> sqlite3.Connection:
        opened: sqlite3.Connection | None = getattr(self._local, "connection", None)
        if opened is None:
            opened = self._local.connection = _connect(self._file, self._mode)
            self._connections.append(opened)
        return opened

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

    def _insert(self, on_conflict: str, name: str, text: str) -> int:
        if not isinstance(text, str):
            raise TypeError("the cache stores text only")
        now = time.time()
        return self._execute(
            "INSERT INTO Cache (key, raw, store_time, access_time, mode, value) "  # noqa: S608 # constants
            f"VALUES (?, 1, ?, ?, {_RAW}, ?) ON CONFLICT (key, raw) {on_conflict}",
            *(name, now, now, text),
        ).rowcount

    def _free(self, name: str) -> str:
        """The name, or with the first number behind it under which nothing lies yet."""
        taken, number = set(self.names(name)), 2
        free = name
        while free in taken:
            free, number = f"{name} {number}", number + 1
        return free


def open_disk(folder: Path) -> TextDisk:
    """Open or make the folder and see that it can be written.

    Raises UsageError for a folder that cannot be used, is damaged, or is of a newer format.
    """
    with usable(folder):
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        folder.chmod(0o700)
        if not (folder / FILE).exists():
            _refuse_traps(folder / FILE)
            _make(folder / FILE)
        disk = TextDisk(folder)
        version = format_of(disk)
        if version <= FORMAT:
            disk.take()
    if version > FORMAT:
        raise UsageError(
            f"the cache {folder} has format {version}, written by a newer merge-runner; this one "
            f"reads up to {FORMAT}: update merge-runner, or name another with --cache"
        )
    return disk


def open_read_only(folder: Path) -> TextDisk:
    """Open a folder, maybe somebody else's, to read it alone; raises UsageError."""
    if not (folder / FILE).exists():
        raise UsageError(f"there is no cache in {folder}")
    with usable(folder):
        return TextDisk(folder, read_only=True)


def format_of(disk: TextDisk) -> int:
    """The format of a folder; the first one had no mark, and a damaged one is taken for that."""
    try:
        mark = disk.get(_FORMAT) or ""
    except RecordingError:
        mark = ""
    return int(mark) if mark.isascii() and mark.isdigit() else 1


def set_format(disk: TextDisk) -> None:
    """Mark a folder as one of this program's format."""
    disk.set(_FORMAT, str(FORMAT))


@contextlib.contextmanager
def usable(folder: Path) -> Iterator[None]:
    """Raise UsageError for what SQLite and the system say of a folder."""
    try:
        yield
    except FAILURES as exc:
        raise UsageError(
            f"the cache {folder} cannot be used: {exc}. Mend or move the folder, or name another "
            f"with --cache; `merge-runner recording import {folder}` takes what can be read of it "
            "into that one, as it takes a recording"
        ) from exc


def _make(file: Path) -> None:
    """Make the file whole or not at all, so that an empty one was not just made by somebody."""
    with tempfile.TemporaryDirectory(prefix="new-", dir=file.parent) as folder:
        _lay_out(Path(folder) / FILE)
        try:
            os.link(Path(folder) / FILE, file)
        except FileExistsError:
            pass  # another process was quicker
        except OSError:  # a file system without links
            _lay_out(file)
    descriptor = os.open(file.parent, os.O_RDONLY)
    os.fsync(descriptor)
    os.close(descriptor)


def _lay_out(file: Path) -> None:
    with contextlib.closing(_connect(file, "rwc")) as connection:
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("BEGIN IMMEDIATE")
        if connection.execute("SELECT 1 FROM sqlite_master").fetchone() is None:
            for statement in LAYOUT:
                connection.execute(statement)
            connection.execute("INSERT INTO Settings VALUES ('count', 0), ('size', 0)")
            connection.execute(
                "INSERT INTO Cache (key, raw, mode, value) VALUES (?, 1, ?, ?)",
                (_FORMAT, _RAW, str(FORMAT)),
            )
        connection.execute("COMMIT")


def _connect(file: Path, mode: str) -> sqlite3.Connection:
    uri = f"file:{quote(str(file.resolve()))}?mode={mode}"
    if mode == "ro" and not _size(_beside(file, "-wal")):
        uri += "&immutable=1"  # nothing at all is written beside it
    connection = sqlite3.connect(
        uri, uri=True, timeout=BUSY_S, isolation_level=None, check_same_thread=False
    )
    connection.text_factory = bytes  # a text may be damaged
    connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, LONGEST)
    connection.execute("PRAGMA trusted_schema = OFF")
    connection.execute("PRAGMA cell_size_check = ON")
    if mode == "ro":
        connection.execute("PRAGMA writable_schema = ON")  # it reads on in a file that is cut off
    connection.execute("PRAGMA synchronous = FULL")  # what is acknowledged survives a power cut
    connection.execute("PRAGMA cache_size = 8192")  # pages: a replay reads all over the file
    connection.execute("PRAGMA mmap_size = 0")  # what is mapped counts as this process's memory
    return connection


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
    made = connection.execute("SELECT name, sql FROM sqlite_master WHERE sql NOT NULL").fetchall()
    found = {sql.decode(errors="replace"): name.decode(errors="replace") for name, sql in made}
    if missing := [statement for statement in LAYOUT[:3] if statement not in found]:
        raise UsageError(
            f"{file} is no cache of merge-runner: it lacks {missing[0].partition('(')[0].strip()}"
        )
    if others := [name for sql, name in found.items() if sql not in {*LAYOUT, *_INDEXES}]:
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


def _is_utf8(text: bytes) -> bool:
    try:
        text.decode()
    except UnicodeDecodeError:
        return False
    return True


def _name(key: object) -> str:
    if not isinstance(key, bytes):
        raise RecordingError("the cache holds a key that is no text, which is not ours: refused")
    if not _is_utf8(key):
        raise RecordingError("the cache holds a damaged key")
    return key.decode()


def _text(mode: object, filename: object, kind: object, value: object) -> str:
    """The text of a row; raises RecordingError for anything else, which is left unread."""
    if mode == _PICKLE:
        raise RecordingError("the cache holds a pickled value, which is not ours: refused")
    if filename is not None:
        raise RecordingError(
            "the cache names a file in place of a text, which is not ours: refused"
        )
    if mode != _RAW or kind != b"text" or not isinstance(value, bytes):
        raise RecordingError("the recorded reply is damaged: it is no text")
    try:
        return value.decode()
    except UnicodeDecodeError as exc:
        raise RecordingError(
            f"the recorded reply is damaged: it is no text ({exc.reason})"
        ) from exc
