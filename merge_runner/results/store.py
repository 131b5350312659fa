"""Results in DuckDB. The file is open only during a transaction, so that others can read it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from datetime import datetime
from itertools import chain, groupby
from operator import itemgetter
from pathlib import Path
from typing import Any

import duckdb

from merge_runner.errors import UsageError
from merge_runner.results.appender import Buffer, append, columns_of
from merge_runner.results.database import (
    PATIENCE_S,
    SCHEMA_VERSION,
    check_schema,
    errors_of,
    fetched,
    has_these_measures,
    names_of,
    only,
    read_database,
    schema_sql,
    unreadable_is_usage,
    write_database,
)
from merge_runner.results.instance import SETTINGS, Instance, limit_memory, merge_small_groups
from merge_runner.results.rows import (
    FACTOR_TABLE,
    KEY_COLUMNS,
    Row,
    TrialKey,
    factor_rows,
    rows_of,
    rows_of_trials,
    stored_rows,
)
from merge_runner.scenarios.merge.measures import measures_sql
from merge_runner.trial_records import TrialRecord, TrialSpec

# Whether a file may have tables. Listing them in a new file is slow: DuckDB loads its system views.
IS_WRITTEN = """
SELECT total_blocks > 0 OR wal_size <> '0 bytes' FROM pragma_database_size()
WHERE database_name = current_database()
"""
# Factor levels are no results: another study may have others for the same trial.
RESULTS = [table for table in KEY_COLUMNS if table != FACTOR_TABLE]
# Columns in which two runs of a trial may differ: whether a run made an attempt itself, and when.
# Cost and batch are the same, since both runs have them from the cache. In an audit of the database
# more columns may differ (run/stored_replay.NOT_REPLAYED).
RUN_COLUMNS = frozenset({"cached", "started_at", "latency_s"})
# The first and the third column order the rows of a trial. Digests call the source of a first
# decision 'seat', as schema 9 did, so that they stay the same.
DIGEST_COLUMNS = {
    "trials": "pair, if(source = 'first_decision', 'seat', source), model_left, model_right, "
    "variant, condition, rep, sample_set, status, merged_first, end_time_s, error",
    "states": "step, time_s, side, position_m, velocity_mps, acceleration_mps2",
    "decisions": "decision, time_s, side, valid, failure, tactical, rationale, plan, applied, "
    "fallback, prompt",
}


class Store:
    """Database of sweeps and whole trials, open only during short transactions."""

    def __init__(self, path: Path) -> None:
        """Open or create the database; raises UsageError for a foreign file or another schema."""
        self.path = path
        if path.exists() and not path.is_file():
            raise UsageError(f"{path} is not a file: name one with --db")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as exc:
            raise UsageError(f"{path.parent} cannot be made: {exc}") from exc
        with unreadable_is_usage(), write_database(self.path) as connection:
            written = connection.execute(IS_WRITTEN).fetchone()
            if written == (True,) and connection.execute("SHOW TABLES").fetchall():
                check_schema(connection, path)
                if not has_these_measures(connection):
                    connection.execute(measures_sql())
            else:
                # Definitions have nothing to optimize; the setting ends with the connection.
                connection.execute(f"PRAGMA disable_optimizer; {schema_sql()}")
                connection.execute("INSERT INTO meta VALUES (?)", [SCHEMA_VERSION])
            tables = (*RESULTS, "sweep_trials")
            self._columns = {table: columns_of(connection, table) for table in tables}

    def begin_sweep(
        self, sweep: dict[str, Any], specs: dict[str, str], stored: Sequence[TrialSpec]
    ) -> None:
        """Add a sweep with its specs, and link its trials that are already stored.

        Their factor levels are added: the study that stored them may have had others.
        """
        with write_database(self.path) as connection:
            connection.execute("INSERT INTO sweeps BY NAME SELECT unnest(?)", [sweep])
            _add_specs(connection, specs)
            links = ((sweep["sweep_id"], *spec.key) for spec in stored)
            append(connection, "sweep_trials", links)
            _add_factors(connection, [*chain.from_iterable(map(factor_rows, stored))])

    def end_sweep(self, sweep_id: str, ended_at: datetime, exit_code: int) -> None:
        """Store the end time and the exit code of a sweep."""
        with write_database(self.path) as connection:
            connection.execute(
                "UPDATE sweeps SET ended_at = ?, exit_code = ? WHERE sweep_id = ?",
                [ended_at, exit_code, sweep_id],
            )

    def ended_trials(self, specs: Mapping[TrialKey, TrialSpec]) -> set[TrialKey]:
        """Return the keys of the trials that are stored and did not fail.

        Raises UsageError if a condition is stored with another headway or relative velocity: spec
        hashes do not cover them.
        """
        keys = list(specs)
        kinematics = {spec.condition: spec.kinematics for spec in specs.values()}
        columns = "DISTINCT condition, projected_headway_m, relative_velocity_mps"
        with read_database(self.path) as connection:
            for name, *numbers in rows_of_trials(connection, columns, "trials", keys).fetchall():
                condition = kinematics[name]
                if numbers != [condition.projected_headway_m, condition.relative_velocity_mps]:
                    raise UsageError(
                        f"the condition {name} is stored with a headway of {numbers[0]:g} m and a "
                        f"relative velocity of {numbers[1]:g} m/s: give the changed one a new name"
                    )
            return {key for key, ended in _ended(connection, keys).items() if ended}

    def decisions_by_spec(self, spec_hashes: Collection[str]) -> list[tuple[Any, ...]]:
        """Count valid and invalid decisions by spec and side, without failed trials.

        Rows: (spec_hash, side, valid, invalid, failure and rationale of the first invalid one).
        """
        sql = """
            SELECT spec_hash, side, count(*) FILTER (valid), count(*) FILTER (NOT valid),
                arg_min(failure, (trial_id, decision)) FILTER (NOT valid),
                arg_min(rationale, (trial_id, decision)) FILTER (NOT valid)
            FROM decisions SEMI JOIN (FROM trials WHERE status <> 'failed')
                USING (trial_id, spec_hash)
            WHERE list_contains(?, spec_hash) GROUP BY ALL
        """
        with read_database(self.path) as connection:
            return connection.execute(sql, [list(spec_hashes)]).fetchall()

    def write(
        self,
        sweep_id: str | None,
        records: Sequence[TrialRecord],
        specs: Mapping[str, str] | None = None,
        *,
        patience_s: float = PATIENCE_S,
    ) -> dict[TrialKey, list[str]]:
        """Store whole trials, replacing failed ones; compare those that are already stored.

        They are linked to a sweep unless ``sweep_id`` is None. Returns the keys of trials that are
        stored with other values, with the differing columns.
        """
        calls = [call for record in records for call in record.calls]
        replies = [attempt.reply or "" for call in calls for attempt in call.attempts]
        texts = [*(call.request.body for call in calls), *replies]
        links = [] if sweep_id is None else [(sweep_id, *record.spec.key) for record in records]
        with errors_of(self.path), closing(Buffer(self._columns)) as buffer:
            # Before the database is locked, so that the lock is short.
            buffer.add({"sweep_trials": links})
            for record in records:
                buffer.add(rows_of(record))
            with write_database(self.path, patience_s, buffer.cursor) as connection:
                limit_memory(connection, max(map(len, texts), default=0))
                merge_small_groups(connection, len(replies))
                if specs:
                    _add_specs(connection, specs)
                return _add_trials(connection, records, buffer, links)

    def add_recorded(
        self, records: Sequence[TrialRecord], specs: Mapping[str, str]
    ) -> tuple[int, int, list[str]]:
        """Store recorded trials without a sweep, as ``write`` does: only failed ones are replaced.

        Returns the number added, the number already stored, and the ids of trials that are stored
        with other values.
        """
        keys = {record.spec.key: record.spec for record in records}
        added = len(keys.keys() - self.ended_trials(keys))
        differing = [trial_id for trial_id, _ in self.write(None, records, specs)]
        return added, len(records) - added - len(differing), differing


def query(path: Path, sql: str) -> tuple[list[str], list[tuple[Any, ...]]]:
    """Run one read-only query and return its column names and rows; raises UsageError.

    The query has no access to files, the network or settings.
    """
    with open_result(path, sql) as result:
        return names_of(result), result.fetchall()


@contextmanager
def open_result(path: Path, sql: str) -> Iterator[duckdb.DuckDBPyConnection]:
    """Yield the result of a query to fetch; the database is locked until the block ends."""
    # An instance of its own: the restrictions hold for a whole instance and cannot be lifted.
    with read_database(path, Instance()) as connection:
        # DuckDB ignores signals while several of its threads work on a query.
        connection.execute("SET threads = 1")
        try:
            with run_restricted(connection, sql) as result:
                yield result
        except RuntimeError as exc:
            if "interrupted" not in str(exc):
                raise
            raise KeyboardInterrupt from exc


@contextmanager
def run_restricted(
    connection: duckdb.DuckDBPyConnection, sql: str
) -> Iterator[duckdb.DuckDBPyConnection]:
    """Run one query that can access only the open database, and yield its result to fetch.

    The connection's whole instance stays restricted. Raises UsageError.
    """
    # With external access disabled alone, COPY ... TO could still write the database's own files.
    connection.execute(
        "SET temp_directory = ''; SET enable_external_access = false; "
        "SET disabled_filesystems = 'LocalFileSystem'; SET lock_configuration = true"
    )
    kinds = duckdb.StatementType
    try:
        statements = connection.extract_statements(sql)
        # A PIVOT has several statements.
        reading = (kinds.SELECT, kinds.EXPLAIN, kinds.MULTI)
        if [statement.type in reading for statement in statements] != [True]:
            raise UsageError(
                "one query at a time, and one that only reads: SELECT, FROM, WITH, VALUES, "
                "PIVOT, SUMMARIZE, DESCRIBE, SHOW or EXPLAIN"
            )
        connection.execute(statements[0])
        yield connection
    except duckdb.IOException:
        raise  # a query can read no other file: the database is damaged
    except duckdb.OutOfMemoryException as exc:
        raise UsageError(
            f"the query needs more than the {SETTINGS['memory_limit']} of memory that it may use: "
            "ask for fewer rows or columns at once; requests and replies are long"
        ) from exc
    except (duckdb.Error, ValueError) as exc:  # ValueError: a statement type unknown to the client
        raise UsageError(f"the query failed: {exc}") from exc


def results_digest(path: Path, sweep_ids: Sequence[str] | None = None) -> tuple[str, int]:
    """Return a hash of all results, or of some sweeps' results, and the number of its trials.

    The hash covers trials, states and decisions, in any storage order. It does not cover clock
    times, latencies, costs, cache keys or spec hashes.
    """
    digests: dict[TrialKey, Any] = {}
    with read_database(path) as connection:
        keys = f"SELECT trial_id, spec_hash FROM trials {only(sweep_ids)}"  # noqa: S608
        chosen = None if sweep_ids is None else {*connection.execute(keys).fetchall()}
        for table, columns in DIGEST_COLUMNS.items():
            # The table is too large to be sorted, but a trial's rows are adjacent; a join would mix
            # them.
            sql = f"SELECT trial_id, spec_hash, {columns} FROM {table}"  # noqa: S608
            for key, rows in groupby(fetched(connection.execute(sql)), key=itemgetter(0, 1)):
                if chosen is not None and key not in chosen:
                    continue
                digest = digests.setdefault(key, hashlib.sha256(key[0].encode()))
                for values in sorted(rows, key=itemgetter(2, 4)):
                    digest.update(json.dumps(values[2:]).encode())
    whole = hashlib.sha256("".join(sorted(d.hexdigest() for d in digests.values())).encode())
    return whole.hexdigest(), len(digests)


def _add_factors(connection: duckdb.DuckDBPyConnection, rows: Sequence[Row]) -> None:
    if not rows:
        return
    keys = [row[:2] for row in rows]
    columns = "trial_id, spec_hash, factor"
    stored = set(rows_of_trials(connection, columns, "trial_factors", keys).fetchall())
    append(connection, "trial_factors", (row for row in rows if row[:3] not in stored))


def _add_specs(connection: duckdb.DuckDBPyConnection, specs: Mapping[str, str]) -> None:
    sql = "INSERT OR IGNORE INTO specs SELECT unnest(?), unnest(?)"
    connection.execute(sql, [list(specs), list(specs.values())])


def _ended(connection: duckdb.DuckDBPyConnection, keys: Sequence[TrialKey]) -> dict[TrialKey, bool]:
    """Return the stored ones of these trials, and whether each ended without failure."""
    columns = "(trial_id, spec_hash), status <> 'failed'"
    return dict(rows_of_trials(connection, columns, "trials", keys).fetchall())


def _add_trials(
    connection: duckdb.DuckDBPyConnection,
    records: Sequence[TrialRecord],
    buffer: Buffer,
    links: Sequence[Row],
) -> dict[TrialKey, list[str]]:
    """Store whole trials, replacing failed ones; compare those that are already stored.

    The buffer has the rows of all of them. Returns the keys of trials that are stored with other
    values, with the differing columns.
    """
    stored = _ended(connection, [record.spec.key for record in records])
    new: dict[TrialKey, TrialRecord] = {}
    again: dict[TrialKey, TrialRecord] = {}
    for record in records:
        key = record.spec.key
        if not stored.get(key) and key not in new:
            new[key] = record
        elif record.status != "failed":
            again[key] = record
    if len(new) < len(records):
        buffer.clear()
        buffer.add({"sweep_trials": links})
        for record in new.values():
            buffer.add(rows_of(record))
    for table in RESULTS:
        for key in new.keys() & stored.keys():
            connection.execute(
                f"DELETE FROM {table} WHERE trial_id = ? AND spec_hash = ?",  # noqa: S608 # constants
                key,
            )
    buffer.flush()
    for of_trials in (new, again):
        levels = [row for record in of_trials.values() for row in factor_rows(record.spec)]
        _add_factors(connection, levels)
    differing: dict[TrialKey, list[str]] = {}
    rows = {key: rows_of(record) for key, record in again.items()}
    for table in RESULTS if again else ():
        stored_trials = stored_rows(connection, table, list(again))
        for key in again:
            expected = rows[key][table]
            for difference in stored_trials.differences(key, expected, ignored=RUN_COLUMNS):
                differing.setdefault(key, []).append(difference.name)
    return differing
