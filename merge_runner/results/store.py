"""Results in DuckDB. The file is open only while a batch is written, so that others can read it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import datetime
from fnmatch import fnmatchcase
from itertools import chain, groupby
from operator import itemgetter
from pathlib import Path
from typing import Any

import duckdb

from merge_runner.errors import UsageError, unknown_name
from merge_runner.records import TrialRecord, TrialSpec
from merge_runner.registry import require
from merge_runner.results.database import (
    PATIENCE_S,
    SCHEMA_VERSION,
    SETTINGS,
    Instance,
    append,
    by_name,
    check_schema,
    fetched,
    has_these_measures,
    limit_memory,
    merge_small_groups,
    names_of,
    only,
    read_database,
    schema_sql,
    unreadable_is_usage,
    write_database,
)
from merge_runner.results.rows import (
    FACTORS,
    PLACES,
    Row,
    TrialKey,
    factor_rows,
    rows_of,
    rows_of_trials,
    stored_rows,
)
from merge_runner.scenarios.merge.measures import measures_sql
from merge_runner.served_model import other_models

# Columns that differ from run to run: whether the run made an attempt itself, and when.
OF_A_RUN = frozenset({"cached", "started_at", "latency_s"})
FACTS = Path(__file__).with_name("facts.sql")
SWEEPS = "FROM sweeps ORDER BY started_at"
# The trials of some sweeps that no other one has.
GOING = """
CREATE OR REPLACE TEMP TABLE going AS
SELECT trial_id, spec_hash FROM sweep_trials
GROUP BY ALL HAVING bool_and(list_contains(?, sweep_id))
"""
# By their slots.
CALLS_OF = """
SELECT DISTINCT condition, rep, side, decision, sample_set, call_key
FROM decisions JOIN trials USING (trial_id, spec_hash)
SEMI JOIN (FROM sweep_trials WHERE list_contains(?, sweep_id)) USING (trial_id, spec_hash)
WHERE call_key IS NOT NULL ORDER BY ALL
"""
THAT_ASKED = """
SELECT sweep_id FROM sweeps SEMI JOIN (
    FROM sweep_trials SEMI JOIN calls USING (trial_id, spec_hash)
) USING (sweep_id) ORDER BY started_at
"""
# The first and the third of these columns order the rows of a trial. Digests keep the value that
# the source of a first decision had in schema 9.
OF_THE_DIGEST = {
    "trials": "pair, if(source = 'first_decision', 'seat', source), model_left, model_right, "
    "variant, condition, rep, sample_set, status, merged_first, end_time_s, error",
    "states": "step, time_s, side, position_m, velocity_mps, acceleration_mps2",
    "decisions": "decision, time_s, side, valid, failure, tactical, rationale, plan, applied, "
    "fallback, prompt",
}


class Store:
    """Writes sweeps and whole trials; every method is one short transaction."""

    def __init__(self, path: Path) -> None:
        """Open or make the database; raises UsageError for a foreign one or another schema."""
        self.path = path
        if path.exists() and not path.is_file():
            raise UsageError(f"{path} is not a file: name one with --db")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as exc:
            raise UsageError(f"{path.parent} cannot be made: {exc}") from exc
        with unreadable_is_usage(), write_database(self.path) as connection:
            if connection.execute("SHOW TABLES").fetchall():
                check_schema(connection, path)
                if not has_these_measures(connection):
                    connection.execute(measures_sql())
            else:
                connection.execute(schema_sql())
                connection.execute("INSERT INTO meta VALUES (?)", [SCHEMA_VERSION])

    def begin_sweep(
        self, sweep: dict[str, Any], specs: dict[str, str], stored: Sequence[TrialSpec]
    ) -> None:
        """Add a sweep's row, what its spec hashes stand for, and its trials already stored.

        Their levels are added, too, which another study may have stored without.
        """
        with write_database(self.path) as connection:
            connection.execute("INSERT INTO sweeps BY NAME SELECT unnest(?)", [sweep])
            _add_specs(connection, specs)
            links = ((sweep["sweep_id"], spec.trial_id, spec.spec_hash) for spec in stored)
            append(connection, "sweep_trials", links)
            _add_factors(connection, [*chain.from_iterable(map(factor_rows, stored))])

    def end_sweep(self, sweep_id: str, ended_at: datetime, exit_code: int) -> None:
        """Note when and how a sweep ended."""
        with write_database(self.path) as connection:
            connection.execute(
                "UPDATE sweeps SET ended_at = ?, exit_code = ? WHERE sweep_id = ?",
                [ended_at, exit_code, sweep_id],
            )

    def ended_trials(self, specs: Mapping[TrialKey, TrialSpec]) -> set[TrialKey]:
        """The keys of those trials that are stored and did not fail.

        Raises UsageError where one of their conditions had other numbers when they were stored:
        the spec's hash does not cover these.
        """
        named = list(specs)
        kinematics = {spec.condition: spec.kinematics for spec in specs.values()}
        columns = "DISTINCT condition, projected_headway_m, relative_velocity_mps"
        with read_database(self.path) as connection:
            for name, *numbers in rows_of_trials(connection, columns, "trials", named).fetchall():
                condition = kinematics[name]
                if numbers != [condition.projected_headway_m, condition.relative_velocity_mps]:
                    raise UsageError(
                        f"the condition {name} is stored with a headway of {numbers[0]:g} m and a "
                        f"relative velocity of {numbers[1]:g} m/s: give the changed one a new name"
                    )
            return {key for key, ended in _ended(connection, named).items() if ended}

    def decisions_by_spec(self, spec_hashes: Collection[str]) -> list[tuple[Any, ...]]:
        """Of the trials that did not fail, by spec and side, how many decisions are (in)valid.

        (spec_hash, side, valid ones, invalid ones, failure and rationale of an invalid one)
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
    ) -> dict[str, list[str]]:
        """Store whole trials, replacing failed ones; those that had ended are compared instead.

        They are linked to a sweep, unless they were recorded elsewhere. Returns the ids of those
        that are stored with other values, and in which columns.
        """
        # Made before the lock is taken, although a trial that is stored already needs none.
        played = [(_key(record), record.status, rows_of(record)) for record in records]
        texts = [len(str(value)) for *_, rows in played for row in rows["calls"] for value in row]
        with write_database(self.path, patience_s) as connection:
            limit_memory(connection, max(texts, default=0))
            merge_small_groups(connection)
            _add_specs(connection, specs or {})
            differing = _add_trials(connection, played)
            if sweep_id is not None:
                append(connection, "sweep_trials", ((sweep_id, *key) for key, *_ in played))
            return differing

    def add_recorded(
        self, records: Sequence[TrialRecord], specs: Mapping[str, str]
    ) -> tuple[int, int, list[str]]:
        """Store recorded trials, which belong to no sweep; one already stored stays as it is.

        Returns how many were added, how many were stored already, and the ids of those that are
        stored with other values.
        """
        keys = {_key(record): record.spec for record in records}
        added = len(keys.keys() - self.ended_trials(keys))
        differing = list(self.write(None, records, specs))
        return added, len(records) - added - len(differing), differing


def query(path: Path, sql: str) -> tuple[list[str], list[tuple[Any, ...]]]:
    """Run one read-only query; returns the column names and the rows. Raises UsageError.

    It reaches no file and no network, and changes no setting.
    """
    with answer(path, sql) as result:
        return names_of(result), result.fetchall()


@contextmanager
def answer(path: Path, sql: str) -> Iterator[duckdb.DuckDBPyConnection]:
    """The result of a query, to be fetched; the database is locked until the block ends."""
    # The settings hold for a whole instance, and cannot be taken back.
    with read_database(path, Instance()) as connection:
        # DuckDB looks at no signal while several of its threads work on a query.
        connection.execute("SET threads = 1")
        try:
            with answering(connection, sql) as result:
                yield result
        except RuntimeError as exc:
            if "interrupted" not in str(exc):
                raise
            raise KeyboardInterrupt from exc


@contextmanager
def answering(
    connection: duckdb.DuckDBPyConnection, sql: str
) -> Iterator[duckdb.DuckDBPyConnection]:
    """Run one query, which reaches only the open database, to be fetched; raises UsageError.

    The connection's whole instance stays restricted.
    """
    # External access alone leaves the database's own files open to COPY ... TO.
    connection.execute(
        "SET temp_directory = ''; SET enable_external_access = false; "
        "SET disabled_filesystems = 'LocalFileSystem'; SET lock_configuration = true"
    )
    kinds = duckdb.StatementType
    try:
        statements = connection.extract_statements(sql)
        # A PIVOT consists of several.
        reading = (kinds.SELECT, kinds.EXPLAIN, kinds.MULTI)
        if [each.type in reading for each in statements] != [True]:
            raise UsageError(
                "one query at a time, and one that only reads: SELECT, FROM, WITH, VALUES, "
                "PIVOT, SUMMARIZE, DESCRIBE, SHOW or EXPLAIN"
            )
        connection.execute(statements[0])
        yield connection
    except duckdb.IOException:
        raise  # a query reaches no file but the database, so it is the database that is damaged
    except duckdb.OutOfMemoryException as exc:
        raise UsageError(
            f"the query needs more than the {SETTINGS['memory_limit']} of memory that it may use: "
            "ask for fewer rows or columns at once; requests and replies are long"
        ) from exc
    except (duckdb.Error, ValueError) as exc:  # or a kind of statement that the client knows not
        raise UsageError(f"the query failed: {exc}") from exc


def results_digest(path: Path, sweep_ids: Sequence[str] | None = None) -> tuple[str, int]:
    """A hash of all results, or of those of some sweeps, and the number of trials in it.

    The hash covers what happened (trials, states, decisions), whatever the order of storage, but
    not when, where or at what price: no clock times, latencies, costs, cache keys or spec hashes.
    """
    digests: dict[TrialKey, Any] = {}
    with read_database(path) as connection:
        wanted = f"SELECT trial_id, spec_hash FROM trials {only(sweep_ids)}"  # noqa: S608
        chosen = None if sweep_ids is None else {*connection.execute(wanted).fetchall()}
        for table, columns in OF_THE_DIGEST.items():
            # A trial's rows lie together in the table, which is too large to be sorted; a join
            # would mix them.
            sql = f"SELECT trial_id, spec_hash, {columns} FROM {table}"  # noqa: S608
            for key, rows in groupby(fetched(connection.execute(sql)), key=itemgetter(0, 1)):
                if chosen is not None and key not in chosen:
                    continue
                digest = digests.setdefault(key, hashlib.sha256(key[0].encode()))
                for values in sorted(rows, key=itemgetter(2, 4)):
                    digest.update(json.dumps(values[2:]).encode())
    whole = hashlib.sha256("".join(sorted(d.hexdigest() for d in digests.values())).encode())
    return whole.hexdigest(), len(digests)


def recorded_sweeps(path: Path, sweep_ids: Sequence[str]) -> tuple[list[dict[str, Any]], list[str]]:
    """The rows of sweeps (the newest if none is named) and the keys of the calls that they used.

    Raises UsageError.
    """
    with read_database(path) as connection:
        sweeps = {row["sweep_id"]: row for row in by_name(connection.execute(SWEEPS))}
        wanted = list(dict.fromkeys(sweep_ids)) or [*sweeps][-1:] or [""]
        rows = [require(sweeps, "sweep", sweep_id, f"in {path}") for sweep_id in wanted]
        keys = connection.execute(CALLS_OF, [wanted]).fetchall()
    return rows, [key for *_, key in keys]


def sweeps_with_calls(path: Path) -> list[str]:
    """Return the ids of the sweeps that asked a model, oldest first; raises UsageError."""
    with read_database(path) as connection:
        return [sweep_id for (sweep_id,) in connection.execute(THAT_ASKED).fetchall()]


def sweep_facts(path: Path, sweep_id: str) -> dict[str, Any]:
    """Count a sweep's trials, decisions and answers, by the views of facts.sql."""
    with read_database(path) as connection:
        limit_memory(connection)
        connection.execute("SET VARIABLE sweep_id = ?", [sweep_id])
        connection.execute(FACTS.read_text(encoding="utf-8"))
        append(connection, "other_models", other_models(connection))
        facts = next(by_name(connection.execute("FROM decided")))
        for name in ("outcomes", "failed", "others", "stand_ins", "same_prompts"):
            facts[name] = connection.execute(f"FROM {name}").fetchall()
        for name in ("levels", "first_looks"):
            facts[name] = list(by_name(connection.execute(f"FROM {name}")))
        return facts


def to_forget(db: Path, patterns: Sequence[str]) -> tuple[list[str], str]:
    """Return the ids of the sweeps to forget, in which * stands for anything, and all that goes.

    Raises UsageError where a pattern names nothing.
    """
    with read_database(db) as connection:
        rows = connection.execute("SELECT sweep_id FROM sweeps ORDER BY ALL").fetchall()
        known, ids = [sweep_id for (sweep_id,) in rows], []
        for pattern in patterns:
            matching = [sweep_id for sweep_id in known if fnmatchcase(sweep_id, pattern)]
            if not matching:
                raise unknown_name("sweep", pattern, known, f"in {db}; * stands for anything")
            ids += [sweep_id for sweep_id in matching if sweep_id not in ids]
        connection.execute(GOING, [ids])
        ((trials,),) = connection.execute("SELECT count(*) FROM going").fetchall()
    return ids, f"{len(ids)} sweeps ({', '.join(ids)}) and the {trials} trials of no other one"


def forget(db: Path, ids: Sequence[str]) -> None:
    """Remove sweeps, their trials, and the specs that no trial is left of; see ``to_forget``."""
    with write_database(db) as connection:
        connection.execute(GOING, [ids])
        for table in PLACES:
            connection.execute(
                f"DELETE FROM {table} WHERE (trial_id, spec_hash) IN (FROM going)"  # noqa: S608 # our tables
            )
        for table in ("sweep_trials", "sweeps"):
            connection.execute(f"DELETE FROM {table} WHERE list_contains(?, sweep_id)", [ids])  # noqa: S608 # our tables
        connection.execute(
            "DELETE FROM specs WHERE spec_hash NOT IN (SELECT spec_hash FROM trials)"
        )


def _add_factors(connection: duckdb.DuckDBPyConnection, rows: Sequence[Row]) -> None:
    """Add levels that are not stored yet."""
    keys = [row[:2] for row in rows]
    columns = "trial_id, spec_hash, factor"
    there = set(rows_of_trials(connection, columns, "trial_factors", keys).fetchall())
    append(connection, "trial_factors", (row for row in rows if row[:3] not in there))


def _add_specs(connection: duckdb.DuckDBPyConnection, specs: Mapping[str, str]) -> None:
    sql = "INSERT OR IGNORE INTO specs SELECT unnest(?), unnest(?)"
    connection.execute(sql, [list(specs), list(specs.values())])


def _key(record: TrialRecord) -> TrialKey:
    return record.spec.trial_id, record.spec.spec_hash


def _ended(connection: duckdb.DuckDBPyConnection, keys: Sequence[TrialKey]) -> dict[TrialKey, bool]:
    """Which of these trials are stored, and whether each ended: a failed one is played again."""
    columns = "(trial_id, spec_hash), status <> 'failed'"
    return dict(rows_of_trials(connection, columns, "trials", keys).fetchall())


def _add_trials(
    connection: duckdb.DuckDBPyConnection,
    played: Sequence[tuple[TrialKey, str, dict[str, list[Row]]]],
) -> dict[str, list[str]]:
    """Store whole trials, replacing failed ones; compare those that had ended before.

    Returns the ids of those that had been stored with other values, with the columns that differ.
    """
    stored = _ended(connection, [key for key, *_ in played])
    new: dict[TrialKey, dict[str, list[Row]]] = {}
    again: dict[TrialKey, dict[str, list[Row]]] = {}
    for key, status, rows in played:
        if not stored.get(key) and key not in new:
            new[key] = rows
        elif status != "failed":
            again[key] = rows
    for table in PLACES:
        for key in new.keys() & stored.keys():
            connection.execute(
                f"DELETE FROM {table} WHERE trial_id = ? AND spec_hash = ?",  # noqa: S608 # constants
                key,
            )
        append(connection, table, chain.from_iterable(rows[table] for rows in new.values()))
    _add_factors(connection, [row for rows in again.values() for row in rows[FACTORS]])
    differing: dict[str, list[str]] = {}
    # The levels of a study are no results: another one may name others for the same trial.
    for table in [table for table in PLACES if table != FACTORS] if again else []:
        there = stored_rows(connection, table, list(again))
        for key, rows in again.items():
            for difference in there.differences(key, rows[table], ignored=OF_A_RUN):
                differing.setdefault(key[0], []).append(difference.name)
    return differing
