"""Queries of a browser run on a copy of the database, and within limits."""

import gc
import os
import shutil
import tempfile
import threading
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path

import duckdb
import pytest

from merge_runner.errors import UsageError
from merge_runner.results.database import open_database
from merge_runner_analysis.web import queries as module
from merge_runner_analysis.web.queries import Queries
from merge_runner_analysis.web.reading import Copies
from tests.support.cases import cases, table
from tests.support.gate import HANGS_S
from tests.support.harness import contents
from tests.support.studies import write_study, yielding

ENDLESS = "WITH RECURSIVE r AS (SELECT 1 AS n UNION ALL SELECT n + 1 FROM r) SELECT max(n) FROM r"


def texts(rows):
    return [[cell and cell[0] for cell in row] for row in rows]


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    folder = tmp_path_factory.mktemp("queries")
    return write_study(folder / "study.duckdb", yielding("o3", reps=1)[:2])


@pytest.fixture(scope="module")
def queries(study):
    return Queries(Copies(study), longest_s=HANGS_S)


@pytest.fixture
def own(study, tmp_path):
    """A database that a test may change."""
    return shutil.copy(study, tmp_path / "own.duckdb")


def refusal(queries, sql):
    with pytest.raises(UsageError) as refused:
        queries.result(sql)
    assert "Stack Trace" not in str(refused.value)
    return str(refused.value)


@pytest.mark.parametrize("case", cases("explorer", "refused-queries"))
def test_what_is_more_than_a_query_of_the_database_is_refused_and_changes_nothing(
    study, queries, case
):
    before = contents(study.parent)
    assert case["told"] in refusal(queries, case["sql"])
    assert contents(study.parent) == before


def test_an_unknown_column_is_said_with_its_place_and_with_those_that_it_may_have_been(queries):
    first, candidates, *_, line, place = refusal(queries, "SELECT statu FROM trials").splitlines()
    assert ("not found" in first, "status" in candidates) == (True, True)
    assert (line, place.strip()) == ("LINE 1: SELECT statu FROM trials", "^^^^^")


def test_what_is_too_long_cannot_be_copied_or_is_no_database_is_said_in_a_line(
    study, tmp_path, monkeypatch
):
    (tmp_path / "text.duckdb").write_text("no database")
    told = refusal(Queries(Copies(tmp_path / "text.duckdb")), "SELECT 1")
    assert "cannot be opened as a database" in told
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "none"))
    told = refusal(Queries(Copies(study)), "SELECT 1")
    assert ("cannot be copied" in told, str(tmp_path) in told) == (True, False)
    assert "up to 10,000 characters" in refusal(Queries(Copies(study)), "x" * 10_001)


def test_values_of_all_kinds_become_texts(queries):
    expressions, shown = zip(*table("explorer", "values").values(), strict=True)
    found = queries.result(f"SELECT NULL, {', '.join(expressions)}")
    assert texts(found.rows) == [[None, *shown]]
    assert found.columns[1][1] == "BOOLEAN"


def test_a_large_result_is_cut_and_says_so(queries, monkeypatch):
    found = queries.result("SELECT range, repeat('x', 2100) AS x FROM range(1000000)")
    assert (len(found.rows), found.more) == (1000, True)
    assert found.rows[999] == [("999", 0), ("x" * 2000, 100)]
    monkeypatch.setattr(module, "SIZE", 100_000)
    found = queries.result("SELECT repeat('x', 900) FROM range(999)")
    assert (50 < len(found.rows) < 120, found.more) == (True, True)
    assert queries.result("FROM range(1000)").more is False


def test_a_download_is_whole_or_refused(queries, monkeypatch):
    csv = queries.csv("SELECT 'a,\"b' AS x, NULL AS y, repeat('é', 3000) AS z FROM range(101)")
    assert csv.splitlines() == ["x,y,z", *['"a,""b",,' + "é" * 3000] * 101]
    assert queries.csv("SELECT 1 AS x WHERE false") == "x\n"
    monkeypatch.setattr(module, "DOWNLOADED_ROWS", 100)
    assert len(queries.csv("FROM range(100)").splitlines()) == 101
    with pytest.raises(UsageError, match="up to 100 rows"):
        queries.csv("FROM range(101)")
    monkeypatch.setattr(module, "DOWNLOADED", 200)
    with pytest.raises(UsageError, match="has more"):
        queries.csv("FROM range(99)")


def test_what_needs_too_much_memory_is_stopped(queries):
    sql = "SELECT list(range || repeat('x', 1000)) FROM range(10000000)"
    assert refusal(queries, sql) == "the query needed more than 512 MB"


def test_a_sweep_writes_while_a_query_runs_which_is_stopped_in_time(own):
    copies = Copies(own)
    copy, said = copies.current(), []
    queries = Queries(copies, longest_s=0.5)
    asking = threading.Thread(target=lambda: said.append(refusal(queries, ENDLESS)))
    asking.start()
    with open_database(own, read_only=False, patience_s=0) as connection:
        connection.execute("DELETE FROM sweeps")
    asking.join(HANGS_S)
    assert said == ["stopped after 0.5 s"]
    assert copies.current() is not copy


def test_what_lies_in_the_log_beside_the_database_is_read(own, tmp_path):
    crashed = tmp_path / "crashed.duckdb"
    with duckdb.connect(str(own)) as connection:
        connection.execute("SET checkpoint_threshold = '1TB'; INSERT INTO meta VALUES (-1)")
        for end in ("", ".wal"):
            shutil.copy(f"{own}{end}", f"{crashed}{end}")
    assert Path(f"{crashed}.wal").stat().st_size > 0
    # Read by a copy of its own: the database is not read first, for what lies there is damaged.
    queries = Queries(Copies(crashed), longest_s=HANGS_S)
    assert texts(queries.result("SELECT min(schema_version) FROM meta").rows) == [["-1"]]


def test_a_copy_lasts_while_the_file_stays_and_leaves_nothing(own, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    before = contents(tmp_path)
    copies = Copies(own)
    first = copies.current()
    assert copies.current() is first
    assert os.fstat(first.fd).st_size > 0
    assert contents(tmp_path) == before
    os.utime(own, ns=(0, 0))
    second = copies.current()
    kept = [first.fd, second.fd]
    assert len({os.fstat(fd).st_ino for fd in kept}) == 2
    del first, second, copies
    gc.collect()
    for fd in kept:
        with pytest.raises(OSError, match="Bad file descriptor"):
            os.fstat(fd)


def test_who_is_one_too_many_is_told_at_once(study):
    going = threading.Event()

    class Held(Copies):
        def current(self):
            going.wait(HANGS_S)
            return super().current()

    queries = Queries(Held(study), longest_s=HANGS_S)
    many = module.AT_ONCE + module.WAITING
    with ThreadPoolExecutor(many + 1) as others:
        asked = [others.submit(queries.result, "SELECT 1") for _ in range(many + 1)]
        ((first,), _) = wait(asked, HANGS_S, "FIRST_COMPLETED")
        assert "too many queries are waiting" in str(first.exception())
        going.set()
    assert [each.exception() for each in asked if each is not first] == [None] * many
