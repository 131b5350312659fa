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
import shlex
import sqlite3
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import asdict, dataclass
from itertools import islice, zip_longest
from operator import attrgetter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import duckdb
from pydantic import BaseModel, ConfigDict, JsonValue, field_validator

from merge_runner.errors import RecordingError, UsageError
from merge_runner.llm.cache import ResponseCache
from merge_runner.llm.store import ATTEMPTS, CachedCall, Overlay
from merge_runner.llm.templates import count_by_template
from merge_runner.paths import refuse_another_kind
from merge_runner.records import (
    DAMAGED,
    KEY_VERSION,
    Attempt,
    ChatRequest,
    canonical_json,
    check_body,
    check_call,
    is_scripted,
)
from merge_runner.results import database
from merge_runner.results.database import Settings, append, fetched, in_memory
from merge_runner.results.parquet import group_bytes
from merge_runner.results.rows import Row
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
"""docs/recordings.md says what they mean."""
SLOT = ("condition", "repetition", "side", "decision", "sample_set")
# Far beyond any sweep; a file that claims more was made to do harm.
MOST_CALLS = 10_000_000
BLOCK, MOST_BLOCK_BYTES = 2048, 2**28
"""DuckDB hands out this many rows at once, and their texts may have this many bytes."""
MOST_GROUP_BYTES = 2 * MOST_BLOCK_BYTES
"""What decoding a row group may take: an export writes little more than BLOCK rows into one."""
WRITTEN_AT_ONCE = 16
SHOWN = 70
# Misses that differ in numbers alone have one cause.
_NUMBER = re.compile(r"-?\d+(\.\d+)?")
SETTINGS: Settings = {
    **database.SETTINGS,
    "autoinstall_known_extensions": False,
    "autoload_known_extensions": False,
    "threads": 1,
}


class RecordedSweep(BaseModel):
    """A sweep in a recording; ``repetitions`` of each prompt variant, in each condition.

    It is read from the configuration of any version that wrote a recording. ``arms`` has the
    labels of the arms of a study; recordings of plain sweeps may have none.
    """

    model_config = ConfigDict(frozen=True, extra="ignore")

    name: str
    model: str
    repetitions: Counter[str]
    conditions: tuple[str, ...]
    sample_set: int
    arms: frozenset[str] = frozenset()
    models: dict[str, JsonValue] = {}

    @field_validator("arms", mode="before")
    @classmethod
    def _labels(cls, stored: object) -> object:
        if not isinstance(stored, list):
            return stored
        return [arm.get("label") if isinstance(arm, dict) else arm for arm in stored]


def export_recording(
    file: Path, cache: ResponseCache, keys: list[str], provenance: dict[str, str]
) -> int:
    """Write the entries under these keys, in their order; returns their number.

    Raises RecordingError. Damaged entries are left out; once the others are written, the error
    names them.
    """
    if file.is_dir():
        raise UsageError(f"{file} is a folder: name a file")
    refuse_another_kind(file, b"PAR1", "recording")
    damaged: list[str] = []
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with (
            TemporaryDirectory(prefix=".recording-", dir=file.parent) as folder,
            in_memory(SETTINGS) as connection,
        ):
            connection.execute(f"ATTACH {quoted(f'{folder}/calls.duckdb')} AS file; USE file")
            columns = ", ".join(f"{name} {kind}" for name, kind in COLUMNS.items())
            connection.execute(f"CREATE TABLE calls ({columns})")
            content, rows = hashlib.sha256(), _exported_rows(cache, keys, damaged)
            while batch := list(islice(rows, WRITTEN_AT_ONCE)):
                append(connection, "calls", batch)
                for row in batch:
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
    """Yield the rows of the entries under these keys; what is wrong with others is noted."""
    for key in keys:
        try:
            entry = cache.get(key)
        except RecordingError as exc:
            damaged.append(f"{key}: {exc}")
            continue
        if entry is None:
            raise RecordingError(
                f"the reply {key} is not in the cache {cache.folder}: run the sweep again with it"
            )
        columns = asdict(entry.request)
        columns |= columns.pop("slot") | {
            "call_key": key,
            "headers": json.dumps(entry.request.headers, sort_keys=True),
            "attempts": ATTEMPTS.dump_json(entry.attempts).decode(),
        }
        yield tuple(columns[name] for name in COLUMNS)


def read_recording(file: Path) -> Iterator[CachedCall]:
    """Yield all entries of a recording, each verified; raises RecordingError."""
    seen: set[str] = set()
    content = hashlib.sha256()
    with opened(file) as (connection, told):
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
    found = {"calls": str(len(seen)), "content_sha256": content.hexdigest()}
    if told != told | found or told.get(PROVENANCE_HASH) != _provenance_hash(told):
        raise RecordingError(
            f"{file} is not as it was exported: its calls, or what it says of where it comes from, "
            "have another hash"
        )


@contextmanager
def spilled(files: Iterable[Path]) -> Iterator[Overlay]:
    """Open recordings as their verified entries by key, and count these.

    Raises RecordingError, also where two recordings hold different replies to one call.
    """
    with closing(sqlite3.connect("", check_same_thread=False)) as db:
        db.execute("CREATE TABLE entries (key TEXT PRIMARY KEY, entry TEXT)")
        yield Spilled(db), count_by_template(_spill(files, db))


def _spill(files: Iterable[Path], db: sqlite3.Connection) -> Iterator[tuple[ChatRequest, Attempt]]:
    """Write recordings' entries, and yield the request and the answer of each."""
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
    """Entries by key in a temporary database; SQLite keeps a large one in a file."""

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
    """Verify the whole file, then add what the cache lacks; returns (added, already there).

    The file is read twice, so that nothing of a file whose damage shows only at its end is added.
    """
    for _ in read_recording(file):
        pass
    return cache.add_missing(read_recording(file))


def summarise(file: Path) -> dict[str, Any]:
    """Verify a recording and count what it holds: its calls, by model, endpoint and outcome.

    Of the calls a mock model answered ``scripted``; ``cost_usd`` is what its replies cost when they
    were made. ``plugins`` are the files whose source it carries.
    """
    names = ("models_requested", "models_served", "endpoints", "outcomes")
    counts = {name: Counter[str]() for name in names}
    numbers = Counter(calls=0, scripted=0, attempts=0)
    cost_usd, provenance = 0.0, read_provenance(file)
    for entry in read_recording(file):
        request, last = entry.request, entry.attempts[-1]
        numbers.update(calls=1, scripted=is_scripted(request, last), attempts=len(entry.attempts))
        cost_usd += sum(attempt.cost_usd or 0.0 for attempt in entry.attempts)
        told = (request.model, last.model_served or "unknown", request.endpoint, last.outcome)
        for count, value in zip(counts.values(), told, strict=True):
            count[value] += 1
    told_of = {"plugins": carried_plugins(provenance), "provenance": provenance}
    return {**numbers, "cost_usd": round(cost_usd, 6), **counts, **told_of}


def summary_lines(file: Path, summary: dict[str, Any]) -> Iterator[str]:
    """Yield the summary of a recording (``summarise``) for a reader."""
    for row in sweep_rows(summary["provenance"]):
        study, trials, models = "unknown", "unknown", ""
        with suppress(*DAMAGED):
            study, config = row["name"], json.loads(row["config"])
            models = config["model"]
            arms = config.get("arms") or [
                {"repetitions": n} for n in config["repetitions"].values()
            ]
            planned = sum(arm["repetitions"] for arm in arms) * len(config["conditions"])
            trials = f"{planned} of {models}"
        asked = (str(row.get(when) or "?")[:16] for when in ("started_at", "ended_at"))
        yield one_line(f"study    {study}")
        yield one_line(f"trials   {trials}")
        yield f"played   {' to '.join(asked)} UTC"
    for model, calls in summary["models_requested"].items():
        yield f"model    {model}: {calls} calls"
    scripted, calls = summary["scripted"], summary["calls"]
    if scripted:
        yield f"         {scripted} of {calls} calls were answered by a scripted stand-in"
    outcomes = ", ".join(f"{number} {outcome}" for outcome, number in summary["outcomes"].items())
    usd = f"{summary['cost_usd']:.2f} USD"
    yield f"calls    {calls} ({outcomes}), {summary['attempts']} attempts, {usd}"
    if summary["plugins"]:
        yield f"code     {', '.join(summary['plugins'])}: runs where the study is played again"
    yield f"digest   {summary['provenance']['content_sha256']} (of its replies)"
    yield f"again    merge-runner replay {shlex.quote(str(file))}"


def _fingerprint(key: str, attempts: str) -> bytes:
    """Return what a recording's hash covers of a row; the key covers the rest."""
    return f"{key} {attempts}\n".encode()


def _provenance_hash(metadata: dict[str, str]) -> str:
    """Return a hash of everything that a file says about itself."""
    told = {name: text for name, text in metadata.items() if name != PROVENANCE_HASH}
    return hashlib.sha256(canonical_json(told).encode()).hexdigest()


def _entry(row: dict[str, Any]) -> CachedCall:
    """Return the entry of a row, which belongs to its key; raises one of DAMAGED."""
    check_body(row["body"])
    request = {name: row[name] for name in ("provider", "endpoint", "model", "path", "body")}
    request |= {"key": row["call_key"], "slot": {name: row[name] for name in SLOT}}
    request["headers"] = json.loads(row["headers"])
    call = {"request": request, "attempts": json.loads(row["attempts"])}
    entry = CachedCall.from_json(json.dumps({"version": 1, "entry": call}))
    check_call(entry.request.key, entry.request, entry.attempts)
    return entry


@contextmanager
def opened(file: Path) -> Iterator[tuple[duckdb.DuckDBPyConnection, dict[str, str]]]:
    """Open a recording as the view ``recording``, with its metadata; raises RecordingError.

    Neither is verified.
    """
    if not file.is_file():
        raise UsageError(f"there is no recording {file}")
    # A pattern that matches the file alone, whatever its name.
    pattern = quoted(re.sub(r"([*?\[])", r"[\1]", str(file.resolve())))
    with in_memory(SETTINGS) as connection:
        try:
            connection.execute(
                "CREATE VIEW recording AS FROM "
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
            _refuse_bombs(file, pattern, connection)
            yield connection, metadata
        except (duckdb.Error, UnicodeDecodeError) as exc:
            raise RecordingError(
                f"{file} is damaged, or no Parquet file: {first_line(exc)}"
            ) from exc


def _refuse_bombs(file: Path, pattern: str, connection: duckdb.DuckDBPyConnection) -> None:
    """Raise RecordingError for more rows or longer texts than recordings have.

    Nothing is decoded before it is known how much that takes.
    """
    not_ours = f"{file} is not one of our recordings"
    ((calls,),) = connection.execute("SELECT count(*) FROM recording").fetchall()
    if calls > MOST_CALLS:  # what a footer claims is not there to be read
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
    """Return what a recording says about its origin, not verified; raises RecordingError."""
    with opened(file) as (_, metadata):
        return metadata


def provenance_of(sweeps: list[dict[str, Any]]) -> dict[str, str]:
    """Return the metadata of the sweeps that a recording is made of.

    The command line, whose paths tell of people and machines, stays in the database.
    """
    rows = [
        {name: str(value) for name, value in row.items() if value is not None} for row in sweeps
    ]
    for row in rows:
        with suppress(*DAMAGED):
            config = dict(json.loads(row["config"]))
            row["config"] = canonical_json({k: v for k, v in config.items() if k != "typed"})
    return rows[0] if len(rows) == 1 else {SWEEPS: canonical_json(rows)}


def carried_plugins(provenance: dict[str, str]) -> list[str]:
    """Return the names of the plug-ins whose source a recording carries, as it says itself."""
    names = set[str]()
    for row in sweep_rows(provenance):
        with suppress(*DAMAGED):
            names.update(map(str, json.loads(row["config"])["study"]["plugins"]))
    return sorted(names)


def described_sweeps(provenance: dict[str, str]) -> list[RecordedSweep]:
    """Return the sweeps as a recording says itself, without those whose configuration is odd."""
    sweeps = []
    for row in sweep_rows(provenance):
        with suppress(*DAMAGED):
            sweeps.append(RecordedSweep(**{**json.loads(row["config"]), "name": row["name"]}))
    return sweeps


def sweep_rows(provenance: dict[str, str]) -> list[Any]:
    """Return the rows of sweeps that a recording has, as it says itself."""
    with suppress(*DAMAGED):
        return [row for row in json.loads(provenance[SWEEPS]) if isinstance(row, dict)]
    return [provenance]


def recorded_part(
    files: Iterable[Path], names: Collection[str], model: str, sample_set: int
) -> RecordedSweep | None:
    """What recordings hold of one sweep: all that several of them, or several runs, hold of it.

    It may have several ``names``. Repetitions and conditions of which no call is there are no part
    of it. None where no recording says that it is of this sweep. Raises RecordingError.
    """
    part = None
    for file in files:
        with opened(file) as (connection, provenance):
            counts = "SELECT condition, max(repetition) FROM recording GROUP BY ALL"
            recorded = dict(connection.execute(counts).fetchall())
        for sweep in described_sweeps(provenance):
            if sweep.name not in names or (sweep.model, sweep.sample_set) != (model, sample_set):
                continue
            most = max((recorded.get(name, 0) for name in sweep.conditions), default=0)
            repetitions = Counter({name: min(n, most) for name, n in sweep.repetitions.items()})
            conditions = tuple(name for name in sweep.conditions if name in recorded)
            if part is not None:
                repetitions |= part.repetitions  # the larger number of each
                conditions = tuple(dict.fromkeys([*part.conditions, *conditions]))
            changes = {"repetitions": repetitions, "conditions": conditions}
            arms = sweep.arms | (part.arms if part else frozenset())
            part = sweep.model_copy(update={**changes, "arms": arms})
    return part


def described(files: Sequence[Path], entries: Iterable[CachedCall]) -> str:
    """What recordings hold, or a cache without files: how many calls of each model."""
    models = Counter(entry.request.model for entry in entries)
    counts = ", ".join(f"{calls} calls of {model}" for model, calls in sorted(models.items()))
    named = ", ".join(map(str, files)) or "the cache"
    return one_line(f"{named} holds {counts or 'no call at all'}")


@dataclass(frozen=True, slots=True)
class Miss:
    """A call that a replay lacked, and the trial that needed it."""

    trial_id: str
    request: ChatRequest


def explain(misses: list[Miss], recorded: Iterable[CachedCall]) -> list[str]:
    """How each miss differs from the nearest request: one text for all that differ in the same way.

    The text names the first trial, side and decision, and how many more there are. The nearest
    request is one of the same slot, else one of the same place in another repetition, else any;
    among several of one slot, the one with the fewest differences.
    """
    place = attrgetter("condition", "side", "decision")
    wanted = {miss.request.slot for miss in misses}
    known: dict[object, list[ChatRequest]] = {}  # by slot, the first by place, the first of all
    for request in (entry.request for entry in recorded):
        if request.slot in wanted:
            known.setdefault(request.slot, []).append(request)
        for key in (place(request.slot), None):
            known.setdefault(key, [request])
    alike: dict[str, list[tuple[Miss, str]]] = {}
    for miss in misses:
        keys = (miss.request.slot, place(miss.request.slot), None)
        near = next((known[key] for key in keys if key in known), [])
        found = min((_differences(other, miss.request) for other in near), key=len, default=[])
        text = f"the nearest recorded request differs in {'; '.join(found)}"
        text = text if found else "nothing is recorded at all"
        alike.setdefault(_NUMBER.sub("0", text), []).append((miss, text))
    lines = []
    for group in alike.values():
        first, text = group[0]
        slot, trials = first.request.slot, {miss.trial_id for miss, _ in group}
        line = f"{first.trial_id}, {slot.side}, decision {slot.decision}: {text}"
        more = f"; {len(group)} calls of {len(trials)} trials differ like this"
        lines.append(line + more * (len(group) > 1))
    return lines


def _differences(recorded: ChatRequest, wanted: ChatRequest) -> list[str]:
    """Return the fields that differ, each with both values; of texts the first lines that do."""
    old, new, texts = _fields(recorded), _fields(wanted), []
    for name in sorted(old.keys() | new.keys()):
        before, after = old.get(name), new.get(name)
        if isinstance(before, str) and isinstance(after, str):
            lines = zip_longest(before.split("\n"), after.split("\n"))
            before, after = next((pair for pair in lines if pair[0] != pair[1]), (None, None))
        if before != after:
            values = ("nothing" if value is None else repr(value) for value in (before, after))
            was, now = (v if len(v) <= SHOWN else v[:SHOWN] + "..." for v in values)
            texts.append(f"{name} (recorded {was}, wanted {now})")
    return texts


def _fields(request: ChatRequest) -> dict[str, object]:
    """The fields that a request's key covers, those of its body each by its path."""
    told = {"endpoint": request.endpoint, "path": request.path, "headers": request.headers}
    body = json.loads(request.body)
    return dict(leaves({**asdict(request.slot), **told, "body": body}))


def leaves(value: object, name: str = "") -> Iterator[tuple[str, object]]:
    """Yield the values within a JSON value, each with its path."""
    if isinstance(value, dict | list):
        for key, inner in value.items() if isinstance(value, dict) else enumerate(value):
            yield from leaves(inner, f"{name}.{key}".lstrip("."))
    else:
        yield name, value
