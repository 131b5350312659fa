"""Sweeps on a cluster, of which nothing is left behind."""

from __future__ import annotations

import asyncio

import psutil
import pytest

from tests.harness import environment
from tests.run.cluster.workers import SWEEP
from tests.zygote import Zygote


@pytest.fixture(scope="session")
def zygote(shared):
    """What the program is forked from; here it has imported Dask too."""
    with Zygote(shared / "zygote-dask", "merge_runner.run.cluster.coordinator") as forking:
        yield forking


@pytest.fixture
def started(zygote, tmp_path):
    """Starts a sweep on a cluster; what is left of it is killed in the end."""
    families: list[psutil.Process] = []

    async def start(*arguments, **env):
        process = await zygote.start(arguments, cwd=tmp_path, env=environment(**env))
        families.append(psutil.Process(process.pid))
        return process

    yield start
    for parent in families:
        if parent.is_running():
            for process in (*parent.children(recursive=True), parent):
                process.kill()


@pytest.fixture(scope="session")
def quiet_digest(zygote, emulator_url, tmp_path_factory):
    """Of SWEEP in one process, where nothing hinders it."""
    folder = tmp_path_factory.mktemp("quiet")
    env = environment(EMULATOR_BASE_URL=emulator_url)

    async def play() -> str:
        code, _, err = await zygote.run(SWEEP, cwd=folder, env=env)
        assert code == 0, err
        return (await zygote.run(("digest",), cwd=folder, env=env))[1]

    return asyncio.run(play())
