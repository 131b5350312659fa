"""The results database: whole trials, one version, read-only queries, and patience with locks."""

import asyncio
import shutil
import subprocess
import sys
from contextlib import closing, contextmanager
from dataclasses import replace
from datetime import datetime
from functools import partial
from pathlib import Path

import duckdb
import pytest

from merge_runner.audit.checks import audited_database, sweep_facts
from merge_runner.config import ScenarioConfig
from merge_runner.drivers.registry import PROGRAMS
from merge_runner.errors import StoreError, StoreLocked, UsageError
from merge_runner.results.appender import Buffer, append
from merge_runner.results.database import in_thread, open_database
from merge_runner.results.instance import Instance
from merge_runner.results.store import Store, query, results_digest
from merge_runner.results.sweeps import sweeps_to_export
from merge_runner.run.writer import TrialWriter
from merge_runner.trial import Trial, play_trial
from merge_runner.trial_records import TrialRecord
from tests.support.driven_trials import ask_nobody
from tests.support.gate import HANGS_S
from tests.support.harness import environment
from tests.support.specs import spec_of

SCENARIO = ScenarioConfig()
SWEEP = {"sweep_id": "s1", "name": "baseline", "started_at": datetime(2026, 1, 1)}  # noqa: DTZ001
SWEEP |= {"config": "{}", "versions": "{}"}
# DuckDB takes -c for a person at a prompt, whom it would show a bar.
SPILL = """
import os, stat, sys
from merge_runner.results.instance import SETTINGS, in_memory
asked = "SELECT current_setting('temp_directory'), current_setting('enable_progress_bar')"
with in_memory({**SETTINGS, "memory_limit": "50MB"}) as connection:
    [(folder, bar)] = connection.execute(asked).fetchall()
    connection.execute(
        "CREATE TABLE long AS SELECT range AS n, md5(range::VARCHAR) AS text FROM range(3000000)"
    )
    assert os.listdir(folder), "nothing was spilled"
    print(folder, os.getpid(), oct(stat.S_IMODE(os.stat(folder).st_mode)), bar)
"""
LOCK = "import duckdb, sys; c = duckdb.connect(sys.argv[1], len(sys.argv) > 2); print(); input()"


def keyed(record: TrialRecord) -> dict:
    return {(record.spec.trial_id, record.spec.spec_hash): record.spec}


def played(condition="L_4_0", *, driver="projected-order", **of_spec) -> TrialRecord:
    trial = spec_of(condition, **of_spec)
    drivers = {side: PROGRAMS[driver].make(SCENARIO, trial, side) for side in ("left", "right")}
    return play_trial(Trial(trial, SCENARIO, drivers), ask_nobody)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "deep/results.duckdb"


@pytest.fixture
def store(path):
    made = Store(path)
    made.begin_sweep(SWEEP, {"h": "{}"}, [])
    return made


def test_a_trial_is_stored_whole_once_and_instead_of_one_that_had_failed(store, path):
    record = played()
    error = TrialRecord(record.spec, "failed", None, 1.0, "it broke", record.states[:4], ())
    store.write("s1", [error], patience_s=1)
    assert store.ended_trials(keyed(record)) == set()
    with audited_database(path, "s1") as connection:
        failed = sweep_facts(connection, "s1")["failed"]
    assert failed == [("m/baseline/L_4_0/rep01", "it broke")]
    for again in (record, record, error):
        assert store.write("s1", [again], patience_s=1) == {}
    assert query(path, "select status, error from trials")[1] == [("finished", None)]
    decided = len(record.decisions)
    counts = "select count(*), count_if(valid) from decisions"
    assert query(path, counts)[1] == [(decided, decided)]
    stored = query(path, "select step, side, position_m, velocity_mps from states order by all")[1]
    assert stored == sorted((s.step, s.side, s.position_m, s.velocity_mps) for s in record.states)


def test_a_failed_trial_keeps_the_factor_levels_of_another_study_when_it_is_replaced(store, path):
    record = played()
    levels = (("mood", "calm"), ("hurry", "no"))
    ours = replace(record.spec, factors=levels)
    store.write("s1", [TrialRecord(ours, "failed", None, 1.0, "it broke", (), ())], patience_s=1)
    theirs = replace(record.spec, factors=(("hurry", "no"), ("speed", "low")))
    store.write("s1", [record._replace(spec=theirs)], patience_s=1)
    stored = query(path, "select factor, value, status from trial_factors join trials using "
                         "(trial_id, spec_hash) order by all")[1]  # fmt: skip
    expected = [("hurry", "no"), ("mood", "calm"), ("speed", "low")]
    assert stored == [(*level, "finished") for level in expected]


def test_a_trial_that_ends_otherwise_than_the_stored_one_is_named_and_not_stored(store, path):
    record = played()
    store.write("s1", [record], patience_s=1)
    other = played("L_4_8")._replace(spec=record.spec)
    assert store.write("s1", [other], patience_s=1).keys() == {record.spec.key}
    plan = record.decisions[3].decision
    swerve = record.decisions[3]._replace(decision=replace(plan, applied=(0.5,) * 5))
    decided = record._replace(decisions=(*record.decisions[:3], swerve, *record.decisions[4:]))
    assert store.write("s1", [decided], patience_s=1) == {record.spec.key: ["decisions.applied"]}
    assert query(path, "select count(*) from states")[1] == [(len(record.states),)]


def test_a_new_database_is_small_and_a_commit_writes_no_log_beside_it(store, path):
    assert path.stat().st_size < 2**18
    with open_database(path, read_only=False, patience_s=1) as connection:
        connection.begin()
        append(connection, "sweep_trials", [("sweep", "trial", "spec")])
        connection.commit()
        logs = [file for file in path.parent.glob("*.wal") if file.stat().st_size]
    assert not logs


def test_two_specs_of_one_trial_stay_apart_and_a_changed_condition_needs_another_name(store, path):
    one, other = played(), played(spec_hash="g")
    store.write("s1", [one, other], patience_s=1)
    named = keyed(other) | {(one.spec.trial_id, "x"): one.spec}
    assert store.ended_trials(named) == {(one.spec.trial_id, "g")}
    assert results_digest(path)[1] == 2
    changed = [record._replace(merged_first=None) for record in (one, other)]
    assert store.add_recorded(changed, {}) == (0, 0, [one.spec.trial_id] * 2)
    with duckdb.connect(str(path)) as connection:
        connection.execute("UPDATE trials SET projected_headway_m = 3")
    with pytest.raises(UsageError, match=r"is stored with a headway of 3 m .* a new name"):
        store.ended_trials(keyed(one))


def test_the_digest_sees_every_result_and_no_order(tmp_path):
    records = [played(c) for c in ("L_4_0", "N_0_0")]

    def digest(name, order):
        store = Store(tmp_path / name)
        store.begin_sweep(SWEEP, {}, [])
        for record in order:
            store.write("s1", [record], patience_s=1)
        return results_digest(tmp_path / name)[0]

    base = digest("a", records)
    assert digest("b", records[::-1]) == base
    for table, change in (
        ("states", "velocity_mps = velocity_mps + 1e-15 * velocity_mps"),
        ("trials", "merged_first = 'nobody'"),
        ("decisions", "applied = [0.125]"),
    ):
        digest(table, records)
        with duckdb.connect(str(tmp_path / table)) as connection:
            connection.execute(f"UPDATE {table} SET {change}")
        assert results_digest(tmp_path / table)[0] != base, table


def test_the_digest_of_all_sweeps_is_that_of_the_whole_database_whatever_its_size(store, path):
    """DuckDB reads a table of several row groups in threads: a join mixes their rows."""
    store.write("s1", [played()], patience_s=1)
    with duckdb.connect(str(path)) as connection:
        (rows,) = connection.execute("SELECT count(*) FROM states").fetchone()
        copies = 3 * 122_880 // rows
        for table in ("trials", "states", "sweep_trials"):
            connection.execute(
                f"INSERT INTO {table} SELECT {table}.* REPLACE (trial_id || '-' || range AS "
                f"trial_id) FROM {table}, range({copies}) ORDER BY range"
            )
    whole = results_digest(path)
    assert whole[1] == copies + 1
    assert [results_digest(path, ["s1"]) for _ in range(3)] == [whole] * 3


def test_a_name_means_another_file_in_another_folder(tmp_path, monkeypatch):
    for folder in (tmp_path / "one", tmp_path / "two"):
        folder.mkdir()
        monkeypatch.chdir(folder)
        Store(Path("merge.duckdb")).begin_sweep(SWEEP, {"h": "{}"}, [])
        assert query(Path("merge.duckdb"), "SELECT sweep_id FROM sweeps")[1] == [("s1",)]


def test_another_program_s_database_is_refused_also_if_all_of_it_is_in_its_log(tmp_path):
    used, copied = tmp_path / "used.duckdb", tmp_path / "copied.duckdb"
    with duckdb.connect(str(used)) as connection:
        connection.execute("CREATE TABLE theirs (a INTEGER)")
        for suffix in ("", ".wal"):  # as after a power cut
            shutil.copy(f"{used}{suffix}", f"{copied}{suffix}")
    with pytest.raises(UsageError, match="not a database of merge-runner"):
        Store(copied)


@pytest.fixture
def holder(path):
    """Another process that holds the database until its standard input closes."""

    @contextmanager
    def hold(*to):
        command, pipe = [sys.executable, "-c", LOCK, str(path), *to], subprocess.PIPE
        process = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True)
        assert process.stdout.readline() == "\n"
        yield process
        process.communicate("\n")

    return hold


async def test_trials_wait_in_memory_while_the_database_is_locked(store, path, holder):
    said = []
    waiting = TrialWriter(store, "s1", said.append)
    waiting.add(await asyncio.to_thread(played))
    with holder() as process:
        closing = asyncio.create_task(waiting.close())
        while not said:
            await asyncio.sleep(0.05)
    await closing
    assert f"1 trials wait to be stored: {path} is held by python" in said[0]
    assert f"(PID {process.pid}): close it there" in said[0]
    assert query(path, "select count(*) from trials")[1] == [(1,)]


def test_rows_are_converted_before_the_database_is_locked(store, holder):
    unfit = played()._replace(status="failed", error="half of a pair: \ud800")
    with holder(), pytest.raises(StoreError, match=r"cannot be used: .* surrogate"):
        store.write("s1", [played(), unfit], patience_s=0)


def test_rows_that_are_added_to_no_open_database_are_refused():
    with closing(Buffer({"table_of_a_file": {"number": "BIGINT"}})) as buffer:
        buffer.add({"table_of_a_file": [(1,)]})
        with pytest.raises(duckdb.ConstraintException):
            buffer.flush()


def test_a_database_that_this_process_holds_itself_is_named_unless_we_hold_it(store, path):
    own = "is open in this process .* as by duckdb.connect: close that connection"
    with duckdb.connect(path):
        with pytest.raises(StoreLocked, match=own):
            query(path, "SELECT 1")
        with pytest.raises(StoreLocked, match=own):
            store.write("s1", [], patience_s=HANGS_S)
    ours = open_database(path, read_only=True, patience_s=1, instance=Instance())
    with ours, pytest.raises(StoreLocked, match="held by another program"):
        store.write("s1", [], patience_s=0.01)


def test_what_does_not_fit_into_memory_goes_to_a_private_folder_that_ends_with_the_process(
    tmp_path,
):
    command, env = [sys.executable, "-c", SPILL], environment(TMPDIR=str(tmp_path))
    done = subprocess.run(command, env=env, capture_output=True, text=True, check=True)
    folder, pid, mode, bar = done.stdout.split()
    assert Path(folder).parent == tmp_path
    assert pid not in folder
    assert (mode, bar) == ("0o700", "False")
    assert list(tmp_path.iterdir()) == []


def test_what_only_reads_does_not_open_the_file_for_writing(store, holder):
    record = played()
    store.write("s1", [record], patience_s=1)
    with holder("read only"):
        assert store.ended_trials(keyed(record)) == set(keyed(record))
        assert store.decisions_by_spec(["another"]) == []
        with pytest.raises(StoreLocked):
            store.write("s1", [], patience_s=0.01)


async def test_ctrl_c_that_comes_before_a_reading_is_waited_for_ends_it_too(
    store, path, monkeypatch
):
    wait, interrupts = asyncio.wait, iter([KeyboardInterrupt])

    async def interrupted(*arguments, **more):
        for interrupt in interrupts:
            raise interrupt
        return await wait(*arguments, **more)

    monkeypatch.setattr(asyncio, "wait", interrupted)
    for_ever = f"SELECT count(*) FROM range({10**15}) WHERE hash(range) = 7"
    with pytest.raises(KeyboardInterrupt):
        await in_thread(partial(query, path, for_ever))


def test_an_instance_that_is_dropped_leaves_the_connections_of_others_open():
    """Closing it would close those of other threads with it; it ends with the last of them."""
    instance = Instance()
    with instance.cursor() as of_another_thread:
        instance.drop()
        assert of_another_thread.execute("SELECT 1").fetchall() == [(1,)]
    with instance.cursor() as again:
        assert again.execute("SELECT 1").fetchall() == [(1,)]


@pytest.mark.parametrize("is_stored", [True, False])
def test_the_newest_sweep_with_stored_calls_is_exported_or_else_the_newest(golden, is_stored):
    db, asked = golden / "golden.duckdb", []
    with_calls = """JOIN sweep_trials USING (sweep_id)
    JOIN decisions USING (trial_id, spec_hash) WHERE call_key IS NOT NULL"""
    sql = f"SELECT sweep_id FROM sweeps {with_calls if is_stored else ''} ORDER BY started_at DESC"
    sweeps, keys = sweeps_to_export(db, [], lambda keys: asked.append(keys) or is_stored)
    newest = query(db, sql)[1][0]
    assert [(sweep["sweep_id"],) for sweep in sweeps] == [newest]
    assert keys == sweeps_to_export(db, newest, bool)[1]
    assert all(asked)
    assert (asked == [keys]) is is_stored


def test_a_database_without_a_sweep_has_none_to_export(path):
    Store(path)
    with pytest.raises(UsageError, match="holds no sweep"):
        sweeps_to_export(path, [], bool)
