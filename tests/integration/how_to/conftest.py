"""Runs commands where the code of a how-to is installed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.support.harness import Run


@dataclass
class Study:
    """A folder with some trials; ``run`` takes variables that a command gets beside the usual."""

    folder: Path
    prepare: Callable[..., Run]

    def run(self, *arguments: object, **changes: str) -> Run:
        return self.prepare(self.folder, *arguments, **changes)


@pytest.fixture(scope="module")
def study(prepare, tmp_path_factory):
    """One for all tests of a page."""
    return Study(tmp_path_factory.mktemp("study"), prepare)
