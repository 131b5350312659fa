"""Databases that lie elsewhere, hold more or less than ours, or cannot take what is written."""

import asyncio
import math
import signal
import subprocess
from pathlib import Path

import duckdb
import psutil
import pytest

from merge_runner.errors import UsageError
from merge_runner.llm.cache import ResponseCache
from merge_runner.results.recording import export_recording
from tests.support.harness import PROGRAM
from tests.support.studies import write_study, yielding


@pytest.fixture
def db(tmp_path):
    (tmp_path / "real").mkdir()
    return write_study(tmp_path / "real" / "m.duckdb", yielding("m", reps=1))


async def test_a_link_to_a_database_is_read_as_it_is(merge_runner, db, tmp_path):
    (tmp_path / "link.duckdb").symlink_to(db)
    await merge_runner("digest", "--db", "link.duckdb", code=0)


@pytest.mark.parametrize(
    ("renamed", "says", "commands"),
    [
        ("TO others", "Table with name states does not exist", ["digest", "tables gap", "audit"]),
        ("COLUMN step TO n", 'column "step" not found', ["digest", "tables gap"]),
    ],
)
async def test_a_table_that_is_not_there_is_told_in_one_line(
    merge_runner, db, renamed, says, commands
):
    with duckdb.connect(str(db)) as connection:
        connection.execute(f"ALTER TABLE states RENAME {renamed}")
    for command in commands:
        run = await merge_runner(*command.split(), "--db", db, code=2)
        (line,) = run.err.splitlines()
        assert says in line


@pytest.mark.parametrize("name", ["md:x", ":memory:"])
def test_a_name_of_another_kind_of_database_is_that_of_a_file(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    write_study(Path(name), yielding("m", reps=1))
    assert (tmp_path / name).is_file()


async def test_ctrl_c_within_a_query_ends_it_in_one_line(merge_runner, db):
    endless = "SELECT count(*) FROM range(1000000) AS a, range(1000000) AS b WHERE a > b"
    process = await merge_runner.start("sql", endless, "--db", db)
    running, opened_s = psutil.Process(process.pid), math.inf
    while running.cpu_times().user < opened_s + 0.2:  # it computes with the database open
        if opened_s == math.inf and str(db) in [file.path for file in running.open_files()]:
            opened_s = running.cpu_times().user
        await asyncio.sleep(0.02)
    process.send_signal(signal.SIGINT)
    _, err = await process.communicate()
    assert (process.returncode, b"Traceback" in err) == (130, False), err


def test_an_output_that_cannot_be_written_is_one_line(db):
    with open("/dev/full", "w") as full:
        run = subprocess.run(
            [PROGRAM, "sql", "FROM sweeps", "--db", str(db)],
            stdout=full, stderr=subprocess.PIPE, text=True, check=False,
        )  # fmt: skip
    assert run.returncode == 1
    assert run.stderr == "error: the output cannot be written: No space left on device\n"


async def test_nothing_is_written_over_what_is_of_another_kind(merge_runner, db):
    before = db.read_bytes()
    for command in (("report", "--out"), ("view", "--trials", "*", "--single")):
        run = await merge_runner(*command, db, "--db", db, code=2)
        assert f"{db} is there, and is no" in run.err
    assert db.read_bytes() == before


def test_a_recording_is_written_over_nothing_but_a_recording(tmp_path):
    cache = ResponseCache(tmp_path / "c")
    for _ in range(2):
        export_recording(tmp_path / "r.parquet", cache, [], {})
    with pytest.raises(UsageError, match="is there, and is no recording"):
        export_recording(tmp_path / "c/cache.db", cache, [], {})
    cache.close()
