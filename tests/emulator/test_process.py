from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import sys

import aiohttp
import pytest

from merge_runner.emulator.process import emulator_process
from merge_runner.errors import UsageError

PATIENCE_S = 30
# A program that has an emulator, survives Ctrl-C and says so.
PARENT = """
import asyncio, signal
from merge_runner.emulator.process import emulator_process

async def main():
    loop = asyncio.get_running_loop()
    loop.add_signal_handler(signal.SIGINT, lambda: print("interrupted", flush=True))
    async with emulator_process() as url:
        print(url, flush=True)
        await asyncio.Event().wait()

asyncio.run(main())
"""


async def models_at(url):
    async with aiohttp.ClientSession() as session, session.get(f"{url}/v1/models") as reply:
        return (await reply.json())["data"]


async def answers(url):
    try:
        return bool(await models_at(url))
    except aiohttp.ClientConnectionError:
        return False


async def line_of(process):
    async with asyncio.timeout(PATIENCE_S):
        return (await process.stdout.readline()).decode().strip()


@contextlib.asynccontextmanager
async def parent():
    """The program in a process group of its own, with its emulator's URL."""
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-c", PARENT, stdout=asyncio.subprocess.PIPE, start_new_session=True
    )
    try:
        yield process, await line_of(process)
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.kill()
        await process.wait()


async def test_the_child_answers_and_ends_with_the_context():
    async with asyncio.timeout(PATIENCE_S):
        async with emulator_process() as url:
            assert url.startswith("http://127.0.0.1:")
            assert [model["id"] for model in await models_at(url)] == ["scripted-driver"]
        assert not await answers(url)


async def test_the_child_ends_when_the_context_fails():
    async with asyncio.timeout(PATIENCE_S):
        with pytest.raises(ValueError, match="a failed sweep"):
            async with emulator_process() as url:
                raise ValueError("a failed sweep")
        assert not await answers(url)


async def test_the_options_reach_the_child(tmp_path):
    faults = tmp_path / "faults.toml"
    faults.write_text("[rates]\noverloaded = 1.0\n")
    async with (
        asyncio.timeout(PATIENCE_S),
        emulator_process(["--faults", str(faults)]) as url,
        aiohttp.ClientSession() as session,
        session.post(f"{url}/v1/chat/completions", json={}) as reply,
    ):
        assert reply.status == 503


async def test_a_child_that_cannot_start_is_a_usage_error(capfd):
    async with asyncio.timeout(PATIENCE_S):
        with pytest.raises(UsageError, match="did not start"):
            async with emulator_process(["--fault-rate", "2"]):
                pytest.fail("entered without an emulator")
    # The message that the error points to.
    assert "no probability" in capfd.readouterr().err


async def test_the_child_ends_when_its_parent_is_killed():
    async with parent() as (process, url):
        assert await answers(url)
        os.kill(process.pid, signal.SIGKILL)
        await process.wait()
        async with asyncio.timeout(PATIENCE_S):
            while await answers(url):
                await asyncio.sleep(0.02)


async def test_ctrl_c_does_not_reach_the_child():
    async with parent() as (process, url):
        os.killpg(process.pid, signal.SIGINT)
        assert await line_of(process) == "interrupted"
        # A child that was interrupted as well would take a moment to end.
        for _ in range(10):
            await asyncio.sleep(0.05)
            assert await answers(url)
