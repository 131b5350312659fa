"""A sweep on a cluster is the same sweep; what hinders it is told in one line."""

from __future__ import annotations

import asyncio
import shutil
import sys
from concurrent.futures import ThreadPoolExecutor

import psutil
import pytest
from aiohttp import web

from merge_runner.emulator.faults import FaultPlan
from merge_runner.errors import UsageError
from merge_runner.registry import Catalogue, in_use, use
from merge_runner.run.cluster.connect import connected
from merge_runner.run.cluster.worker import use_study
from merge_runner.study.file import read_study
from tests.gate import HANGS_S
from tests.harness import PROJECT, environment, watched

SMALL = ("sweep", "baseline", "--reps", 1, "--conditions", "L_4_0", "--json")


def test_threads_of_a_worker_play_by_one_catalogue():
    study = read_study("baseline")
    use(Catalogue())
    with ThreadPoolExecutor() as threads:
        used = list(threads.map(lambda _: (use_study(study), in_use())[1], range(8)))
    assert len({id(catalogue) for catalogue in used}) == 1
    assert used[0].text == study.text


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
        ("none.json", "there is no scheduler file none.json"),
    ],
)
async def test_a_word_that_names_no_cluster_is_refused(where, says):
    with pytest.raises(UsageError, match=says):
        async with connected(where):
            pass


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
async def scheduler(tmp_path, zygote):
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

    start.process = await zygote.start(
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
        assert "(told by the worker tcp://127.0.0.1:" in run.err
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
        assert set(server.asked.values()) == {1}, "what was in flight is saved first"
