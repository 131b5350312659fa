"""An edited driver is another driver, and what no file holds is none."""

import shutil
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


async def test_an_edited_program_is_played_anew(merge_runner, tmp_path):
    part = ("sweep", "baseline", "--model", "constant", "--reps", 1, "--conditions", "N_0_0")
    for stored in (0, 1):
        run = await merge_runner(*part, "--json")
        assert run.summary["trials"]["stored_before"] == stored
    edited = tmp_path / "edited"
    for folder in ("merge_runner", "experiments"):
        shutil.copytree(PROJECT / folder, edited / folder)
    driver = edited / "merge_runner/drivers/constant.py"
    driver.write_text(driver.read_text().replace("held(0.0)", "held(0.1)"))
    run = await merge_runner.start(*part, "--json", PYTHONPATH=str(edited))
    out, _ = await run.communicate()
    assert b'"stored_before": 0' in out
