"""The human commands as a user runs them."""

from __future__ import annotations

import subprocess

import pytest
from harness import PROGRAM, Run, environment


@pytest.fixture
def human(tmp_path):
    """Runs ``merge-runner human`` in an empty folder."""

    def run(*arguments: object) -> Run:
        done = subprocess.run(
            [PROGRAM, "human", *map(str, arguments)],
            cwd=tmp_path,
            env=environment(),
            capture_output=True,
            text=True,
            check=False,
            stdin=subprocess.DEVNULL,
        )
        return Run(done.returncode, done.stdout, done.stderr)

    return run
