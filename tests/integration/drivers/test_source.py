"""An edited driver is another driver, and what no file holds is none."""

import subprocess
import sys

import pytest

from tests.support.harness import PROJECT, environment

IN_A_CELL = """
from merge_runner.drivers.registry import PROGRAMS, Program
from merge_runner.run.plan import make_plan

class Mine:
    async def decide(self, observation, number):
        return self.seat.held(0.0)

PROGRAMS.register("mine", Program(Mine, "keeps its speed"))
list(make_plan("baseline", "mine").trial_specs())
"""


@pytest.mark.parametrize("how", [("-c", IN_A_CELL), ("mine.py",), ("-m", "mine")])
def test_a_driver_of_no_file_that_can_be_imported_is_refused_in_one_line(tmp_path, how):
    (tmp_path / "mine.py").write_text(IN_A_CELL)
    command, env = [sys.executable, *how], environment(PYTHONPATH=str(PROJECT))
    done = subprocess.run(
        command, cwd=tmp_path, env=env, capture_output=True, text=True, check=False
    )
    said = done.stderr.splitlines()[-1]
    assert said.startswith("merge_runner.errors.UsageError: the source of Mine cannot be found")
    assert said.endswith("put it into a file of its own, such as my_driver.py, and import it")
