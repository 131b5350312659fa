"""What an installed package registers is as good as built in, or told in one line."""

from __future__ import annotations

import subprocess
import sys

from tests.support.harness import PROGRAM, environment, plugin

LOOKS = """
from merge_runner.drivers.registry import PROGRAMS
from merge_runner.errors import UsageError
for look in (lambda: PROGRAMS["mine"], lambda: list(PROGRAMS), lambda: len(PROGRAMS)) * 2:
    try:
        look()
        print("found")
    except UsageError as exc:
        print(exc)
"""
REGISTERS = """
from merge_runner.drivers.registry import PROGRAMS
PROGRAMS.register("mine", PROGRAMS["constant"])
"""


def with_plugin(folder, source, *command):
    env = environment(**plugin(folder, source))
    return subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True, check=False)


def test_a_plug_in_that_fails_is_told_in_one_line_at_each_look(tmp_path):
    said = "the plug-in dummies = 'dummies' fails: No module named 'no_such_module'\n"
    looks = with_plugin(tmp_path / "a", "import no_such_module", sys.executable, "-c", LOOKS)
    assert looks.stdout == 6 * said
    run = with_plugin(tmp_path / "b", "import no_such_module", PROGRAM, "models")
    assert (run.returncode, run.stdout, run.stderr) == (2, "", f"error: {said}")


def test_a_plug_in_may_look_at_what_is_there_and_register(tmp_path):
    looks = with_plugin(tmp_path, REGISTERS, sys.executable, "-c", LOOKS)
    assert (looks.stdout, looks.stderr) == (6 * "found\n", "")
