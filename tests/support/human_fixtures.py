"""The human commands as a user runs them."""

from __future__ import annotations

import pytest

from tests.support import program
from tests.support.harness import Run, environment


@pytest.fixture
def human(tmp_path):
    """Runs ``merge-runner human`` in an empty folder."""

    def run(*arguments: object) -> Run:
        return program.run(("human", *arguments), cwd=tmp_path, env=environment())

    return run
