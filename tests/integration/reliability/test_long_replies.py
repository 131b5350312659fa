"""Replies as long as reasoning texts are: nothing holds many of them in memory."""

import os
from itertools import islice

import pytest

from merge_runner.llm.cache import ResponseCache
from merge_runner.results.appender import append
from merge_runner.results.database import ROWS_OF_A_GROUP, open_database, read_database, schema_sql
from merge_runner.results.instance import (
    BYTES_OF_A_CALL,
    MANY_CALLS,
    MERGED_BYTES,
    SETTINGS,
    in_memory,
    limit_memory,
    merge_small_groups,
)
from merge_runner.results.recording import export_recording, read_recording
from merge_runner.results.store import Store
from tests.support.harness import RECORDING


def test_a_recording_of_any_size_is_exported_in_the_same_order_and_with_the_same_hash(
    tmp_path, monkeypatch
):
    entries = list(islice(read_recording(RECORDING), 300))
    cache = ResponseCache(tmp_path / "cache")
    cache.put_now(entries)
    contents = []
    for at_once in (16, 7):
        monkeypatch.setattr("merge_runner.results.recording.WRITTEN_AT_ONCE", at_once)
        file = tmp_path / f"{at_once}.parquet"
        export_recording(file, cache, [e.request.key for e in entries], {})
        contents.append(list(read_recording(file)))
    assert contents[0] == contents[1] == entries


@pytest.mark.parametrize(("added", "fewest", "most"), [(20, 1, 18), (MANY_CALLS, 20, 30)])
def test_small_groups_are_merged_a_few_at_a_time_to_ones_that_fit_into_memory(
    tmp_path, added, fewest, most
):
    """The last write, which is small, does not merge all groups of the others."""

    def opened(*, read_only):
        return open_database(tmp_path / "study.duckdb", read_only=read_only, patience_s=1)

    with opened(read_only=False) as connection:
        connection.execute(schema_sql())
    for calls in [added] * 29 + [20]:
        with opened(read_only=False) as connection:
            merge_small_groups(connection, calls)
            append(connection, "sweep_trials", [("sweep", "trial", "spec")] * 1_000)
    with opened(read_only=True) as connection:
        # A write merges only if it asks for that: the end of a sweep may use 1 GB of memory.
        assert connection.execute("SELECT current_setting('max_vacuum_tasks')").fetchone() == (0,)
        groups = connection.execute(
            "SELECT max(count) FROM pragma_storage_info('sweep_trials') GROUP BY row_group_id"
        ).fetchall()
    assert fewest <= len(groups) <= most
    assert max(groups) <= (ROWS_OF_A_GROUP,)


def test_small_groups_are_merged_unless_texts_are_long_or_calls_many(tmp_path):
    def tasks(size, added=20):
        """The tasks of merging where the file has this size."""
        os.truncate(file, size)
        merge_small_groups(connection, added)
        return connection.execute("SELECT current_setting('max_vacuum_tasks')").fetchone()

    file = tmp_path / "file.duckdb"
    connection = in_memory(SETTINGS)
    connection.execute(f"ATTACH '{file}' AS file; USE file")
    connection.execute("CREATE TABLE calls AS SELECT * FROM range(10_000)")
    connection.execute("CHECKPOINT")
    short = 10_000 * BYTES_OF_A_CALL + MERGED_BYTES
    assert tasks(short) == (1,)
    assert tasks(short + 1) == tasks(short, MANY_CALLS) == (0,)


@pytest.mark.parametrize(
    ("stored", "longest", "calls", "is_little"),
    [(100, 0, 9, True), (100, 9_000, 9, False), (9_000, 0, 9, False), (1, 1, 300_000, False)],
)
def test_memory_is_little_where_texts_are_short_and_calls_not_many(
    stored, longest, calls, is_little
):
    connection = in_memory(SETTINGS)
    connection.execute(
        "CREATE TABLE calls AS SELECT 'asked' AS request, repeat('a', ?) AS reply FROM range(?)",
        [stored, calls],
    )
    limit_memory(connection, longest)
    limits = "SELECT current_setting('memory_limit'), current_setting('threads')"
    expected = ("104.9 MiB", 1) if is_little else ("953.6 MiB", 2)
    assert connection.execute(limits).fetchone() == expected


def test_what_limits_one_database_does_not_limit_the_next(tmp_path):
    Store(tmp_path / "one.duckdb").write(None, [])
    Store(tmp_path / "two.duckdb")
    with read_database(tmp_path / "two.duckdb") as connection:
        (limit,) = connection.execute("SELECT current_setting('memory_limit')").fetchone()
    assert limit == "953.6 MiB"
