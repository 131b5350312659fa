"""Studies that several tests read."""

from __future__ import annotations

import os
import sys
from dataclasses import replace

import pytest

from merge_runner_analysis.commands import main
from merge_runner_analysis.data.study import Study
from merge_runner_analysis.tables import make_tables
from tests.support.harness import CONFIGURING
from tests.support.studies import ANSWERS, Said, write_study, yielding

CONFIG = {"models": {"o3": {"id": "o3", "aliases": ["o3-alias"]}}}
# What went wrong at one decision of the first trials of A1; who drove it did not change.
TROUBLE = (
    *(Said((reason,), reason) for reason in ANSWERS[1:]),
    *(Said(failure=reason) for reason in ("no_array", "wrong_length", "no_array")),
    Said(("rate_limit", "timeout", "ok")),
    Said(("unknown", "ok")),
    Said(("empty", "ok")),
)


def asked(drives, said=()):
    """The drives with their calls; the first ones had this said at their second decision."""
    troubles = dict(enumerate(said))
    return [
        replace(drive, said={1: troubles[i]} if i in troubles else {})
        for i, drive in enumerate(drives)
    ]


@pytest.fixture
def in_process(tmp_path, monkeypatch):
    """Runs ``merge-runner`` in an empty folder, in this process; returns the exit code.

    For tests of what it stored: starting a process takes longer than most of them.
    """
    monkeypatch.chdir(tmp_path)
    for name in [name for name in os.environ if name.endswith(CONFIGURING)]:
        monkeypatch.delenv(name)

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["merge-runner", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            main()
        return ended.value.code

    return run


@pytest.fixture(scope="session")
def study(tmp_path_factory):
    """o3 with two variants, and a driver that the paper does not have.

    A1 had trouble in some trials, A2 a fallback in each; the other driver lost a trial, and
    another model answered in its place.
    """
    weaker = [replace(d, right=tuple(0.8 * x for x in d.right)) for d in yielding("o3", "A2", 5)]
    drives = [
        *asked(yielding("o3", reps=10), [Said(served="o3-alias")]),
        *asked(yielding("o3", "A1", reps=5), TROUBLE),
        *asked(weaker, [Said(failure="out_of_range")] * len(weaker)),
        *asked(
            yielding("other", reps=4),
            [Said(("timeout", "timeout"), lost=True), *[Said(served="impostor")] * 3],
        ),
    ]
    path = tmp_path_factory.mktemp("study") / "study.duckdb"
    return Study(write_study(path, drives, config=CONFIG))


@pytest.fixture(scope="session")
def small(tmp_path_factory):
    """o3 alone, once in every condition, and no model was asked: what drawing and writing need."""
    path = tmp_path_factory.mktemp("small") / "small.duckdb"
    return Study(write_study(path, yielding("o3", reps=1)))


@pytest.fixture(scope="session")
def tables(study):
    """All tables of the study by name."""
    return {table.name: table for table in make_tables(study)}
