"""A run has an end, whatever breaks in it: it is told, and stands in the table of runs."""

import asyncio
import contextlib
import json
import signal
from contextlib import closing
from dataclasses import replace
from functools import partial
from unittest.mock import Mock

import duckdb
import pytest

from merge_runner.errors import StoreError, StoreLocked
from merge_runner.llm.cache import ResponseCache
from merge_runner.llm.ledger import CallLabel, Ledger
from merge_runner.results.store import Store
from merge_runner.run import run_record, writer
from merge_runner.run.local_runner import LocalRunner
from merge_runner.run.options import Options
from merge_runner.run.plan import make_plan
from merge_runner.run.progress import Progress
from merge_runner.run.progress_file import read_snapshot
from merge_runner.run.summary import as_lines
from tests.support.crossed_study import MODEL
from tests.support.gate import HANGS_S
from tests.support.harness import PROJECT, run_sweep

CONDITIONS = ["L_4_0", "N_0_0", "R_-4_8"]


@pytest.fixture
def options(tmp_path, monkeypatch):
    monkeypatch.delenv("EMULATOR_BASE_URL", raising=False)
    return Options(tmp_path / "merge.duckdb", tmp_path / "cache", in_flight=1, quiet=True)


def a_plan(driver="emulator"):
    return make_plan("baseline", driver, repetitions=1, conditions=CONDITIONS)


async def run(options, driver="emulator"):
    async with asyncio.timeout(HANGS_S):
        return await run_sweep(a_plan(driver), options, say=print)


def ends(options):
    """How the runs in the table have ended."""
    with duckdb.connect(str(options.db), read_only=True) as connection:
        sql = "SELECT ended_at IS NOT NULL, exit_code FROM sweeps ORDER BY started_at"
        return connection.execute(sql).fetchall()


@pytest.mark.parametrize(("replay", "batches"), [(False, [1, 1, 1]), (True, [3])])
async def test_a_live_run_stores_its_trials_in_smaller_transactions_than_a_replay(
    options, monkeypatch, replay, batches
):
    await run(options)
    written, write = [], Store.write

    def counted(self, sweep_id, records, **patience):
        written.append(len(records))
        return write(self, sweep_id, records, **patience)

    monkeypatch.setattr(Store, "write", counted)
    monkeypatch.setattr(writer, "POLL_S", 1e9)  # all are stored when the run ends
    monkeypatch.setattr(writer, "LIVE_BATCH_BYTES", 1)
    await run(replace(options, db=options.db.with_name("again.duckdb"), replay=replay))
    assert [number for number in written if number] == batches


async def test_a_writer_that_breaks_ends_the_run_before_more_is_asked(options, monkeypatch):
    played, play_one = [], LocalRunner.play_one

    async def first_alone(self, spec):
        played.append(spec.trial_id)
        if len(played) > 1:
            await asyncio.Event().wait()
        return await play_one(self, spec)

    # A fault of ours: what a disk or another program does to the database breaks no writer.
    broken = Mock(side_effect=KeyError("N_0_0"))
    with monkeypatch.context() as patched:
        patched.setattr(LocalRunner, "play_one", first_alone)
        patched.setattr(Store, "write", broken)
        summary = await run(options)
    assert (summary["exit_code"], ends(options)) == (1, [(True, 1)])
    (told,) = summary["messages"]
    assert told.startswith("1 trials are not stored: the writer of results has failed (KeyError(")
    assert "run the same command again: it writes them from the recorded replies" in told
    assert summary["calls"]["cached"] == 0 < summary["calls"]["live"]
    again = await run(options)
    assert again["exit_code"] == 0, again["messages"]
    assert again["calls"]["cached"] == summary["calls"]["live"]
    monkeypatch.setattr(Store, "write", broken)
    monkeypatch.setattr(writer, "EVERY_S", 1e9)
    at_its_very_end = await run(options, "constant")
    assert at_its_very_end["messages"][0].startswith("3 trials are not stored: the writer of")
    assert ends(options) == [(True, 1), (True, 0), (True, 1)]


@pytest.mark.parametrize(
    ("what", "fault"),
    [
        ("audited_database", StoreLocked("a viewer holds it")),
        ("audited_database", StoreError("no view")),
        ("check_sweep", KeyError("a fault of ours")),
    ],
)
async def test_a_run_that_could_not_be_audited_has_ended(options, monkeypatch, fault, what):
    monkeypatch.setattr(run_record, what, Mock(side_effect=fault))
    ours = isinstance(fault, KeyError)
    with pytest.raises(KeyError) if ours else contextlib.nullcontext():
        summary = await run(options, "constant")
        assert (summary["exit_code"], summary["messages"]) == (1, [str(fault)])
    assert ends(options) == [(True, 0 if ours else 1)]


@pytest.mark.parametrize("what", ["QUERIES", "WAITS"])
async def test_ctrl_c_ends_the_audit_at_the_end(merge_runner, tmp_path, what):
    db = tmp_path / "results/merge.duckdb"
    program = await merge_runner.start(
        *("sweep", "baseline", "--model", "constant", "--conditions", "N_0_0", "--reps", 1),
        module="tests.support.audited_for_ever",
        PYTHONPATH=str(PROJECT),
        **{what: "1"},
    )
    async with asyncio.timeout(HANGS_S):
        await program.said("the audit begins")
        (told,) = tmp_path.glob("results/merge.duckdb.progress/*.json")
        snapshot = read_snapshot(db, told.stem)
        assert (snapshot.doing, snapshot.ended, snapshot.failed) == ("checking", 1, 0)
        with contextlib.ExitStack() as held:
            if what == "WAITS":
                held.enter_context(duckdb.connect(str(db)))
                (tmp_path / "held").touch()
                await program.said("waiting up to 60 s")
            program.send_signal(signal.SIGINT)
            _, told = await program.communicate()
    assert (program.returncode, told.count(b"interrupted: run the same command again")) == (130, 1)
    assert b"Traceback" not in told
    with duckdb.connect(str(db), read_only=True) as connection:
        assert connection.execute("SELECT exit_code FROM sweeps").fetchall() == [(0,)]


async def test_what_breaks_in_the_progress_is_not_lost(options, monkeypatch):
    snapshot, tasks = Progress.snapshot, []

    def broken(self, sweep_id):
        tasks.append(asyncio.current_task())
        if tasks[-1] is not tasks[0]:  # the run itself writes the first
            raise ZeroDivisionError("a fault of ours")
        return snapshot(self, sweep_id)

    monkeypatch.setattr("merge_runner.run.progress.PULSE_S", 0.0)
    monkeypatch.setattr("merge_runner.run.progress.PUBLISHED_EVERY", 1)
    monkeypatch.setattr(Progress, "snapshot", broken)
    with pytest.raises(ZeroDivisionError):
        await run(options)


@pytest.mark.parametrize("cap", [5.0, 0.5])
async def test_the_cap_is_kept_as_the_user_gave_it_whoever_else_spends_under_it(
    options, tmp_path, cap
):
    (tmp_path / "study.toml").write_text(
        'models = ["dear"]\nrepetitions = 1\nconditions = ["N_0_0"]'
    )
    (tmp_path / "models.toml").write_text(MODEL.format(name="dear", price=2.0))
    with closing(ResponseCache(options.cache)) as cache:
        reserve = partial(Ledger(cache, "other").reserve, "key", 1, 0.49, CallLabel("o3"))
        assert cache.run_now([reserve]) == [True]
    plan = make_plan(str(tmp_path / "study.toml"))
    options = replace(options, max_cost_usd=cap, ledgers=(plan.ledger, "other"))
    summary = await run_sweep(plan, options, say=print)
    with duckdb.connect(str(options.db), read_only=True) as connection:
        [(config,)] = connection.execute("SELECT config FROM sweeps").fetchall()
    assert json.loads(config)["max_cost_usd"] == cap
    assert (summary["cap_usd"], summary["cap_source"]) == (cap, "--max-cost")
    assert f"; cap: {cap:g} USD (--max-cost)" in "\n".join(as_lines(summary))
    spent = summary["sweep_cost_usd"]
    if cap == 5.0:
        assert (summary["exit_code"], spent > 0) == (0, True)
    else:
        assert summary["exit_code"] == 3
        assert spent + 0.49 <= cap
        assert f"{0.49 + spent:.4f} of 0.5 USD (--max-cost) are spent" in summary["messages"][0]
        assert "0.4900 by others under this cap" in summary["messages"][0]


async def test_a_sweep_says_where_it_stands_until_it_is_killed_and_the_next_one_tidies_up(
    merge_runner, tmp_path, emulator_url
):
    db, found = tmp_path / "m.duckdb", None
    part = ("sweep", "baseline", "--conditions", "N_0_0", "--rpm", 100, "--db", db)
    process = await merge_runner.start(*part, EMULATOR_BASE_URL=emulator_url)
    try:
        async with asyncio.timeout(HANGS_S):
            # Some of its calls are answered, and others wait.
            while not (found and any("rate limits" in text for _, text in found.rows)):
                await asyncio.sleep(0.1)
                for path in tmp_path.glob("*.progress/*.json"):
                    found = read_snapshot(db, path.stem)
        text, alive = path.read_text(), found.alive
    finally:
        process.kill()
        await process.communicate()
    assert (found.pid, found.doing) == (process.pid, "playing")
    assert dict(found.rows)["trials"] == "0/10 ended, 10 running"
    assert str(tmp_path) not in text
    assert (alive, read_snapshot(db, found.sweep_id).alive) == (True, False)
    assert (await merge_runner("sweep", "baseline", "--model", "constant", "--db", db)).code == 0
    assert not path.parent.exists()
