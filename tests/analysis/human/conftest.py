"""The human commands as a user runs them."""

from __future__ import annotations

import pytest

from tests.harness import Run, environment


@pytest.fixture
def human(tmp_path, zygote):
    """Runs ``merge-runner human`` in an empty folder."""

    def run(*arguments: object) -> Run:
        return Run(*zygote.run_blocking(("human", *arguments), cwd=tmp_path, env=environment()))

    return run
