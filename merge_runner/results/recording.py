"""Portable recordings: what a sweep asked and was answered, as one Parquet file.

One row per call: the parts of its key, the exact request body, and all attempts as JSON. The
file's key-value metadata hold where it comes from. Any Parquet tool can query it.

A recording may come from anybody: nothing in it is executed, it is read in bounded memory, and
nothing of it is added to the cache unless the whole file is one that an export could have written.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import sqlite3
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import astuple, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import duckdb
from pydantic import TypeAdapter, ValidationError

from merge_runner.errors import RecordingError, UsageError
from merge_runner.llm.cache import ATTEMPTS, CachedCall, ResponseCache
from merge_runner.llm.content_hashes import KEY_VERSION, call_key, canonical_json
from merge_runner.llm.verify import DAMAGED, check_attempts, check_body, check_slot
from merge_runner.paths import refuse_another_kind
from merge_runner.records import SIDES, ChatRequest, Slot, is_scripted
from merge_runner.results.database import Settings, append, in_memory
from merge_runner.text_safety import first_line, one_line, quoted

FORMAT = "merge-runner recording 2"
"""Read for ever: a model that is shut down cannot be asked again."""
PROVENANCE_HASH = "provenance_sha256"
SWEEPS = "sweeps"
"""Holds the rows of several sweeps; a recording of one sweep has the columns of its row instead."""
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
MEANINGS = {
    "call_key": "SHA-256 of the parts of the call's key: endpoint, path, headers, body and slot",
    "provider": "whose format was spoken",
    "endpoint": "where the call went, without a key; a name for a provider's own",
    "model": "the id that was asked for",
    "path": "of the request, below the base URL",
    "headers": "JSON object: those that change an answer; never a key",
    "condition": "slot: of the experiment",
    "repetition": "slot: from 1",
    "side": "slot: left or right",
    "decision": "slot: counts those of this driver from 0",
    "sample_set": "slot: another number is a fresh set of samples",
    "body": "the exact JSON that was sent",
    "attempts": "JSON array: number, outcome, status, reply, tokens, cost and time of each attempt",
}
"""What the columns mean, for docs/reference/recordings.md."""
TEXTS = [name for name, kind in COLUMNS.items() if kind == "VARCHAR"]
BATCH = 1_000
HEADERS = TypeAdapter(dict[str, str])
ROWS = TypeAdapter(list[dict[str, str]])
# Far beyond any sweep; a file that claims more was made to do harm.
MOST_CALLS = 10_000_000
BLOCK, MOST_BLOCK_BYTES = 2048, 2**28
"""DuckDB hands out this many rows at once, and their texts may have this many bytes."""
PART_BYTES, GROUP_BYTES = 2**25, 2**27
"""What is written at once, and what one group of rows of the file holds if it may."""
READING: Settings = {
    "autoinstall_known_extensions": False,
    "autoload_known_extensions": False,
    "memory_limit": "1GB",  # unpacked bytes count, too
    "threads": 1,
}


@dataclass(frozen=True, slots=True)
class Summary:
    """A recording's contents: its calls, how many of them a scripted stand-in answered, and so on.

    ``cost_usd`` is what its replies cost when they were made.
    """

    calls: int
    scripted: int
    attempts: int
    cost_usd: float
    models_requested: dict[str, int]
    models_served: dict[str, int]
    endpoints: dict[str, int]
    outcomes: dict[str, int]
    provenance: dict[str, str]


def export_recording(
    file: Path, cache: ResponseCache, keys: list[str], provenance: dict[str, str]
) -> int:
    """Write the entries under these keys; returns their number. Raises RecordingError.

    Damaged entries are left out; once the others are written, the error names them.
    """
    ordered, damaged = _in_order(cache, keys)
    if file.is_dir():
        raise UsageError(f"{file} is a folder: name a file")
    refuse_another_kind(file, b"PAR1", "recording")
    with _written(file), TemporaryDirectory(prefix=f".{file.name}-", dir=file.parent) as folder:
        _write_parts(Path(folder), file, (cache.get(key) for key in ordered), provenance)
    if damaged:
        key, reason = next(iter(damaged.items()))
        raise RecordingError(
            f"{len(damaged)} of {len(keys)} replies are damaged and left out of {file}, the first "
            f"is {key}: {reason}. The other {len(ordered)} are in it; a sweep into another "
            "database, named with --db, asks for the damaged ones again"
        )
    return len(keys)


def _write_parts(
    folder: Path, file: Path, entries: Iterable[CachedCall | None], provenance: dict[str, str]
) -> None:
    """Write the entries part by part into the folder, and all of them as the file."""
    partial = file.with_name(file.name + ".partial")  # so that no reader sees half a file
    content, calls, size = hashlib.sha256(), 0, 0
    with in_memory(READING) as connection:
        columns = ", ".join(f"{name} {kind}" for name, kind in COLUMNS.items())
        connection.execute(f"CREATE TABLE calls ({columns})")
        rows = (_row(entry) for entry in entries if entry)
        for part, some in enumerate(_of_bounded_size(rows)):
            for row in some:
                content.update(_fingerprint(row[0], row[-1]))
                size += _size(row)
            calls += len(some)
            append(connection, "calls", some)
            connection.execute(
                f"COPY calls TO {quoted(f'{folder}/{part:06}.parquet')} (COMPRESSION snappy)"
            )
            connection.execute("DELETE FROM calls")
        metadata = {
            **provenance,
            "format": FORMAT,
            "key_version": str(KEY_VERSION),
            "calls": str(calls),
            "content_sha256": content.hexdigest(),
        }
        metadata[PROVENANCE_HASH] = _provenance_hash(metadata)
        pairs = ", ".join(f"{quoted(name)}: {quoted(text)}" for name, text in metadata.items())
        group = max(BLOCK, min(10240, GROUP_BYTES * calls // max(1, size)))
        parts = f"{_pattern(folder)[:-1]}/*.parquet', hive_partitioning = false"
        source = f"read_parquet({parts})" if calls else "calls"
        connection.execute(
            f"COPY (FROM {source}) TO {quoted(str(partial))} "
            f"(FORMAT parquet, COMPRESSION zstd, ROW_GROUP_SIZE {group}, KV_METADATA {{{pairs}}})"
        )
        os.replace(partial, file)


def _in_order(cache: ResponseCache, keys: list[str]) -> tuple[list[str], dict[str, str]]:
    """The keys in the order of condition, repetition, side, decision, sample set and key.

    Also returns the keys of damaged entries, with what is wrong with each. Raises RecordingError
    if a key is not in the cache.
    """
    places, missing, damaged = [], [], {}
    for key in keys:
        try:
            entry = cache.get(key)
        except RecordingError as exc:
            damaged[key] = str(exc)
            continue
        if entry is None:
            missing.append(key)
        else:
            places.append((*astuple(entry.request.slot), key))
    if missing:
        raise RecordingError(
            f"{len(missing)} of {len(keys)} replies are not in the cache {cache.folder}, the first "
            f"is {missing[0]}: run the sweep again with this cache"
        )
    return [key for *_, key in sorted(places)], damaged


def _of_bounded_size(rows: Iterable[tuple[Any, ...]]) -> Iterator[list[tuple[Any, ...]]]:
    """The rows in lists of bounded size, each of at least one row."""
    batch: list[tuple[Any, ...]] = []
    size = 0
    for row in rows:
        batch.append(row)
        size += _size(row)
        if size >= PART_BYTES or len(batch) == 10 * BATCH:
            yield batch
            batch, size = [], 0
    if batch:
        yield batch


def _size(row: tuple[Any, ...]) -> int:
    return len(row[-2]) + len(row[-1])


def read_recording(file: Path) -> Iterator[CachedCall]:
    """All entries of a recording, each verified against its key; raises RecordingError."""
    with opened(file) as connection:
        with readable(file):
            rows = connection.execute(f"SELECT {', '.join(COLUMNS)} FROM recording")  # noqa: S608 # constants
        seen: set[str] = set()
        content = hashlib.sha256()
        number = 0
        while batch := _fetch(rows, file):
            for values in batch:
                number += 1
                entry = _verified(file, number, dict(zip(COLUMNS, values, strict=True)))
                if entry.request.key in seen:
                    raise RecordingError(f"{file}: row {number} repeats {entry.request.key}")
                seen.add(entry.request.key)
                content.update(_fingerprint(values[0], values[-1]))
                yield entry
        told = _metadata(file, connection)
    if (str(number), content.hexdigest()) != (told.get("calls"), told.get("content_sha256")):
        raise RecordingError(
            f"{file} is not as it was exported: it holds {number} calls of {told.get('calls')}, "
            "and its content has another hash"
        )
    if told.get(PROVENANCE_HASH) != _provenance_hash(told):
        raise RecordingError(
            f"{file} is not as it was exported: what it says of where it comes from has another "
            "hash"
        )


class Spilled(Mapping[str, CachedCall]):
    """The verified entries of recordings by key; SQLite keeps large ones in a temporary file.

    Raises RecordingError, also where two recordings hold different replies to one call.
    """

    def __init__(self, files: Iterable[Path]) -> None:
        self._db = sqlite3.connect("", check_same_thread=False)
        self._db.execute("CREATE TABLE entries (key TEXT PRIMARY KEY, entry TEXT)")
        for file in files:
            rows = self._alike(file)
            self._db.executemany("INSERT OR IGNORE INTO entries VALUES (?, ?)", rows)

    def __getitem__(self, key: str) -> CachedCall:
        row = self._db.execute("SELECT entry FROM entries WHERE key = ?", [key]).fetchone()
        if row is None:
            raise KeyError(key)
        return CachedCall.from_json(row[0])

    def __contains__(self, key: object) -> bool:
        found = self._db.execute("SELECT 1 FROM entries WHERE key = ?", [key])
        return found.fetchone() is not None

    def __iter__(self) -> Iterator[str]:
        return (key for (key,) in self._db.execute("SELECT key FROM entries"))

    def _alike(self, file: Path) -> Iterator[tuple[str, str]]:
        """Keys and entries of another file, none of which says otherwise than those before."""
        for entry in read_recording(file):
            key = entry.request.key
            before = self.get(key)
            if before and before.attempts[-1].reply != entry.attempts[-1].reply:
                raise RecordingError(
                    f"{file} holds another reply to the call {key} than a recording named before "
                    "it: replay them one by one, each into a --db of its own"
                )
            yield key, entry.to_json()

    def __len__(self) -> int:
        count: int = self._db.execute("SELECT count(*) FROM entries").fetchone()[0]
        return count


def import_recording(file: Path, cache: ResponseCache) -> tuple[int, int]:
    """Verify the whole file, then add what the cache lacks; returns (added, already there).

    The file is read twice, so that nothing of a file whose damage shows only at its end is added.
    """
    for _ in read_recording(file):
        pass
    return cache.add_missing(read_recording(file))


def summarise(file: Path) -> Summary:
    """Verify a recording and count what it holds."""
    requested, served, endpoints, outcomes = (Counter[str]() for _ in range(4))
    calls = attempts = scripted = 0
    cost = 0.0
    for entry in read_recording(file):
        calls += 1
        scripted += is_scripted(entry.request, entry.attempts[-1])
        attempts += len(entry.attempts)
        cost += sum(attempt.cost_usd or 0.0 for attempt in entry.attempts)
        requested[entry.request.model] += 1
        served[entry.attempts[-1].model_served or "unknown"] += 1
        endpoints[entry.request.endpoint] += 1
        outcomes[entry.attempts[-1].outcome] += 1
    return Summary(
        calls=calls,
        scripted=scripted,
        attempts=attempts,
        cost_usd=round(cost, 6),
        models_requested=dict(requested),
        models_served=dict(served),
        endpoints=dict(endpoints),
        outcomes=dict(outcomes),
        provenance=read_provenance(file),
    )


@contextmanager
def _written(file: Path) -> Iterator[None]:
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        yield
    except (OSError, duckdb.Error) as exc:
        raise RecordingError(f"{file} cannot be written: {exc}") from exc


def _fingerprint(key: str, attempts: str) -> bytes:
    """The part of a row that the recording's hash covers directly; the key covers the rest."""
    return f"{key} {attempts}\n".encode()


def _provenance_hash(metadata: dict[str, str]) -> str:
    """A hash of everything that a file says about itself."""
    told = {name: text for name, text in metadata.items() if name != PROVENANCE_HASH}
    return hashlib.sha256(canonical_json(told).encode()).hexdigest()


def _row(entry: CachedCall) -> tuple[Any, ...]:
    request, slot = entry.request, entry.request.slot
    return (
        request.key,
        request.provider,
        request.endpoint,
        request.model,
        request.path,
        json.dumps(request.headers, sort_keys=True),
        slot.condition,
        slot.repetition,
        slot.side,
        slot.decision,
        slot.sample_set,
        request.body,
        ATTEMPTS.dump_json(entry.attempts).decode(),
    )


def _verified(file: Path, number: int, row: dict[str, Any]) -> CachedCall:
    try:
        entry = _entry(row)
    except DAMAGED as exc:
        raise RecordingError(f"{file}: row {number} is damaged: {first_line(exc)}") from exc
    if entry.request.key != row["call_key"]:
        raise RecordingError(f"{file}: the content of row {number} does not belong to its key")
    if not entry.attempts:
        raise RecordingError(f"{file}: row {number} holds no reply")
    return entry


def _entry(row: dict[str, Any]) -> CachedCall:
    """The entry of a row, under the key of its content; raises one of DAMAGED."""
    if empty := [name for name, value in row.items() if value is None]:
        raise ValueError(f"it has no {', '.join(empty)}")
    if row["side"] not in SIDES:
        raise ValueError(f"its side is none of {', '.join(SIDES)}")
    check_body(row["body"])
    slot = Slot(
        row["condition"], row["repetition"], row["side"], row["decision"], row["sample_set"]
    )
    check_slot(slot)
    headers = HEADERS.validate_json(row["headers"], strict=True)
    key = call_key(
        endpoint=row["endpoint"],
        path=row["path"],
        headers=headers,
        body=row["body"],
        slot=slot,
    )
    attempts = ATTEMPTS.validate_json(row["attempts"], strict=True)
    check_attempts(attempts)
    request = ChatRequest(
        key=key,
        provider=row["provider"],
        endpoint=row["endpoint"],
        model=row["model"],
        path=row["path"],
        headers=headers,
        body=row["body"],
        slot=slot,
    )
    return CachedCall(request, attempts)


def opened(file: Path) -> duckdb.DuckDBPyConnection:
    """A connection with the view ``recording``, not verified; RecordingError for a foreign file."""
    if not file.is_file():
        raise UsageError(f"there is no recording {file}")
    connection = in_memory(READING)
    try:
        connection.execute(
            "CREATE VIEW recording AS FROM "
            f"read_parquet({_pattern(file)}, file_row_number = true, hive_partitioning = false)"
        )
        found = {
            name: kind for name, kind, *_ in connection.execute("DESCRIBE recording").fetchall()
        }
    except duckdb.Error as exc:
        raise RecordingError(f"{file} is not a readable Parquet file: {first_line(exc)}") from exc
    found.pop("file_row_number", None)
    if found != COLUMNS:
        raise RecordingError(
            f"{file} is not one of our recordings: it has the columns {_listed(found)}; "
            f"a recording has {_listed(COLUMNS)}"
        )
    told = _metadata(file, connection)
    version = told.get("key_version")
    if told.get("format") != FORMAT:
        raise RecordingError(
            f"{file} has the format {one_line(repr(told.get('format')))}, this program reads "
            f"{FORMAT!r}"
        )
    if version != str(KEY_VERSION):
        raise RecordingError(
            f"{file} has keys of version {version!r}, this program reads version {KEY_VERSION}"
        )
    _refuse_bombs(file, connection)
    return connection


def _refuse_bombs(file: Path, connection: duckdb.DuckDBPyConnection) -> None:
    """Raise RecordingError for more rows or longer texts than recordings have."""
    bytes_of_row = " + ".join(f"coalesce(strlen({name}), 0)" for name in TEXTS)
    with readable(file):
        calls = _number(connection, "SELECT count(*) FROM recording")
        longest = 0
        if calls <= MOST_CALLS:
            longest = _number(
                connection,
                f"SELECT max(block) FROM (SELECT sum({bytes_of_row}) AS block FROM recording "  # noqa: S608 # constants
                f"GROUP BY file_row_number // {BLOCK})",
            )
    if calls > MOST_CALLS or longest > MOST_BLOCK_BYTES:
        raise RecordingError(
            f"{file} is not one of our recordings: it claims {calls} calls, {longest} bytes in "
            f"{BLOCK} of them"
        )


def _number(connection: duckdb.DuckDBPyConnection, sql: str) -> int:
    row = connection.execute(sql).fetchone()
    return int(row[0] or 0) if row else 0


def read_provenance(file: Path) -> dict[str, str]:
    """What a recording says about its origin, not verified; raises RecordingError."""
    with opened(file) as connection:
        return _metadata(file, connection)


def sweeps_of(provenance: dict[str, str]) -> list[dict[str, str]]:
    """The rows of the sweeps whose calls a recording holds, as it says itself."""
    if SWEEPS not in provenance:
        return [provenance]
    try:
        return ROWS.validate_json(provenance[SWEEPS])
    except ValidationError:
        return []


def provenance_of(sweeps: list[dict[str, Any]]) -> dict[str, str]:
    """What a recording says of the sweeps that it is made of; see ``sweeps_of``."""
    rows = [
        {name: str(value) for name, value in row.items() if value is not None} for row in sweeps
    ]
    return rows[0] if len(rows) == 1 else {SWEEPS: canonical_json(rows)}


def _metadata(file: Path, connection: duckdb.DuckDBPyConnection) -> dict[str, str]:
    with readable(file):
        rows = connection.execute(
            f"SELECT key, value FROM parquet_kv_metadata({_pattern(file)})"  # noqa: S608 # quoted
        ).fetchall()
        return {key.decode(): value.decode() for key, value in rows}


def _fetch(rows: duckdb.DuckDBPyConnection, file: Path) -> list[tuple[Any, ...]]:
    with readable(file):
        return rows.fetchmany(BATCH)


@contextmanager
def readable(file: Path) -> Iterator[None]:
    """What cannot be read of a recording is a RecordingError."""
    try:
        yield
    except (duckdb.Error, UnicodeDecodeError) as exc:
        raise RecordingError(f"{file} is damaged: {first_line(exc)}") from exc


def _listed(columns: dict[str, str]) -> str:
    """Columns with their types; in a foreign file they may have any name."""
    named = [f"{name[:40]} {kind[:40]}" for name, kind in columns.items()]
    text = ", ".join(named[: 2 * len(COLUMNS)])
    return one_line(text)


def _pattern(file: Path) -> str:
    """The file as a quoted pattern that matches it alone, whatever its name."""
    return quoted(re.sub(r"([*?\[])", r"[\1]", str(file.resolve())))
