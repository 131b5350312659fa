"""Format of a cache folder's file: create it atomically, refuse a foreign one, upgrade it.

Any program may have written the file, and diskcache unpickles keys and values, opens and removes
the files that rows name, and applies the settings it reads. So ``TextDisk`` stores and returns text
only, and a file with unknown settings is refused before diskcache opens it.
"""

from __future__ import annotations

import contextlib
import os
import sqlite3
import tempfile
from contextlib import closing
from pathlib import Path

import diskcache
from diskcache.core import METADATA, MODE_RAW, UNKNOWN

from merge_runner.errors import RecordingError, UsageError
from merge_runner.llm.durable import BUSY_S, ModelLocks, connect, folder_lock
from merge_runner.text_safety import one_line

FILE = "cache.db"
FOREIGN_KEY = "the cache holds a key that is no text: merge-runner did not write it"
LEDGER = "ledger.db"  # of format 5, whose money lay in a file of its own
FORMAT_KEY, FORMAT, BEFORE = "format", "6", "5"
NEW_CACHE = "`merge-runner recording import FILE --cache NEW` makes one from a recording"
SETTINGS = diskcache.DEFAULT_SETTINGS | {
    "eviction_policy": "none",
    "cull_limit": 0,
    "size_limit": 2**62,
    "sqlite_synchronous": 2,  # FULL: an acknowledged reply survives a power cut
    "disk_min_file_size": 2**40,  # everything in the one SQLite file
    "sqlite_mmap_size": 0,  # what is mapped counts as this process's memory
}
FAILURES = (OSError, sqlite3.Error, UnicodeDecodeError)
# ``spent`` has sums, since a sum over all attempts at each reservation would take ever longer.
CREATE_TABLES = (
    """CREATE TABLE spent (
    scope TEXT, driver TEXT, usd REAL NOT NULL, overrun_usd REAL NOT NULL,
    most_overrun REAL NOT NULL, PRIMARY KEY (scope, driver)) STRICT""",
    """CREATE TABLE open (
    scope TEXT, call TEXT, attempt INTEGER, usd REAL NOT NULL, driver TEXT, slot TEXT,
    worst_usd REAL, since TEXT, outcome TEXT) STRICT""",
    "CREATE INDEX open_call ON open (call)",
)


class TextDisk(diskcache.Disk):  # type: ignore[misc] # diskcache ships no types
    """Disk for text only: it unpickles nothing, and touches no file that a row names."""

    def put(self, key: object) -> tuple[str, bool]:
        """Return the key as stored; raise TypeError unless it is text."""
        if not isinstance(key, str):
            raise TypeError("the cache has texts alone as keys")
        return key, True

    def get(self, key: object, raw: object) -> str:
        """Return a stored key; raise RecordingError unless it is text."""
        if not (raw and isinstance(key, str)):
            raise RecordingError(FOREIGN_KEY)
        return key

    def store(self, value: object, read: bool, key: object = UNKNOWN) -> tuple[int, int, None, str]:
        """Return a row's size, mode, file name and value; raise TypeError unless it is text."""
        if not isinstance(value, str):
            raise TypeError("the cache stores texts alone")
        return 0, MODE_RAW, None, value

    def fetch(self, *_: object, **__: object) -> str:
        """Refuse reads by diskcache itself: ``store`` reads and checks the rows."""
        raise RecordingError("diskcache reads no values here")

    def remove(self, file_path: object) -> None:
        """Do nothing: no row of merge-runner names a file."""


def open_texts(folder: Path, *, durable: bool = True) -> diskcache.Cache:
    """Return the diskcache of a folder, and create its file if there is none.

    Its triggers, which count rows and bytes for an eviction, would cost four statements for each
    reply: they are dropped. Rows are counted on closing, and none has a size.
    """
    settings = SETTINGS if durable else SETTINGS | {"sqlite_synchronous": 0}
    texts = diskcache.Cache(str(folder), timeout=BUSY_S, disk=TextDisk, **settings)
    triggers = "SELECT name FROM sqlite_master WHERE type = 'trigger' AND tbl_name = 'Cache'"
    if names := texts._sql(triggers).fetchall():
        with texts.transact(retry=True):
            for name in ('"' + name.replace('"', '""') + '"' for (name,) in names):
                texts._sql(f"DROP TRIGGER {name}")
                # diskcache would recreate a missing trigger. No row of this table is ever deleted.
                texts._sql(f"CREATE TRIGGER {name} DELETE ON Settings BEGIN SELECT 0; END")
    return texts


def close_texts(texts: diskcache.Cache) -> None:
    """Store the number of rows, and close; if it cannot be stored, the old number stays."""
    with contextlib.suppress(*FAILURES):
        ((rows,),) = texts._sql("SELECT count(*) FROM Cache").fetchall()
        if len(texts) != rows:
            texts.reset("count", rows)
    texts.close()


def checked_format(folder: Path) -> bytes:
    """Return the format that a folder's file names.

    Raises UsageError for unknown settings, which diskcache would apply, and for the file of another
    version. A file of the first version names no format.
    """
    sql = "SELECT CAST(value AS BLOB) FROM Cache WHERE key = ? AND raw = 1"
    with closing(connect(folder / FILE)) as connection:
        settings = connection.execute("SELECT key, value FROM Settings").fetchall()
        (mark,) = connection.execute(sql, [FORMAT_KEY]).fetchone() or (b"1",)
    for key, value in settings:
        if key not in METADATA and (key not in SETTINGS or value != SETTINGS[key]):
            name = one_line(repr(key))[:40]
            raise UsageError(f"{folder / FILE} has the setting {name} of another program")
    mark = bytes(mark or b"")
    # Where the mark is damaged, each entry is checked all the same.
    if mark and mark.isascii() and mark not in (FORMAT.encode(), BEFORE.encode()):
        raise UsageError(
            f"the cache {folder} has format {one_line(mark.decode()[:9])}, and this merge-runner "
            f"has format {FORMAT}: {NEW_CACHE}"
        )
    return mark


def make(folder: Path) -> None:
    """Create a folder and its file atomically: an empty file is never taken for new."""
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    folder.chmod(0o700)
    if (folder / FILE).exists():
        return
    with folder_lock(folder), tempfile.TemporaryDirectory(prefix="new-", dir=folder) as new:
        if not (folder / FILE).exists():
            with closing(open_texts(Path(new), durable=False)) as made:
                # The next commit makes all that was written before durable, too.
                made.reset("sqlite_synchronous", SETTINGS["sqlite_synchronous"])
                with made.transact():
                    made.set(FORMAT_KEY, FORMAT)
                    for statement in CREATE_TABLES:
                        made._sql(statement)
            os.replace(Path(new) / FILE, folder / FILE)


def upgrade(folder: Path) -> None:
    """Upgrade a folder of the previous format, with its ledger."""
    locks = ModelLocks(folder)
    with folder_lock(folder), closing(connect(folder / FILE, "rw")) as database, closing(locks):
        if checked_format(folder) == FORMAT.encode():
            return
        if not locks.take_all():
            raise UsageError(f"an older merge-runner works with {folder}: wait until it has ended")
        has_ledger = (folder / LEDGER).is_file() and (folder / LEDGER).stat().st_size > 0
        if has_ledger:
            database.execute("ATTACH ? AS before", [str(folder / LEDGER)])
        with database:
            database.execute("BEGIN IMMEDIATE")
            for statement in CREATE_TABLES:
                database.execute(statement)
            for table in ("spent", "open") if has_ledger else ():
                database.execute(f"INSERT INTO main.{table} SELECT * FROM before.{table}")  # noqa: S608
            sql = "UPDATE Cache SET value = ? WHERE key = ? AND raw = 1"
            database.execute(sql, [FORMAT, FORMAT_KEY])


def prepare(folder: Path, *, read_only: bool, allow_previous: bool) -> None:
    """Create a missing folder, and upgrade one of the previous format; raise UsageError.

    With ``read_only`` it must exist, and may have that format only with ``allow_previous``.
    """
    if read_only:
        require(folder)
    else:
        make(folder)
    if checked_format(folder) == BEFORE.encode() and not allow_previous:
        if read_only:
            raise UsageError(
                f"the cache {folder} has format {BEFORE}: a sweep or a replay with it brings it to "
                f"format {FORMAT}"
            )
        upgrade(folder)


def unusable(folder: Path, why: BaseException) -> UsageError:
    """Return the error for a folder that cannot be opened."""
    return UsageError(f"the cache {folder} cannot be used: {why}. {NEW_CACHE}")


def require(folder: Path) -> None:
    """Raise UsageError unless there is a cache in a folder."""
    if not (folder / FILE).exists():
        raise UsageError(f"there is no cache in {folder}: name one with --cache")
