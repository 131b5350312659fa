"""Portable recordings: the requests and replies of a sweep in one Parquet file.

One row per call: the parts of its key, the exact request body, and all attempts as JSON. The
file's key-value metadata have its provenance. Any Parquet tool can query it.

A recording may come from anybody: nothing in it is executed, it is read in bounded memory, and
nothing of it is added to the cache unless an export could have written the whole file.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import sqlite3
from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import duckdb
from pydantic import TypeAdapter

from merge_runner.errors import RecordingError, UsageError
from merge_runner.llm.cache import ResponseCache
from merge_runner.llm.store import ATTEMPTS, CachedCall, Overlay
from merge_runner.llm.templates import count_by_template
from merge_runner.paths import check_kind
from merge_runner.records import (
    DAMAGED,
    KEY_VERSION,
    Attempt,
    ChatRequest,
    canonical_json,
    check_body,
    check_call,
)
from merge_runner.results import instance
from merge_runner.results.appender import append
from merge_runner.results.database import fetched
from merge_runner.results.instance import Instance, Settings, in_memory
from merge_runner.results.parquet import group_bytes
from merge_runner.results.rows import Row
from merge_runner.text_safety import first_line, quoted

FORMAT = "merge-runner recording 2"
"""Stays readable for ever: a model cannot be asked again after its shutdown."""
PROVENANCE_HASH = "provenance_sha256"
COLUMNS = {
    "call_key": "VARCHAR",
    "provider": "VARCHAR",
    "endpoint": "VARCHAR",
    "model": "VARCHAR",
    "path": "VARCHAR",
    "headers": "VARCHAR",
    "condition": "VARCHAR",
    "repetition": "BIGINT",
    "side": "VARCHAR",
    "decision": "BIGINT",
    "sample_set": "BIGINT",
    "body": "VARCHAR",
    "attempts": "VARCHAR",
}
"""Columns with their SQL types; docs/recordings.md has their meanings."""
SLOT = ("condition", "repetition", "side", "decision", "sample_set")
# Far beyond any sweep; a file that claims more is hostile.
MOST_CALLS = 10_000_000
_CALL = TypeAdapter(CachedCall)
BLOCK, MOST_BLOCK_BYTES = 2048, 2**28
"""Number of rows that DuckDB returns at once, and the maximum bytes of their texts."""
MOST_GROUP_BYTES = 2 * MOST_BLOCK_BYTES
"""Maximum bytes to decode a row group; an export writes about BLOCK rows into one."""
WRITTEN_AT_ONCE = 16
READER_SETTINGS: Settings = {
    **instance.SETTINGS,
    "autoinstall_known_extensions": False,
    "autoload_known_extensions": False,
    "threads": 1,
    "enable_external_file_cache": False,  # a file may be replaced
}
READER = Instance(READER_SETTINGS)


def export_recording(
    file: Path, cache: ResponseCache, keys: list[str], provenance: dict[str, str]
) -> int:
    """Write the calls with these keys in this order, and return their number.

    Raises RecordingError. Damaged calls are left out; the error names them after the others are
    written.
    """
    if file.is_dir():
        raise UsageError(f"{file} is a folder: name a file")
    check_kind(file, b"PAR1", "recording")
    damaged: list[str] = []
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with (
            TemporaryDirectory(prefix=".recording-", dir=file.parent) as folder,
            in_memory(READER_SETTINGS) as connection,
        ):
            connection.execute(f"ATTACH {quoted(f'{folder}/calls.duckdb')} AS file; USE file")
            columns = ", ".join(f"{name} {kind}" for name, kind in COLUMNS.items())
            connection.execute(f"CREATE TABLE calls ({columns})")
            content, rows = hashlib.sha256(), _exported_rows(cache, keys, damaged)
            while chunk := list(islice(rows, WRITTEN_AT_ONCE)):
                append(connection, "calls", chunk)
                for row in chunk:
                    content.update(_fingerprint(row[0], row[-1]))
            metadata = {
                **provenance,
                "format": FORMAT,
                "key_version": str(KEY_VERSION),
                "calls": str(len(keys) - len(damaged)),
                "content_sha256": content.hexdigest(),
            }
            metadata[PROVENANCE_HASH] = _provenance_hash(metadata)
            pairs = ", ".join(f"{quoted(name)}: {quoted(text)}" for name, text in metadata.items())
            options = f"COMPRESSION zstd, ROW_GROUP_SIZE {BLOCK}, KV_METADATA {{{pairs}}}"
            connection.execute(
                f"COPY calls TO {quoted(f'{folder}/calls.parquet')} (FORMAT parquet, {options})"
            )
            os.replace(f"{folder}/calls.parquet", file)  # so that no reader sees half a file
    except (OSError, duckdb.Error) as exc:
        raise RecordingError(f"{file} cannot be written: {exc}") from exc
    if damaged:
        raise RecordingError(
            f"{len(damaged)} of {len(keys)} replies are damaged and left out of {file}, the first "
            f"is {damaged[0]}. The other {len(keys) - len(damaged)} are in it; a sweep into "
            "another database, named with --db, asks for the damaged ones again"
        )
    return len(keys)


def _exported_rows(cache: ResponseCache, keys: list[str], damaged: list[str]) -> Iterator[Row]:
    """Yield the rows of the calls with these keys; add errors of damaged calls to ``damaged``."""
    for key in keys:
        try:
            entry = cache.get(key)
        except RecordingError as exc:
            damaged.append(f"{key}: {exc}")
            continue
        if entry is None:
            raise RecordingError(
                f"the reply {key} is not in the cache {cache.folder}: its run replayed a "
                "recording, which holds it, or had another --cache. --sweep ID names another run"
            )
        columns = asdict(entry.request)
        columns |= columns.pop("slot") | {
            "call_key": key,
            "headers": json.dumps(entry.request.headers, sort_keys=True),
            "attempts": ATTEMPTS.dump_json(entry.attempts).decode(),
        }
        yield tuple(columns[name] for name in COLUMNS)


def read_recording(file: Path) -> Iterator[CachedCall]:
    """Yield all calls of a recording, each verified; raises RecordingError."""
    seen: set[str] = set()
    content = hashlib.sha256()
    with opened(file) as (connection, metadata):
        rows = connection.execute(f"SELECT {', '.join(COLUMNS)} FROM recording")  # noqa: S608 # constants
        for number, values in enumerate(fetched(rows), 1):
            try:
                entry = _entry(dict(zip(COLUMNS, values, strict=True)))
            except (RecordingError, *DAMAGED) as exc:
                raise RecordingError(f"{file}: row {number} is damaged: {first_line(exc)}") from exc
            if entry.request.key in seen:
                raise RecordingError(f"{file}: row {number} repeats {entry.request.key}")
            seen.add(entry.request.key)
            content.update(_fingerprint(values[0], values[-1]))
            yield entry
    actual = {"calls": str(len(seen)), "content_sha256": content.hexdigest()}
    is_complete = metadata == metadata | actual
    if not is_complete or metadata.get(PROVENANCE_HASH) != _provenance_hash(metadata):
        raise RecordingError(
            f"{file} is not as it was exported: its calls, or what it says of where it comes from, "
            "have another hash"
        )


@contextmanager
def spilled(files: Iterable[Path]) -> Iterator[Overlay]:
    """Open recordings as their verified calls by key, with a count of their kinds.

    Raises RecordingError, also for two recordings with different replies to one call.
    """
    with closing(sqlite3.connect("", check_same_thread=False)) as db:
        db.execute("CREATE TABLE entries (key TEXT PRIMARY KEY, entry TEXT)")
        yield Spilled(db), count_by_template(_spill(files, db))


def _spill(files: Iterable[Path], db: sqlite3.Connection) -> Iterator[tuple[ChatRequest, Attempt]]:
    """Write the calls of recordings, and yield the request and the last attempt of each."""
    entries = Spilled(db)
    for file in files:
        for entry in read_recording(file):
            key, last = entry.request.key, entry.attempts[-1]
            before = entries.get(key)
            if before is None:
                db.execute("INSERT INTO entries VALUES (?, ?)", (key, entry.to_json()))
                yield entry.request, last
            elif before.attempts[-1].reply != last.reply:
                raise RecordingError(
                    f"{file} holds another reply to the call {key} than a recording named "
                    "before it: replay them one by one, each into a --db of its own"
                )


@dataclass(frozen=True, slots=True, eq=False)
class Spilled(Mapping[str, CachedCall]):
    """Calls by key in a temporary database, which SQLite moves into a file when it is large."""

    _db: sqlite3.Connection

    def __getitem__(self, key: str) -> CachedCall:
        row = self._db.execute("SELECT entry FROM entries WHERE key = ?", [key]).fetchone()
        if row is None:
            raise KeyError(key)
        return CachedCall.from_json(row[0])

    def __contains__(self, key: object) -> bool:
        row = self._db.execute("SELECT 1 FROM entries WHERE key = ?", [key]).fetchone()
        return row is not None

    def __iter__(self) -> Iterator[str]:
        return (key for (key,) in self._db.execute("SELECT key FROM entries"))

    def __len__(self) -> int:
        return int(self._db.execute("SELECT count(*) FROM entries").fetchone()[0])


def import_recording(file: Path, cache: ResponseCache) -> tuple[int, int]:
    """Verify the whole file, then add the calls that the cache lacks; return (added, present).

    The file is read twice, so that nothing is added from a file that is damaged at its end.
    """
    for _ in read_recording(file):
        pass
    return cache.add_missing(read_recording(file))


def _fingerprint(key: str, attempts: str) -> bytes:
    """Return the part of a row that the recording's hash covers; the key covers the rest."""
    return f"{key} {attempts}\n".encode()


def _provenance_hash(metadata: dict[str, str]) -> str:
    hashed = {name: text for name, text in metadata.items() if name != PROVENANCE_HASH}
    return hashlib.sha256(canonical_json(hashed).encode()).hexdigest()


def _entry(row: dict[str, Any]) -> CachedCall:
    """Return the call of a row after a check against its key; raises one of DAMAGED."""
    check_body(row["body"])
    request = {name: row[name] for name in ("provider", "endpoint", "model", "path", "body")}
    request |= {"key": row["call_key"], "slot": {name: row[name] for name in SLOT}}
    request["headers"] = json.loads(row["headers"])
    # Attempts are read as they are written: within other JSON they could end it.
    attempts = ATTEMPTS.validate_json(row["attempts"], strict=True)
    entry = _CALL.validate_python({"request": request, "attempts": attempts})
    check_call(entry.request.key, entry.request, entry.attempts)
    return entry


@contextmanager
def opened(file: Path) -> Iterator[tuple[duckdb.DuckDBPyConnection, dict[str, str]]]:
    """Open a recording as the view ``recording`` with its metadata, neither of them verified.

    Raises RecordingError.
    """
    if not file.is_file():
        raise UsageError(f"there is no recording {file}")
    # Escaped, so that the pattern matches this file only.
    pattern = quoted(re.sub(r"([*?\[])", r"[\1]", str(file.resolve())))
    with READER.cursor() as connection:
        try:
            connection.execute(
                "CREATE TEMP VIEW recording AS FROM "
                f"read_parquet({pattern}, file_row_number = true, hive_partitioning = false)"
            )
            columns = connection.execute("DESCRIBE recording").fetchall()
            if {name: kind for name, kind, *_ in columns if name != "file_row_number"} != COLUMNS:
                raise RecordingError(
                    f"{file} is not one of our recordings: it has other columns than "
                    f"{', '.join(f'{name} {kind}' for name, kind in COLUMNS.items())}"
                )
            pairs = connection.execute(
                f"SELECT key, value FROM parquet_kv_metadata({pattern})"  # noqa: S608 # quoted
            ).fetchall()
            metadata = {key.decode(): value.decode() for key, value in pairs}
            versions = metadata.get("format"), metadata.get("key_version")
            if versions != (FORMAT, str(KEY_VERSION)):
                raise RecordingError(
                    f"{file} has the format {versions[0]!r} with keys of version {versions[1]!r}, "
                    f"this program reads {FORMAT!r} with keys of version {KEY_VERSION}"
                )
            _check_sizes(file, pattern, connection)
            yield connection, metadata
        except (duckdb.Error, UnicodeDecodeError) as exc:
            READER.drop()
            raise RecordingError(
                f"{file} is damaged, or no Parquet file: {first_line(exc)}"
            ) from exc


def _check_sizes(file: Path, pattern: str, connection: duckdb.DuckDBPyConnection) -> None:
    """Raise RecordingError for more rows or longer texts than recordings have.

    The size of the decoded data is known before anything is decoded.
    """
    not_ours = f"{file} is not one of our recordings"
    ((calls,),) = connection.execute("SELECT count(*) FROM recording").fetchall()
    if calls > MOST_CALLS:  # the footer's claim, before any row is read
        raise RecordingError(f"{not_ours}: it claims {calls} calls")
    try:
        largest = max(group_bytes(file, pattern, connection), default=0)
    except ValueError as exc:
        raise RecordingError(f"{not_ours}: {exc}") from exc
    if largest > MOST_GROUP_BYTES:
        raise RecordingError(f"{not_ours}: a row group of it unpacks to {largest} bytes")
    texts = (name for name, kind in COLUMNS.items() if kind == "VARCHAR")
    bytes_of_row = " + ".join(f"coalesce(strlen({name}), 0)" for name in texts)
    blocks = (
        f"SELECT sum({bytes_of_row}) FROM recording GROUP BY file_row_number // {BLOCK} "  # noqa: S608 # constants
        "ORDER BY 1 DESC"
    )
    (longest,) = connection.execute(blocks).fetchone() or (0,)
    if longest > MOST_BLOCK_BYTES:
        raise RecordingError(f"{not_ours}: it has {longest} bytes in {BLOCK} calls")


def read_provenance(file: Path) -> dict[str, str]:
    """Return a recording's metadata, not verified; raises RecordingError."""
    with opened(file) as (_, metadata):
        return metadata
