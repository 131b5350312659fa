"""Runs commands where the code of a how-to is installed."""

from __future__ import annotations

import subprocess
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.harness import PROGRAM, Run, environment


@dataclass
class Study:
    """A folder with some trials; ``run`` takes the variables that a command gets beside the usual.

    Each command is a process of its own, with its own imports.
    """

    folder: Path
    emulator_url: str

    def run(self, *arguments: object, **changes: str) -> Run:
        done = subprocess.run(
            [PROGRAM, *map(str, arguments)],
            cwd=self.folder,
            env=environment(**{"EMULATOR_BASE_URL": self.emulator_url, **changes}),
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            check=False,
        )
        return Run(done.returncode, done.stdout, done.stderr)


@pytest.fixture(scope="module")
def study(emulator_url, tmp_path_factory):
    """One for all tests of a page."""
    return Study(tmp_path_factory.mktemp("study"), emulator_url)
