"""The path of one call, as docs/design.md draws it, and in how few files it lies."""

from __future__ import annotations

import json
import re
import subprocess
import sys

import pytest

from merge_runner.results.store import query
from tests.support.harness import FAST, PROJECT, environment

STUDY = ("baseline", "--reps", "1", "--db", "results.duckdb")
# The emulator's and the audit's files are no part of the path; those of the store are entered for
# the rows of each call.
OFF = ("emulator/", "audit/")
MOST_FILES = {"live": 20, "replayed": 16}


@pytest.fixture(scope="module")
def drawn():
    """The files in the drawing: of a call that is made, and of one that is replayed."""
    page = (PROJECT / "docs/design.md").read_text()
    (drawing,) = re.findall(r"## The path of a call\n.*?```text\n(.*?)```", page, re.DOTALL)
    live = set(re.findall(r"[a-z_/]+\.py", drawing))
    only_live = [line for line in drawing.splitlines() if line.startswith("  ")]
    return {"live": live, "replayed": live - set(re.findall(r"[a-z_/]+\.py", str(only_live)))}


@pytest.mark.long
@pytest.mark.parametrize(
    ("mode", "command"),
    [
        ("live", ("sweep", *STUDY, "--model", "emulator", "--yes", *map(str, FAST))),
        ("replayed", ("replay", *STUDY)),
    ],
)
def test_a_call_takes_the_path_that_is_drawn_and_few_files_more(
    mode, command, drawn, tmp_path, emulator_url
):
    counted = tmp_path / "counted.json"
    subprocess.run(
        [sys.executable, "-m", "tests.support.traced", counted, *command],
        cwd=tmp_path,
        env=environment(EMULATOR_BASE_URL=emulator_url, PYTHONPATH=str(PROJECT)),
        check=True,
        capture_output=True,
        timeout=100,
    )
    calls = json.loads(counted.read_text())
    _, ((number,),) = query(tmp_path / "results.duckdb", "SELECT count(*) FROM calls")
    entered = {file for file, most in calls.items() if most >= number and not file.startswith(OFF)}
    assert drawn[mode] <= entered
    assert len(entered) <= MOST_FILES[mode], sorted(entered)
