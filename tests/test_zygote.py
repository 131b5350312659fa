"""A forked program is the program: it ends as one that was started does, and leaves the same."""

from __future__ import annotations

import asyncio
import re
import signal

import pytest

from tests.harness import watched

SWEEP = ("sweep", "baseline", "--reps", 1, "--conditions", "R_-4_8", "--json")


def left(folder):
    """The files by name, and whether each has content."""
    return {
        str(path.relative_to(folder)): path.stat().st_size > 0
        for path in folder.rglob("*")
        if path.is_file()
    }


@pytest.mark.parametrize(
    "command", [SWEEP, ("digest", "--db", "nowhere")], ids=["a sweep", "wrong usage"]
)
async def test_a_forked_program_ends_and_leaves_what_a_started_one_does(
    merge_runner, emulator_url, tmp_path, command
):
    found = []
    for begin in (merge_runner.fork, merge_runner.start):
        folder = tmp_path / begin.__name__
        folder.mkdir()
        process = await begin(*command, cwd=folder, EMULATOR_BASE_URL=emulator_url)
        out, err = await process.communicate()
        words = [re.sub(rb"\d+", b"0", text) for text in (out, err)]
        found.append((process.returncode, len(words[0]) > 0, words[1][:20], left(folder)))
    assert found[0] == found[1]


async def test_a_forked_program_is_told_by_its_signal(merge_runner):
    async def middle(request, handler):
        arrived.set()
        await asyncio.Event().wait()

    arrived = asyncio.Event()
    async with watched(middle) as server:
        process = await merge_runner.fork(*SWEEP, EMULATOR_BASE_URL=f"{server.url}/v1")
        await arrived.wait()
        assert process.returncode is None
        process.kill()
        assert await process.wait() == process.returncode == -signal.SIGKILL
