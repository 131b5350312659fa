"""Sweeps on a cluster, of which nothing is left behind."""

from __future__ import annotations

import psutil
import pytest


@pytest.fixture
def started(merge_runner):
    """Starts a sweep on a cluster; what is left of it is killed in the end."""
    families: list[psutil.Process] = []

    async def start(*arguments, **env):
        process = await merge_runner.start(*arguments, **env)
        families.append(psutil.Process(process.pid))
        return process

    yield start
    for parent in families:
        if parent.is_running():
            for process in (*parent.children(recursive=True), parent):
                process.kill()
