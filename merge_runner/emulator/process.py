"""The emulator as a process of its own, which ends with the one that started it."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager

from merge_runner.errors import UsageError

START_TIMEOUT_S = 30.0


@asynccontextmanager
async def emulator_process(options: Sequence[str] = ()) -> AsyncIterator[str]:
    """Run ``merge-runner emulate`` on a free loopback port; yields its base URL.

    The child ends when its standard input closes, so that it never outlives a killed parent. It
    has a session of its own, for Ctrl-C to reach the sweep alone.
    """
    process = await asyncio.create_subprocess_exec(
        sys.executable,
        "-P",  # no file of the working folder is taken for one of our modules
        "-m",
        "merge_runner",
        "emulate",
        "--port",
        "0",
        "--until-stdin-closes",
        *options,
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
        start_new_session=True,
    )
    assert process.stdin is not None
    assert process.stdout is not None
    try:
        async with asyncio.timeout(START_TIMEOUT_S):
            line = (await process.stdout.readline()).decode().strip()
        if not line.startswith("http://"):
            raise UsageError("the emulator did not start; its message stands above")
        yield line
    finally:
        process.stdin.close()
        await process.wait()
