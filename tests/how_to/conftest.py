"""Runs commands where the code of a how-to is installed."""

from __future__ import annotations

import pytest

from tests.harness import Run


@pytest.fixture
def run(merge_runner, emulator_url, tmp_path):
    """Runs ``merge-runner`` in a process of its own, with these variables beside the usual ones."""

    async def started(*arguments: object, **changes: str) -> Run:
        process = await merge_runner.start(
            *arguments, **{"EMULATOR_BASE_URL": emulator_url, **changes}
        )
        out, err = await process.communicate()
        return Run(process.returncode, out.decode(), err.decode())

    return started
