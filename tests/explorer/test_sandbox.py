"""Queries of a browser run in a process of their own, on a copy, and within bounds."""

from __future__ import annotations

import contextlib
import gc
import os
import shutil
import tempfile
import threading
import time
from dataclasses import asdict
from pathlib import Path

import duckdb
import pytest

from analysis.explorer import child, query_worker
from analysis.explorer import query_process as sandbox
from analysis.explorer.child import Ended, NoAnswer
from analysis.explorer.query_process import Sandbox
from analysis.explorer.query_worker import Caps, Query
from merge_runner.errors import UsageError
from merge_runner.paths import PROJECT
from merge_runner.results.database import open_database
from tests.analysis.studies import write_study, yielding

pytestmark = pytest.mark.long

PROC = Path("/proc")
LOADED_S = 60  # what a process may wait for its turn on a machine that does much else
ENDLESS = "WITH RECURSIVE r AS (SELECT 1 AS n UNION ALL SELECT n + 1 FROM r) SELECT max(n) FROM r"
REFUSED = {
    "INSERT INTO meta VALUES (9)": "one that only reads",
    "WITH x AS (INSERT INTO meta VALUES (9) RETURNING *) FROM x": "read-only",
    "COPY trials TO 'out.csv'": "one that only reads",
    "ATTACH 'new.duckdb'": "one that only reads",
    "INSTALL httpfs": "one that only reads",
    "LOAD httpfs": "one that only reads",
    "SET memory_limit = '1TB'": "one that only reads",
    "PRAGMA threads = 9": "one that only reads",
    "SELECT 1; DROP TABLE meta": "one query at a time",
    "EXPLAIN ANALYZE COPY (SELECT 1) TO 'out.csv'": "disabled",
    "FROM read_csv('/etc/passwd', sep = ':')": "disabled",
    "FROM glob('/*')": "disabled",
    "SELECT getenv('OPENAI_API_KEY')": "getenv does not exist",
}


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sandbox")
    return write_study(folder / "study.duckdb", yielding("o3", reps=1)[:2])


@pytest.fixture(scope="module")
def queries(study):
    return Sandbox(study, Caps(seconds=LOADED_S))


@pytest.fixture
def run(study, monkeypatch):
    """Runs a query as its process would, in this one: starting one takes longer than most."""
    monkeypatch.setattr(query_worker, "_confine", lambda caps: None)

    def answer(sql, *, as_csv=False, rows=1000, size=5_000_000):
        query = Query(str(study), sql, as_csv, Caps(rows=rows, size=size))
        said, content = query_worker._run(query)
        return content if as_csv and not said else said

    return answer


@pytest.fixture
def own(study, tmp_path):
    """A database that a test may change."""
    return shutil.copy(study, tmp_path / "own.duckdb")


def contents(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def refusal(queries, sql):
    with pytest.raises(NoAnswer) as refused:
        queries.result(sql)
    assert len(str(refused.value).splitlines()) == 1
    return str(refused.value)


def texts(rows):
    return [[cell and cell[0] for cell in row] for row in rows]


def test_what_is_more_than_a_query_of_the_database_is_refused_and_changes_nothing(study, run):
    before = contents(study.parent)
    for sql, words in REFUSED.items():
        with pytest.raises(UsageError) as refused:
            run(sql)
        assert words in str(refused.value), sql
    assert contents(study.parent) == before


def test_values_of_all_kinds_become_texts(run):
    values = {
        "NULL": None,
        "true": "true",
        "170141183460469231731687303715884105727::HUGEINT": str(2**127 - 1),
        "0.1": "0.1",
        "'nan'::DOUBLE": "nan",
        "'-inf'::FLOAT": "-inf",
        "DATE '290000-01-01'": "290000-01-01",
        "TIMESTAMP '2026-01-02 03:04:05.5'": "2026-01-02 03:04:05.500000",
        "'\\xAA\\x00'::BLOB": "0xaa00",
        "[1.5::DOUBLE, NULL, 'nan']": "[1.5, null, NaN]",
        "{'x': [DATE '2026-01-02'], 'y': '<é\"'}": '{"x": ["2026-01-02"], "y": "<é\\""}',
        "MAP([[1]], [2])": '{"key": [[1]], "value": [2]}',
        "'a' || chr(0) || chr(8238)": "a\0\u202e",
    }
    said = run(f"SELECT {', '.join(values)}")
    assert texts(said["rows"]) == [list(values.values())]
    assert said["columns"][1][1] == "BOOLEAN"


def test_a_large_result_is_cut_and_says_so(run):
    said = run("SELECT range, repeat('x', 2100) AS x FROM range(1000000000)")
    assert (len(said["rows"]), said["more"]) == (1000, True)
    assert said["rows"][999] == [("999", 0), ("x" * 2000, 100)]
    said = run("SELECT repeat('x', 900) FROM range(999)", size=100_000)
    assert (50 < len(said["rows"]) < 120, said["more"]) == (True, True)
    assert run("FROM range(1000)")["more"] is False


def test_a_plan_of_execution_is_whole(run):
    ((_, (plan, left_out)),) = run("EXPLAIN FROM trial_metrics")["rows"]
    assert len(plan) > 10_000
    assert left_out == 0


def test_a_download_is_whole_or_refused(run):
    csv = run("SELECT 'a,\"b' AS x, NULL AS y, repeat('é', 3000) AS z FROM range(101)", as_csv=True)
    assert csv.decode().splitlines() == ["x,y,z", *['"a,""b",,' + "é" * 3000] * 101]
    assert run("SELECT 1 AS x WHERE false", as_csv=True) == b"x\n"
    assert len(run("FROM range(100)", as_csv=True, rows=100).splitlines()) == 101
    assert "up to 100 rows" in run("FROM range(101)", as_csv=True, rows=100)["error"]
    assert "has more" in run("FROM range(1000)", as_csv=True, size=1000)["error"]


def test_a_query_is_answered_and_a_refusal_is_one_line(queries):
    before = contents(queries.db.parent)
    result = queries.result("SELECT '\u202e<é' AS x")
    assert (result.columns, result.rows) == ([("x", "VARCHAR")], [[["\u202e<é", 0]]])
    writing = "WITH x AS (INSERT INTO meta VALUES (9) RETURNING *) FROM x"
    assert "read-only" in refusal(queries, writing)
    assert contents(queries.db.parent) == before


def test_no_query_tells_where_anything_lies_on_the_machine(queries):
    telling = ["FROM duckdb_settings()", "FROM duckdb_databases()", "FROM pragma_database_list",
               "FROM pg_catalog.pg_database", "FROM pg_settings", "FROM duckdb_temporary_files()",
               "FROM duckdb_secrets()", "FROM duckdb_logs()", "FROM duckdb_schemas()",
               "SELECT current_setting('allowed_paths') AS x"]  # fmt: skip
    parts = [f"SELECT to_json(t)::VARCHAR AS said FROM ({sql}) t" for sql in telling]
    whole = f"SELECT string_agg(said) AS x FROM ({' UNION ALL '.join(parts)})"
    said = queries.csv(
        f"{whole} UNION ALL SELECT a::VARCHAR FROM (SHOW allowed_paths) t(a)"
    ).decode()
    assert "allowed_paths" in said
    for place in (tempfile.gettempdir(), Path.home(), PROJECT, queries.db.parent):
        assert str(place) not in said


def test_no_refusal_tells_where_anything_lies_on_the_machine(tmp_path, monkeypatch):
    (tmp_path / "text.duckdb").write_text("no database")
    queries = Sandbox(tmp_path / "text.duckdb")
    assert refusal(queries, "SELECT 1").startswith("text.duckdb cannot be opened as a database")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "none"))
    assert "no room" in refusal(queries, "SELECT 1")
    assert str(tmp_path) not in refusal(queries, "SELECT 1")


def test_what_needs_too_much_memory_is_stopped_soon(queries):
    began = time.monotonic()
    assert refusal(queries, "SELECT repeat('x', 2000000000)") == "the query needed more than 512 MB"
    assert time.monotonic() - began < 2 * LOADED_S


def test_an_endless_query_is_stopped_in_time(queries):
    began = time.monotonic()
    assert refusal(Sandbox(queries.db, Caps(seconds=2)), ENDLESS) == "stopped after 2 s"
    assert time.monotonic() - began < 2 + LOADED_S


def test_a_sweep_writes_while_a_query_runs(own, monkeypatch):
    monkeypatch.setenv("OPENAI_API_KEY", "sk-secret")
    processes = recorded(monkeypatch, "subprocess.Popen")
    clocks = recorded(monkeypatch, "threading.Timer")
    queries = Sandbox(own, Caps(seconds=60))
    copy = queries._current()
    said = []
    asking = threading.Thread(target=lambda: said.append(refusal(queries, ENDLESS)))
    asking.start()
    until(lambda: len(processes) == 2 and reads(processes[1], copy))
    with open_database(own, read_only=False, patience_s=0) as connection:
        connection.execute("DELETE FROM sweeps")
    if PROC.exists():
        assert b"sk-secret" not in (PROC / str(processes[1].pid) / "environ").read_bytes()
    assert processes[1].poll() is None
    clocks[1].function()  # as if its time were over
    asking.join(LOADED_S)
    assert said == ["stopped after 60 s"]
    assert processes[1].poll() is not None
    assert queries._current() is not copy


def recorded(monkeypatch, name, *, with_options=False):
    """What is made of a class of the standard library from now on."""
    module, _, kind = name.partition(".")
    made, original = [], getattr(getattr(child, module), kind)

    def make(*arguments, **options):
        thing = original(*arguments, **options)
        made.append((thing, options) if with_options else thing)
        return thing

    monkeypatch.setattr(f"analysis.explorer.child.{name}", make)
    return made


def until(condition):
    began = time.monotonic()
    while not condition():
        assert time.monotonic() - began < LOADED_S
        time.sleep(0.02)


def reads(process, copy):
    """Whether a process has opened the copy, beside the file that it was given."""
    if not PROC.exists():
        time.sleep(1)
        return True
    file = (PROC / "self/fd" / str(copy.fd)).readlink()
    opened = []
    for number in (PROC / str(process.pid) / "fd").iterdir():
        with contextlib.suppress(OSError):  # closed meanwhile
            opened.append(number.readlink())
    return opened.count(file) > 1


def test_the_environment_of_a_query_holds_nothing_of_ours(monkeypatch):
    for name in ("ANTHROPIC_API_KEY", "HTTPS_PROXY", "HOME", "PYTHONPATH"):
        monkeypatch.setenv(name, "ours")
    started = recorded(monkeypatch, "subprocess.Popen", with_options=True)
    sandbox._worker().close()
    ((_, options),) = started
    assert "ours" not in options["env"].values()


def test_a_process_that_cannot_be_started_is_said_in_a_line(queries, monkeypatch):
    queries._current()
    monkeypatch.setattr("sys.executable", "/nowhere/python")
    assert refusal(queries, "SELECT 1") == "no process can be started: No such file or directory"


def test_a_query_ends_with_the_explorer_even_if_that_is_killed(queries):
    worker = sandbox._worker(queries._current().fd)
    query = Query(f"/dev/fd/{queries._current().fd}", ENDLESS, False, Caps())
    ended = []

    def ask():
        with pytest.raises(Ended) as exc:
            worker.ask(asdict(query), seconds=LOADED_S, most_bytes=10**6)
        ended.append(exc.value)

    asking = threading.Thread(target=ask)
    asking.start()
    until(lambda: reads(worker.process, queries._current()))
    worker.process.stdin.close()  # as the system does when a process is gone
    asking.join(LOADED_S)
    assert [(one.code, one.late) for one in ended] == [(0, False)]


def test_an_answer_is_whole_or_refused_and_one_that_is_no_answer_is_an_end(tmp_path, monkeypatch):
    (tmp_path / "parrot.py").write_text(
        "import sys\n"
        "for line in sys.stdin:\n"
        "    sys.stdout.write(__import__('json').loads(line)); sys.stdout.flush()\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))

    def said(answer, most_bytes=100):
        with contextlib.closing(child.Child("parrot")) as parrot:
            return parrot.ask(answer, seconds=LOADED_S, most_bytes=most_bytes)

    assert said('{"x": 1, "bytes": 3}\nabc') == ({"x": 1}, b"abc")
    with pytest.raises(NoAnswer, match="no such table"):
        said('{"error": "no such table", "bytes": 0}\n')
    for large in ('{"bytes": 3}\nabc', '{"bytes": 0, "x": "a long line"}\n'):
        with pytest.raises(NoAnswer, match="too large"):
            said(large, most_bytes=15)
    with pytest.raises(Ended):
        said("no JSON\n")


def test_a_child_that_fails_tells_its_own_exit_code(tmp_path, monkeypatch):
    (tmp_path / "failing.py").write_text(
        "from analysis.explorer.child import serve\nserve(lambda told: 1 / 0)\n"
    )
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}")
    with contextlib.closing(child.Child("failing", quiet=True)) as failing:
        with pytest.raises(Ended) as ended:
            failing.ask("", seconds=LOADED_S, most_bytes=100)
        assert (ended.value.code, ended.value.late) == (1, False)


def test_a_value_that_python_has_not_is_told(queries):
    with pytest.raises(NoAnswer, match="must have magnitude"):
        queries.result("SELECT INTERVAL '3000000 years'")


def test_what_lies_in_the_log_beside_the_database_is_read(own, tmp_path):
    crashed = tmp_path / "crashed.duckdb"
    with duckdb.connect(str(own)) as connection:
        connection.execute("SET checkpoint_threshold = '1TB'; INSERT INTO meta VALUES (-1)")
        for end in ("", ".wal"):
            shutil.copy(f"{own}{end}", f"{crashed}{end}")
    assert Path(f"{crashed}.wal").stat().st_size > 0
    result = Sandbox(crashed, Caps(seconds=LOADED_S)).result("SELECT min(schema_version) FROM meta")
    assert texts(result.rows) == [["-1"]]


def test_a_copy_lasts_while_the_file_stays_and_no_longer(own):
    queries = Sandbox(own)
    first = queries._current()
    assert queries._current() is first
    os.utime(own, ns=(0, 0))
    second = queries._current()
    kept = [first.fd, second.fd]
    assert len({os.fstat(fd).st_ino for fd in kept}) == 2
    del first, second
    queries.close()
    gc.collect()
    for fd in kept:
        with pytest.raises(OSError, match="Bad file descriptor"):
            os.fstat(fd)


def test_a_copy_leaves_nothing_when_the_program_is_killed(own, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    before = contents(tmp_path)
    queries = Sandbox(own)
    assert os.fstat(queries._current().fd).st_size > 0
    assert contents(tmp_path) == before


def test_who_finds_others_running_is_told_after_a_while(study):
    queries = Sandbox(study, patience_s=0.1)
    with queries._turn(), queries._turn():
        assert "2 other queries are running" in refusal(queries, "SELECT 1")
    for _ in range(sandbox.AT_ONCE + sandbox.WAITING):
        queries._places.acquire()
    assert "too many queries are waiting" in refusal(queries, "SELECT 1")


def test_what_is_no_database_is_said(tmp_path):
    (tmp_path / "text.duckdb").write_text("no database")
    assert "cannot be opened as a database" in refusal(
        Sandbox(tmp_path / "text.duckdb"), "SELECT 1"
    )
    assert "up to 10,000 characters" in refusal(Sandbox(tmp_path), "x" * 10_001)
