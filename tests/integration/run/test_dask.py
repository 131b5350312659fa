"""A sweep on a Dask cluster is the same sweep, whatever dies; what hinders it is told in one line.

Its workers share nothing, so that a lost one's trials are asked again as a whole.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import math
import os
import pickle
import shutil
import signal
import socket
import sys
import time
from collections import Counter
from contextlib import closing
from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import Mock

import psutil
import pytest
from aiohttp import web

from merge_runner.errors import SweepStopped, UsageError
from merge_runner.llm.cache import ResponseCache
from merge_runner.llm.ledger import Asked, Ledger
from merge_runner.run import cluster
from merge_runner.run.cluster import DaskTasks, Task, connected, fingerprint, play_task
from merge_runner.run.local_runner import FirstDecisions
from merge_runner.run.plan import Options, make_plan
from tests.support import program
from tests.support.gate import HANGS_S, Gate
from tests.support.harness import FAST, PROJECT, environment, watched
from tests.support.mock_server import FaultPlan
from tests.support.virtual_time import fullest_window, in_virtual_time, now_s

SMALL = ("sweep", "baseline", "--reps", 1, "--conditions", "L_4_0", "--json")
# Six trials of 19 calls each.
SIX = ("sweep", "baseline", "--reps", 2, "--conditions", "L_4_0,N_0_0,R_-4_8", "--json")
ON_TWO = (*SIX, "--in-flight", 4, "--dask", "local:2")
PAID = ("--model", "o3", "--yes", *FAST)


@pytest.fixture
def started(tmp_path):
    """Starts a sweep on a cluster; what is left of it is killed in the end."""
    families: list[psutil.Process] = []

    async def start(*arguments, **env):
        process = await program.start(arguments, cwd=tmp_path, env=environment(**env))
        families.append(psutil.Process(process.pid))
        return process

    yield start
    for parent in families:
        if parent.is_running():
            for process in (*parent.children(recursive=True), parent):
                process.kill()


def workers_of(pid: int) -> list[psutil.Process]:
    """The workers that a coordinator has started."""
    children = psutil.Process(pid).children()
    return [child for child in children if "spawn_main" in " ".join(child.cmdline())]


def held_from(gate: Gate, worker: psutil.Process) -> set[str]:
    """The slots that wait for an answer on a worker's connections."""
    ports = {c.laddr.port for c in worker.net_connections("tcp")}
    return {slot for slot, port in gate.held.items() if port in ports}


def repetition_of(slot: str) -> tuple[str, int]:
    told = json.loads(slot)
    return told["condition"], told["repetition"]


async def all_held(gate: Gate, trials: int) -> None:
    """Wait until so many trials are held, and nothing more is asked."""
    async with asyncio.timeout(HANGS_S):
        before = -1
        while len(set(map(repetition_of, gate.held))) < trials or before != len(gate.asked):
            before = len(gate.asked)
            await asyncio.sleep(0.5)


async def ended(process) -> tuple[int, str, str]:
    """How a sweep ended, of which no process may be left."""
    family = psutil.Process(process.pid).children(recursive=True)
    async with asyncio.timeout(HANGS_S):
        out, err = await process.communicate()
    _, alive = psutil.wait_procs(family, timeout=HANGS_S)
    assert not alive
    return process.returncode, out.decode(), err.decode()


async def test_tokens_of_a_workers_tasks_count_together_in_its_share(tmp_path):
    plan = make_plan("baseline", repetitions=1, conditions=["L_4_0"])
    options = Options(tmp_path / "db", tmp_path / "cache", tpm=10**6)
    worker = SimpleNamespace(extensions={}, periodic_callbacks={"profile": Mock()})
    used = []
    for specs in (plan.trial_specs(), [replace(spec, repetition=2) for spec in plan.trial_specs()]):
        task = Task(
            run="run", name="task", specs=specs, plan=plan, options=options,
            urls={}, earlier={},
            share=0.5, first=FirstDecisions(), recorded=((), ()), overruns=(),
        )  # fmt: skip
        played = await play_task(fingerprint(), pickle.dumps(task), task.name, dask_worker=worker)
        assert played.error is None
        (limiter,) = worker.extensions["run 0.5"].values()
        used.append(limiter._tokens_in_window)
    assert limiter._tpm == 5 * 10**5
    assert used[1] > used[0] > 0


STUDY = 'models = ["dear"]\nrepetitions = 1\nconditions = ["N_0_0", "L_4_0"]\n'
DEAR = """
[dear]
provider = "emulator"
format = "openai-chat"
id = "scripted-driver"
max_output_tokens = 4000
price = { input = 1.0, output = 2.0, source = "mine" }
"""


class Cluster:
    """Two workers within this process; the first one to ``ask`` so often dies of it.

    The first ``unread`` tasks never begin, and their workers live on.
    """

    def __init__(self, dies_at, unread=0):
        self.dies_at, self.unread = dies_at, unread
        self.workers = {f"tcp://{n}": self._worker() for n in (1, 2)}
        self.calls = Counter()
        self.running = {}
        self.sent = []

    @staticmethod
    def _worker():
        return SimpleNamespace(extensions={}, periodic_callbacks={"profile": Mock()})

    async def nthreads(self):
        return dict.fromkeys(self.workers, 1)

    async def run(self, function, *arguments, workers, on_error):
        (address,) = workers
        worker, lost = self.workers[address], OSError("lost")
        if function is play_task and self.unread:
            self.unread -= 1
            return {address: MemoryError("the task cannot be read")}
        work = asyncio.ensure_future(function(*arguments, dask_worker=worker))
        if function is play_task:
            self.running[address] = work
        elif function is cluster.exchange:
            self.calls[address] += 1
            if self.calls[address] == self.dies_at:
                self.dies_at = None
                work.cancel()
                self.running[address].cancel()
                await asyncio.wait([self.running[address]])
                self.workers[address] = self._worker()
        try:
            return {address: await work}
        except asyncio.CancelledError:
            return {address: lost}


@pytest.mark.parametrize("dies_at", [None, 6])
async def test_what_a_lost_worker_has_cost_is_spent_and_what_it_may_have_stays_reserved(
    tmp_path, monkeypatch, dies_at
):
    monkeypatch.delenv("EMULATOR_BASE_URL", raising=False)
    (tmp_path / "study.toml").write_text(STUDY)
    (tmp_path / "models.toml").write_text(DEAR)
    plan, cap = make_plan(str(tmp_path / "study.toml")), 50.0
    options = Options(tmp_path / "db", tmp_path / "cache", in_flight=2, max_cost_usd=cap)
    ended, client, attempts, reserve = {}, Cluster(dies_at), [], Ledger.reserve
    pay, lose, paid, lost_tasks = Ledger.pay, DaskTasks._lose, [], []

    def noted(ledger, name, number, usd, cap_usd, asked):
        if name.startswith("task "):
            attempts.append(usd)
        return reserve(ledger, name, number, usd, cap_usd, asked)

    async def room():
        pass

    def noted_cost(ledger, name, number, usd, driver):
        if name.startswith("task "):
            paid.append((name, usd))
        return pay(ledger, name, number, usd, driver)

    def noted_loss(tasks, task, *more):
        lost_tasks.append(task.name)
        lose(tasks, task, *more)

    monkeypatch.setattr(Ledger, "reserve", noted)
    monkeypatch.setattr(Ledger, "pay", noted_cost)
    monkeypatch.setattr(DaskTasks, "_lose", noted_loss)
    with closing(ResponseCache(options.cache)) as cache:
        ledger = Ledger(cache, plan.ledger)
        tasks = DaskTasks(client, plan, options, {}, cache, ledger, FirstDecisions())
        note = lambda spec, record: ended.__setitem__(spec.trial_id, record.status)  # noqa: E731
        await tasks.play(plan.trial_specs(), note, room)
        spending = ledger.read()
        ledger.release()
        assert ledger.read().committed_usd == spending.spent_usd, "what was spent is released"
        kept = sum(call.attempts[-1].cost_usd for call in cache.entries())
    assert len(ended) == 2
    assert set(ended.values()) <= {"finished", "collided"}
    lost_usd = [usd for name, usd in paid if name in lost_tasks]
    assert spending.spent_usd == pytest.approx(kept + sum(lost_usd))
    lost = spending.open_attempts
    assert (lost > 0, sum(lost_usd) > 0) == (dies_at is not None,) * 2
    assert spending.reserved_usd <= lost * max(attempts)
    assert lost <= 8, "not all that the task would have asked"
    assert len(attempts) == len(kept_keys(options.cache)) + len(lost_usd) + lost


@in_virtual_time
async def test_a_coordinator_that_says_nothing_ends_its_workers_tasks():
    with pytest.raises(SweepStopped, match="the coordinator has said nothing for 300 s"):
        await cluster.Desk().ask(1.0, Asked())
    assert now_s() == 300


async def test_a_task_that_never_begins_goes_to_others(tmp_path, monkeypatch):
    monkeypatch.delenv("EMULATOR_BASE_URL", raising=False)
    plan = make_plan("baseline", repetitions=1, conditions=["L_4_0", "N_0_0"])
    options = Options(tmp_path / "db", tmp_path / "cache", in_flight=2)
    ended = []

    async def room():
        pass

    with closing(ResponseCache(options.cache)) as cache:
        ledger = Ledger(cache, plan.ledger)
        client = Cluster(None, unread=1)
        tasks = DaskTasks(client, plan, options, {}, cache, ledger, FirstDecisions())
        async with asyncio.timeout(HANGS_S):
            await tasks.play(
                plan.trial_specs(), lambda spec, record: ended.append(spec.trial_id), room
            )
    assert len(set(ended)) == len(ended) == 2


def kept_keys(folder):
    with closing(ResponseCache(folder, read_only=True)) as cache:
        return [call.request.key for call in cache.entries()]


@pytest.mark.slow
async def test_three_workers_come_to_the_results_of_one_process(merge_runner):
    sweep = ("sweep", "baseline", "--reps", 2, "--json")
    async with watched(faults=FaultPlan(latency_s=0.02)) as server:
        env = {"EMULATOR_BASE_URL": f"{server.url}/v1"}
        run = await merge_runner(*sweep, "--in-flight", 12, "--dask", "local:3", **env)
        assert run.code == 0, run.err
        assert "on 3 workers" in run.err
        assert set(server.asked.values()) == {1}
        assert run.summary["calls"] == {"live": server.requests, "cached": 0}
        again = await merge_runner(*sweep, "--db", "again", **env)
        assert again.summary["calls"]["live"] == 0, "all is recorded"
        assert run.summary["calls"]["live"] == server.requests
    one = await merge_runner(*sweep, "--db", "one", "--cache", "new")
    assert one.code == 0, one.err
    digest = (await merge_runner("digest")).out
    assert digest == (await merge_runner("digest", "--db", "one")).out
    assert "22 trials" in digest


@pytest.mark.parametrize(
    ("where", "says"),
    [
        ("local:0", "valid: local:N"),
        ("local:x", "valid: local:N"),
        ("local", "valid: local:N"),
        ("", "valid: local:N"),
        ("http://host:1", "valid: local:N"),
        ("tcp://host", "valid: local:N"),
        ("none.json", "valid: local:N"),
    ],
)
async def test_a_word_that_names_no_cluster_is_refused(where, says):
    with pytest.raises(UsageError, match=says):
        async with connected(where):
            pass


@pytest.mark.slow
@pytest.mark.parametrize("error", [None, OSError("nobody there")])
async def test_the_host_s_logging_and_environment_are_as_before(monkeypatch, caplog, error):
    import distributed

    seen = []

    class Started:
        """In the place of a cluster and its client: sets what Dask sets."""

        scheduler_address = "tcp://1"

        def __init__(self, *arguments, **more):
            os.environ["PYTHONHASHSEED"] = os.environ["OMP_NUM_THREADS"] = "6640"

        def __await__(self):
            if error is not None:
                raise error
            return iter(())

        async def __aenter__(self):
            seen.append(os.environ["PYTHONSAFEPATH"])
            return self

        async def __aexit__(self, *_):
            logging.getLogger("distributed.client").error("a lost worker")

        async def close(self, timeout): ...
        async def wait_for_workers(self, number): ...

    monkeypatch.setattr(distributed, "LocalCluster", Started)
    monkeypatch.setattr(distributed, "Client", Started)
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    before, levels = {**os.environ}, level_of_loggers()
    with contextlib.suppress(UsageError):
        async with connected("local:1"):
            logging.getLogger("merge_runner").warning("ours")
    assert ({**os.environ}, level_of_loggers()) == (before, levels)
    assert (seen, logging.root.manager.disable) == (["1"], 0)
    logging.getLogger("merge_runner").warning("later")
    assert [each.message for each in caplog.records] == ["ours"] * (error is None) + ["later"]


@pytest.mark.long
async def test_a_cluster_of_this_machine_needs_no_port_that_another_program_may_hold(recwarn):
    with socket.socket() as held:
        with contextlib.suppress(OSError):  # somebody holds it already
            held.bind(("127.0.0.1", 8787))
            held.listen()
        async with connected("local:1"):
            pass
    assert [str(each.message) for each in recwarn] == []


def level_of_loggers():
    return {name: logging.getLogger(name).level for name in ("", "distributed", "tornado")}


async def test_a_word_that_names_no_cluster_is_told_in_one_line(merge_runner):
    run = await merge_runner(*SMALL, "--dask", "local:0")
    assert run.code == 2
    assert "valid: local:N" in run.err
    assert len(run.err.splitlines()) == 1


@pytest.mark.long
async def test_where_no_scheduler_listens_it_says_so_soon(merge_runner):
    async with asyncio.timeout(HANGS_S):
        run = await merge_runner(*SMALL, "--dask", "127.0.0.1:1")
    assert run.code == 2
    assert run.err.startswith("error: no Dask scheduler answers at 127.0.0.1:1 within 10 s")
    assert len(run.err.splitlines()) == 1


async def test_a_replay_needs_no_cluster(merge_runner):
    run = await merge_runner(*SMALL, "--replay", "--dask", "local:2")
    assert run.code == 2
    assert "a replay needs no cluster" in run.err


@pytest.mark.slow
async def test_without_the_extra_it_says_what_to_install(merge_runner, tmp_path, emulator_url):
    (tmp_path / "distributed.py").write_text("raise ModuleNotFoundError('no distributed')")
    process = await merge_runner.start(
        *SMALL, "--dask", "local:2", PYTHONPATH=str(tmp_path), EMULATOR_BASE_URL=emulator_url
    )
    _, err = await process.communicate()
    assert process.returncode == 2
    assert err.decode() == (
        "error: --dask needs the package distributed: pip install distributed\n"
    )


@pytest.mark.long
async def test_what_stops_a_sweep_stops_it_at_all_workers_in_one_line(merge_runner):
    async def middle(request, handler):
        if server.requests > 12:
            body = {"error": {"code": "insufficient_quota", "message": "nothing left"}}
            return web.json_response(body, status=429)
        return await handler(request)

    async with watched(middle) as server:
        env = {"OPENAI_API_KEY": "a-dummy-key", "OPENAI_BASE_URL": f"{server.url}/v1"}
        run = await merge_runner(
            *SMALL, "--conditions", "L_4_0,N_0_0", "--model", "o3", "--yes", "--dask", "local:2",
            **env,
        )  # fmt: skip
    assert run.code == 3
    assert "quota is exhausted" in run.err
    assert "Traceback" not in run.err


@pytest.fixture
async def scheduler(tmp_path):
    """A scheduler of its own; called, it adds a worker."""
    file = tmp_path / "scheduler.json"
    to = ("--scheduler-file", file, "--no-dashboard")
    processes = []

    async def start(*arguments, **changes):
        process = await asyncio.create_subprocess_exec(
            sys.executable, "-m", "distributed.cli.dask_worker", *arguments, *map(str, to),
            cwd=tmp_path, env=environment(**changes),
            stdout=asyncio.subprocess.DEVNULL, stderr=asyncio.subprocess.DEVNULL,
        )  # fmt: skip
        processes.append(psutil.Process(process.pid))

    start.process = await program.start(
        ("--port", "0", "--host", "127.0.0.1", *to),
        cwd=tmp_path, env=environment(), module="distributed.cli.dask_scheduler",
    )  # fmt: skip
    processes.append(psutil.Process(start.process.pid))
    while not file.exists():
        await asyncio.sleep(0.1)
    start.file = file
    yield start
    for parent in filter(psutil.Process.is_running, processes):
        for process in (*parent.children(recursive=True), parent):
            process.kill()


@pytest.mark.slow
async def test_workers_of_another_scheduler_play_with_their_own_keys(merge_runner, scheduler):
    async with watched() as server:
        env = {"OPENAI_API_KEY": "a-dummy-key", "OPENAI_BASE_URL": f"{server.url}/v1"}
        sweep = (*SMALL, "--model", "o3", "--yes", "--dask", scheduler.file)
        await scheduler("--no-nanny")
        run = await merge_runner(*sweep, **env)
        assert run.code == 2
        assert "o3 needs a key: set OPENAI_API_KEY" in run.err
        assert "(told by the Dask worker tcp://127.0.0.1:" in run.err
        assert server.requests == 0
    assert "Traceback" not in run.err


@pytest.mark.slow
async def test_a_worker_with_other_source_is_refused(merge_runner, scheduler, tmp_path):
    other = tmp_path / "other"
    shutil.copytree(PROJECT / "merge_runner", other / "merge_runner")
    with (other / "merge_runner/errors.py").open("a") as file:
        file.write("# another one\n")
    await scheduler("--no-nanny", PYTHONPATH=str(other))
    run = await merge_runner(*SMALL, "--dask", scheduler.file)
    assert run.code == 2
    assert "install the same one for all" in run.err
    assert "Traceback" not in run.err


@pytest.mark.long
async def test_a_scheduler_that_dies_ends_the_run_in_one_line(merge_runner, scheduler):
    async def middle(request, handler):
        if server.requests == 10:
            scheduler.process.kill()
        return await handler(request)

    await scheduler("--no-nanny")
    async with watched(middle, FaultPlan(latency_s=0.2)) as server:
        url = f"{server.url}/v1"
        run = await merge_runner(*SMALL, "--dask", scheduler.file, EMULATOR_BASE_URL=url)
        assert run.code == 1
        assert "error: the Dask scheduler is gone" in run.err
        assert "Traceback" not in run.err
        again = await merge_runner(*SMALL, EMULATOR_BASE_URL=url)
    assert again.code == 0, again.err


@pytest.mark.slow
async def test_a_worker_that_is_killed_costs_its_task_and_nothing_else(
    merge_runner, started, tmp_path
):
    gate = Gate(math.inf, tmp_path, decisions=3)  # of some ten: each trial begins, and none ends
    async with watched(gate.middle) as server:
        env = {"EMULATOR_BASE_URL": f"{server.url}/v1"}
        process = await started(*ON_TWO, **env)
        await all_held(gate, trials=4)
        victim = next(w for w in workers_of(process.pid) if held_from(gate, w))
        lost = set(map(repetition_of, held_from(gate, victim)))
        victim.kill()
        await process.said("is lost: its ")
        gate.open()
        code, out, err = await ended(process)
        assert code == 0, err
        summary = json.loads(out)
        again = set(map(repetition_of, gate.asked_again))
        assert lost <= again
        assert len(again) <= 3, "trials of the other worker are asked again, too"
        assert summary["trials"]["finished"] + summary["trials"]["collided"] == 6
        requests = server.requests
        plain = await merge_runner(*SIX, "--db", "plain", **env)
        assert (plain.code, server.requests) == (0, requests), "a reply is not kept"
    digests = {(await merge_runner("digest", *db)).out for db in ((), ("--db", "plain"))}
    assert len(digests) == 1


def test_the_share_of_a_task_stays_reserved_until_the_task_is_kept(tmp_path):
    with closing(ResponseCache(tmp_path)) as cache:
        ledger = Ledger(cache, "baseline")
        for name in ("lost", "kept"):
            asked = Asked("Dask worker tcp://1", "L_4_0", 5.0)
            assert ledger.reserve(name, 1, 5.0, None, asked)
        assert (ledger.read().reserved_usd, ledger.read().open_attempts) == (10, 2)
        unclear = ("a key", 1, 0.5, "o3", "N_0_0", 0.5, "2026-01-01T00:00:00Z", "read_timeout")
        ledger.settle_share("kept", [("o3", 1.5, 0.25, 2.0)], [unclear])
        spending = Ledger(cache, "baseline").read()
        assert (spending.spent_usd, spending.reserved_usd, spending.open_attempts) == (1.5, 5.5, 2)
        assert spending.overruns == {"o3": 2.0}
        assert [reason["driver"] for reason in ledger.reasons()] == ["Dask worker tcp://1", "o3"]


@pytest.mark.long
async def test_a_worker_that_stands_still_holds_up_its_own_trials_alone(
    merge_runner, started, tmp_path
):
    gate = Gate(math.inf, tmp_path, decisions=3)  # of some ten: each trial begins, and none ends
    async with watched(gate.middle) as server:
        env = {"EMULATOR_BASE_URL": f"{server.url}/v1"}
        process = await started(*SIX, "--in-flight", 3, "--dask", "local:3", **env)
        await all_held(gate, trials=3)
        still = next(w for w in workers_of(process.pid) if held_from(gate, w))
        still.suspend()
        gate.open()
        # Each worker has two trials of 19 calls, one at a time; those of the others are made.
        async with asyncio.timeout(HANGS_S):
            while len(gate.asked) < 76:
                await asyncio.sleep(0.1)
        still.resume()
        code, _, err = await ended(process)
    assert code == 0, err
    assert not gate.asked_again


@pytest.mark.long
async def test_a_coordinator_that_is_killed_takes_its_workers_along_and_goes_on(
    merge_runner, started, tmp_path
):
    many = (*SIX, "--reps", 4, "--in-flight", 2, "--dask", "local:2")  # tasks of four trials
    async with watched(faults=FaultPlan(latency_s=0.02)) as server, asyncio.timeout(HANGS_S):
        env = {"EMULATOR_BASE_URL": f"{server.url}/v1"}
        process = await started(*many, **env)
        while not (kept := kept_calls(tmp_path / "cache/responses")):
            await asyncio.sleep(0.1)
        family = psutil.Process(process.pid).children(recursive=True)
        process.kill()
        await process.wait()
        _, alive = psutil.wait_procs(family, timeout=HANGS_S)
        assert not alive
        run = await merge_runner(*many, **env)
        assert run.code == 0, run.err
        # Their trials may be stored, too, before the kill comes.
        assert run.summary["calls"]["cached"] >= kept or run.summary["trials"]["stored_before"]
        assert server.asked.total() - len(server.asked) < len(server.asked) - kept
    assert run.summary["trials"]["finished"] + run.summary["trials"]["collided"] == 12


def kept_calls(folder) -> int:
    """How many calls a cache holds, which may not be there yet."""
    if not (folder / "cache.db").exists():
        return 0
    with closing(ResponseCache(folder, read_only=True)) as cache:
        return sum(1 for _ in cache.entries())


@pytest.mark.long
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
async def test_ctrl_c_saves_what_the_workers_have_asked(merge_runner, started, number, tmp_path):
    gate = Gate(math.inf, tmp_path, decisions=3)  # of some ten: each trial begins, and none ends
    async with watched(gate.middle) as server:
        env = {"EMULATOR_BASE_URL": f"{server.url}/v1"}
        process = await started(*ON_TWO, **env)
        await all_held(gate, trials=4)
        process.send_signal(number)
        for worker in workers_of(process.pid):
            worker.send_signal(number)  # as a terminal does
        await process.said("are saved first")
        await asyncio.sleep(1)
        gate.open()
        code, _, err = await ended(process)
        assert code == 130, err
        assert "the replies of 2 tasks are saved first" in err
        assert "Traceback" not in err
        run = await merge_runner(*ON_TWO, **env)
    assert run.code == 0, run.err
    assert not gate.asked_again
    assert len(set(gate.asked)) == 114


@pytest.mark.long
async def test_requests_a_minute_hold_over_all_workers(merge_runner):
    times = []

    async def middle(request, handler):
        times.append(time.monotonic())
        return await handler(request)

    async with watched(middle) as server:
        run = await merge_runner(
            *SIX, "--in-flight", 3, "--dask", "local:3", "--rpm", 600,
            EMULATOR_BASE_URL=f"{server.url}/v1",
        )  # fmt: skip
    assert run.code == 0, run.err
    # Half a second's worth goes at a time at each worker, and may come a little late; one limiter
    # of 600 for each would let three times as many through.
    assert fullest_window(times, [1] * len(times), length=1.0) <= 1.5 * 10 + 3


@pytest.mark.long
async def test_the_cost_cap_holds_over_all_workers_and_a_higher_one_goes_on(merge_runner, tmp_path):
    # Trials end after 12 s at the latest, so that none can cost more than 3.4 USD.
    shutil.copytree(PROJECT / "experiments", tmp_path / "experiments")
    short = "[repetitions]\nbaseline = 10\n[scenario]\ntimeout_s = 12\n"
    (tmp_path / "experiments/baseline.toml").write_text(short)
    cap, usd = 3.7, 0.0

    async def middle(request, handler):
        nonlocal usd
        reply = await handler(request)
        usage = json.loads(reply.body)["usage"]
        usd += (2 * usage["prompt_tokens"] + 8 * usage["completion_tokens"]) / 1e6
        return reply

    async with watched(middle) as server:
        env = {"OPENAI_API_KEY": "a-dummy-key", "OPENAI_BASE_URL": f"{server.url}/v1"}
        sweep = (*SIX, "--reps", 18, *PAID)
        run = await merge_runner(*sweep, "--dask", "local:3", "--max-cost", cap, **env)
        assert run.code == 3, run.err
        assert 0 < usd <= cap
        assert run.summary["cost_usd"] == pytest.approx(usd)
        assert run.summary["sweep_cost_usd"] == pytest.approx(usd)
        assert run.summary["trials"]["suspended"] > 0
        done = await merge_runner(*sweep, "--max-cost", 50, **env)
        assert done.code == 0, done.err
        calls = await merge_runner("sql", "select count(*) from calls", "--format", "csv")
        assert int(calls.out.split()[1]) == server.requests, "nothing was paid for twice"
    assert done.summary["sweep_cost_usd"] == pytest.approx(usd)
    assert done.summary["set_aside_usd"] == 0


@pytest.mark.long
async def test_after_a_coordinator_is_killed_only_what_was_sent_stays_reserved(
    merge_runner, started
):
    hold = asyncio.Event()

    async def middle(request, handler):
        if server.requests > 12:
            await hold.wait()
        return await handler(request)

    async with watched(middle) as server, asyncio.timeout(HANGS_S):
        env = {"OPENAI_API_KEY": "a-dummy-key", "OPENAI_BASE_URL": f"{server.url}/v1"}
        sweep = (*SIX, *PAID, "--max-cost", 50)
        process = await started(*sweep, "--in-flight", 4, "--dask", "local:2", **env)
        while server.requests < 16:
            await asyncio.sleep(0.1)
        family = psutil.Process(process.pid).children(recursive=True)
        process.kill()
        await process.wait()
        _, alive = psutil.wait_procs(family, timeout=HANGS_S)
        assert not alive
        (told,) = json.loads((await merge_runner("ledger", "--json")).out)
        assert 4 <= told["open_attempts"] <= server.requests
        # At most 16,000 tokens of output, at 8 USD a million, and a prompt of some thousand.
        assert 0 < told["reserved_usd"] < 0.15 * told["open_attempts"]
        hold.set()
        run = await merge_runner(*sweep, **env)
    assert run.code == 0, run.err
    assert run.summary["set_aside_usd"] == pytest.approx(told["reserved_usd"])
