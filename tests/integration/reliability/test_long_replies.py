"""Replies as long as reasoning texts are: nothing holds many of them in memory."""

from __future__ import annotations

import csv
import io
import json
import os
from dataclasses import replace
from itertools import islice

import pytest
from aiohttp import web
from typer.testing import CliRunner

from benchmarks.recorder import longer
from merge_runner.cli import app
from merge_runner.llm.cache import ResponseCache
from merge_runner.results.database import (
    BYTES_OF_A_CALL,
    MERGED_BYTES,
    ROWS_OF_A_GROUP,
    SETTINGS,
    append,
    in_memory,
    limit_memory,
    merge_small_groups,
    open_database,
    read_database,
    schema_sql,
)
from merge_runner.results.recording import export_recording, read_recording
from merge_runner.results.store import Store
from tests.support.harness import RECORDING, watched

SIZE, REPS = 20_480, 5
REPLAY = ("replay", "baseline", "--reps", REPS, "--cache", "cache", "--json")
PATIENT = """
[patient]
provider = "emulator"
format = "openai-chat"
max_output_tokens = 4000
price = "free"
id = "some-model"
timeout_s = 100
"""


@pytest.fixture(scope="module")
def long(prepare, tmp_path_factory):
    """A folder with a cache of a thousand replies of 20 KB, and the database of their replay."""
    folder = tmp_path_factory.mktemp("long")
    cache = ResponseCache(folder / "cache")
    entries = (e for e in read_recording(RECORDING) if e.request.slot.repetition <= REPS)
    while batch := list(islice(entries, 200)):
        cache.put_now(_lengthened(entry) for entry in batch)
    cache.close()
    run = prepare(folder, *REPLAY)
    assert run.code == 0, run.err
    assert run.summary["calls"]["cached"] > 1_000
    return folder


def _lengthened(entry):
    (*others, last) = entry.attempts
    reply = longer(last.reply, SIZE, entry.request.key)
    return replace(entry, attempts=(*others, replace(last, reply=reply)))


def command(folder, *arguments):
    db = ("--db", str(folder / "results/merge.duckdb"))
    run = CliRunner().invoke(app, [*map(str, arguments), *db])
    assert run.exit_code == 0, run.output
    return run.stdout


@pytest.mark.long
def test_a_thousand_long_replies_are_audited_and_looked_up_in_the_cache(long):
    told = json.loads(command(long, "audit", "--cache", long / "cache", "--json"))
    assert told["ok"]
    assert told["audits"][0]["counts"]["calls"] > 1_000


def test_a_thousand_long_replies_are_queried_in_every_format(long):
    query = "SELECT call_key, reply, reply->>'$.model' AS model FROM calls ORDER BY call_key"
    rows = list(csv.DictReader(io.StringIO(command(long, "sql", query, "--format", "csv"))))
    assert len(rows) > 1_000
    assert min(len(row["reply"]) for row in rows) > 0.9 * SIZE
    few = f"{query} LIMIT 20"
    assert rows[:20] == json.loads(command(long, "sql", few, "--format", "json"))
    table = command(long, "sql", few).splitlines()
    assert table[0].split() == ["call_key", "reply", "model"]
    assert [line.split()[0] for line in table[1:]] == [row["call_key"] for row in rows[:20]]


def test_a_query_that_needs_too_much_memory_says_what_to_do(long):
    query = "SELECT len(string_agg(reply || n::VARCHAR)) FROM calls, range(100) AS numbers(n)"
    db = ("--db", str(long / "results/merge.duckdb"))
    run = CliRunner().invoke(app, ["sql", query, *db])
    assert "ask for fewer rows or columns at once" in str(run.exception)


@pytest.mark.long
def test_long_replies_are_recorded_and_replayed_in_an_order_of_their_own(long, prepare):
    file = long / "long.parquet"
    assert prepare(long, "recording", "export", file, "--cache", "cache").code == 0
    assert [path.name for path in long.glob("*long.parquet*")] == ["long.parquet"]
    slots = [(e.request.slot.as_dict(), e.request.key) for e in read_recording(file)]
    assert slots == sorted(
        slots, key=lambda told: [told[0][name] for name in (
            "condition", "repetition", "side", "decision", "sample_set")]
    )  # fmt: skip
    again = prepare(long, "replay", "baseline", "--reps", REPS, "--recording", file,
                    "--db", "again.duckdb", "--cache", "none", "--json")  # fmt: skip
    assert again.code == 0, again.err
    digests = [
        prepare(long, "digest", "--db", db).out for db in ("again.duckdb", "results/merge.duckdb")
    ]
    assert digests[0] == digests[1]


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


def test_small_groups_are_merged_to_ones_that_fit_into_memory(tmp_path):
    def opened(*, read_only):
        return open_database(tmp_path / "study.duckdb", read_only=read_only, patience_s=1)

    with opened(read_only=False) as connection:
        connection.execute(schema_sql())
    for _ in range(30):
        with opened(read_only=False) as connection:
            merge_small_groups(connection)
            append(connection, "sweep_trials", [("sweep", "trial", "spec")] * 1_000)
    with opened(read_only=True) as connection:
        groups = connection.execute(
            "SELECT max(count) FROM pragma_storage_info('sweep_trials') GROUP BY row_group_id"
        ).fetchall()
    assert len(groups) < 10
    assert max(groups) <= (ROWS_OF_A_GROUP,)


def test_small_groups_are_merged_unless_texts_are_long(tmp_path):
    def tasks(size):
        """The tasks of merging where the file has this size."""
        os.truncate(file, size)
        merge_small_groups(connection)
        return connection.execute("SELECT current_setting('max_vacuum_tasks')").fetchone()

    file = tmp_path / "file.duckdb"
    connection = in_memory(SETTINGS)
    connection.execute(f"ATTACH '{file}' AS file; USE file")
    connection.execute("CREATE TABLE calls AS SELECT * FROM range(10_000)")
    connection.execute("CHECKPOINT")
    short = 10_000 * BYTES_OF_A_CALL + MERGED_BYTES
    assert tasks(short) == (100,)
    assert tasks(short + 1) == (0,)


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


@pytest.mark.long
@pytest.mark.parametrize(("reply_mb", "trials", "seconds"), [(15, 1, 8), (2, 4, 30)])
async def test_every_reply_below_max_reply_mb_is_stored(
    merge_runner, tmp_path, reply_mb, trials, seconds
):
    thought = "The gap is too small for me. " * round(reply_mb * 1e6 / 29)
    both_stop = f"M\n\nI brake.\n\n{[-1] * 20}"

    async def middle(request, handler):
        body = json.loads((await handler(request)).body)
        said = {"role": "assistant", "content": both_stop, "reasoning_content": thought}
        body["choices"][0]["message"] = said
        return web.json_response(body)

    (tmp_path / "models.toml").write_text(PATIENT)
    (tmp_path / "study.toml").write_text(
        f"[repetitions]\nbaseline = {trials}\n[scenario]\ntimeout_s = {seconds}\n"
    )
    async with watched(middle) as server:
        run = await merge_runner(
            "sweep", "study.toml", "--model", "patient", "--conditions", "L_4_0", "--json",
            EMULATOR_BASE_URL=f"{server.url}/v1",
        )  # fmt: skip
    if server.requests != 2 * trials * seconds:
        pytest.fail(run.err)  # whatever is stored
    assert run.code == 0, run.err
    query = "SELECT count(*) AS calls, min(len(reply)) AS shortest FROM calls"
    (stored,) = json.loads((await merge_runner("sql", query, "--format", "json")).out)
    assert stored["calls"] == server.requests
    assert stored["shortest"] > len(thought)
