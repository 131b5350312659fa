"""A run has an end, whatever breaks in it: it is told, and stands in the table of runs."""

from __future__ import annotations

import asyncio
import contextlib
import json
import signal
from contextlib import closing
from dataclasses import replace
from unittest.mock import Mock

import duckdb
import pytest

from merge_runner.errors import StoreError, StoreLocked
from merge_runner.llm.cache import ResponseCache
from merge_runner.llm.ledger import Asked, Ledger
from merge_runner.results.store import Store
from merge_runner.run import local_runner, sweep
from merge_runner.run.local_runner import LocalRunner
from merge_runner.run.plan import Options, make_plan
from merge_runner.run.progress import Progress
from tests.support.gate import HANGS_S
from tests.support.harness import PROJECT, run_sweep

CONDITIONS = ["L_4_0", "N_0_0", "R_-4_8"]


@pytest.fixture(autouse=True)
def _emulator_in_this_process(monkeypatch):
    monkeypatch.delenv("EMULATOR_BASE_URL", raising=False)


@pytest.fixture
def options(tmp_path):
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


async def test_a_writer_that_breaks_ends_the_run_before_more_is_asked(options, monkeypatch):
    played, play_one = [], LocalRunner.play_one

    async def first_alone(self, spec):
        played.append(spec.trial_id)
        if len(played) > 1:
            await asyncio.Event().wait()
        return await play_one(self, spec)

    with monkeypatch.context() as patched:
        patched.setattr(local_runner, "EVERY_S", 0.0)
        patched.setattr(LocalRunner, "play_one", first_alone)
        patched.setattr(Store, "write", Mock(side_effect=duckdb.Error("no memory")))
        summary = await run(options)
    assert summary["exit_code"] == 1
    (told,) = summary["messages"]
    assert told.startswith("1 trials are not stored: the writer of results has failed (")
    assert "Error('no memory')" in told
    assert "run the same command again: it writes them from the recorded replies" in told
    assert summary["calls"]["cached"] == 0 < summary["calls"]["live"]
    assert ends(options) == [(True, 1)]
    again = await run(options)
    assert again["exit_code"] == 0, again["messages"]
    assert again["calls"]["cached"] == summary["calls"]["live"]
    assert ends(options) == [(True, 1), (True, 0)]


async def test_a_writer_that_breaks_at_the_very_end_is_told_in_a_line(options, monkeypatch):
    with monkeypatch.context() as patched:
        patched.setattr(local_runner, "EVERY_S", 1e9)
        patched.setattr(Store, "write", Mock(side_effect=KeyError("N_0_0")))
        summary = await run(options, "constant")
    assert summary["exit_code"] == 1
    assert summary["messages"][0].startswith("3 trials are not stored: the writer of results has")
    assert ends(options) == [(True, 1)]


@pytest.mark.parametrize(
    ("what", "fault"),
    [("sweep_facts", StoreLocked("a viewer holds it")), ("audit_sweep", StoreError("no view"))],
)
async def test_a_run_that_could_not_be_audited_has_ended(options, monkeypatch, fault, what):
    monkeypatch.setattr(sweep, what, Mock(side_effect=fault))
    summary = await run(options, "constant")
    assert (summary["exit_code"], summary["messages"]) == (1, [str(fault)])
    assert ends(options) == [(True, 1)]


async def test_a_run_whose_audit_breaks_has_ended(options, monkeypatch):
    monkeypatch.setattr(sweep, "audit_sweep", Mock(side_effect=KeyError("a fault of ours")))
    with pytest.raises(KeyError):
        await run(options, "constant")
    assert ends(options) == [(True, 0)]


async def test_the_audit_at_the_end_holds_up_nobody(options, monkeypatch):
    loop, audit, went_on = asyncio.get_running_loop(), sweep.audit_sweep, []

    def audited(*arguments, **more):
        async def go_on():
            went_on.append(True)

        asyncio.run_coroutine_threadsafe(go_on(), loop).result(HANGS_S)
        return audit(*arguments, **more)

    monkeypatch.setattr(sweep, "audit_sweep", audited)
    summary = await run(options, "constant")
    assert (summary["exit_code"], went_on) == (0, [True])


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
    standing, tasks = Progress.standing, []

    def broken(self, sweep_id):
        tasks.append(asyncio.current_task())
        if tasks[-1] is not tasks[0]:  # the run itself writes the first
            raise ZeroDivisionError("a fault of ours")
        return standing(self, sweep_id)

    monkeypatch.setattr("merge_runner.run.progress.PULSE_S", 0.0)
    monkeypatch.setattr("merge_runner.run.progress.PUBLISHED_EVERY", 1)
    monkeypatch.setattr(Progress, "standing", broken)
    with pytest.raises(ZeroDivisionError):
        await run(options)


STUDY = 'models = ["dear"]\nrepetitions = 1\nconditions = ["N_0_0"]\n'
PRICED = """
[dear]
provider = "emulator"
format = "openai-chat"
id = "scripted-driver"
max_output_tokens = 400
price = { input = 1.0, output = 2.0, source = "mine" }
"""


@pytest.mark.parametrize("cap", [5.0, 0.5])
async def test_the_cap_is_kept_as_the_user_gave_it_whoever_else_spends_under_it(
    options, tmp_path, cap, monkeypatch
):
    (tmp_path / "study.toml").write_text(STUDY)
    (tmp_path / "models.toml").write_text(PRICED)
    with closing(ResponseCache(options.cache)) as cache:
        assert Ledger(cache, "other").reserve("key", 1, 0.49, None, Asked("o3"))
    shown, standing = [], Progress.standing
    monkeypatch.setattr(
        Progress, "standing", lambda self, name: shown.append(standing(self, name)) or shown[-1]
    )
    plan = make_plan(str(tmp_path / "study.toml"))
    options = replace(options, max_cost_usd=cap, ledgers=(plan.ledger, "other"))
    summary = await run_sweep(plan, options, say=print)
    with duckdb.connect(str(options.db), read_only=True) as connection:
        [(config,)] = connection.execute("SELECT config FROM sweeps").fetchall()
    assert json.loads(config)["max_cost_usd"] == cap
    spent = summary["sweep_cost_usd"]
    assert dict(shown[-1].rows)["cost"].endswith(f", {0.49 + spent:.2f} of {cap:g} over all runs")
    if cap == 5.0:
        assert (summary["exit_code"], spent > 0) == (0, True)
    else:
        assert summary["exit_code"] == 3
        assert spent + 0.49 <= cap
        assert f"{0.49 + spent:.4f} of 0.5 USD are spent" in summary["messages"][0]
        assert "0.4900 by others under this cap" in summary["messages"][0]
