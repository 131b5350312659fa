"""Fixtures for the whole program."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest
from harness import PROGRAM, Run, environment
from hypothesis import settings

# The gate depends on neither luck nor load.
settings.register_profile("gate", derandomize=True, deadline=None)
settings.load_profile("gate")


@pytest.fixture
def merge_runner(tmp_path):
    """Runs ``merge-runner`` in an empty folder."""

    async def run(*arguments: object, cwd: Path = tmp_path, **changes: str) -> Run:
        process = await start(*arguments, cwd=cwd, **changes)
        out, err = await process.communicate()
        return Run(process.returncode, out.decode(), err.decode())

    async def start(*arguments: object, cwd: Path = tmp_path, **changes: str):
        return await asyncio.create_subprocess_exec(
            PROGRAM,
            *map(str, arguments),
            cwd=cwd,
            env=environment(**changes),
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
        )

    run.start = start
    return run
