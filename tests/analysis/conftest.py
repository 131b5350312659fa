"""Studies that several tests read."""

from __future__ import annotations

from dataclasses import replace

import pytest
from studies import write_study, yielding

from analysis.study import Study


@pytest.fixture(scope="session")
def study(tmp_path_factory):
    """o3 with two variants, and a driver that the paper does not have."""
    drives = [
        *yielding("o3", reps=10),
        *yielding("o3", "A1", reps=5),
        *(replace(d, right=tuple(0.8 * x for x in d.right)) for d in yielding("o3", "A2", reps=5)),
        *yielding("other", reps=4),
    ]
    return Study(write_study(tmp_path_factory.mktemp("study") / "study.duckdb", drives))
