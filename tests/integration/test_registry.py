"""What an installed package registers is as good as built in, or told in one line."""

import subprocess
import sys

from merge_runner.results.store import query
from tests.support import program
from tests.support.harness import PROGRAM, PROJECT, environment, plugin

IMPULSIVE = (PROJECT / "tests/cases/parts/driver.py").read_text()
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


def test_an_import_that_fails_while_a_driver_decides_is_told_in_one_line(tmp_path):
    (tmp_path / "mine.py").write_text(
        "from merge_runner.plugin import PROGRAMS, Program\n"
        "class Importing:\n"
        "    def __init__(self, context):\n"
        "        self.context = context\n"
        "    async def decide(self, observation, number):\n"
        "        import no_such_module\n"
        'PROGRAMS.register("importing", Program(Importing, "imports"))\n'
    )
    (tmp_path / "mine.toml").write_text(
        'models = ["importing"]\nconditions = ["N_0_0"]\nrepetitions = 1\n'
        '[plugins]\nfiles = ["mine.py"]\n'
    )
    sweep = ("sweep", "mine.toml", "--trust", "--quiet")
    run = program.run(sweep, cwd=tmp_path, env=environment())
    told = "error: the left driver fails in mine.py, line 6: ModuleNotFoundError: No module named "
    assert (run.code, run.err) == (2, f"{told}'no_such_module'\n")
    ended = query(tmp_path / "results/merge.duckdb", "SELECT ended_at IS NOT NULL FROM sweeps")
    assert ended[1] == [(True,)]


def test_a_plug_in_may_look_at_what_is_there_and_register(tmp_path):
    looks = with_plugin(tmp_path, REGISTERS, sys.executable, "-c", LOOKS)
    assert (looks.stdout, looks.stderr) == (6 * "found\n", "")


def test_where_its_package_is_not_installed_a_driver_is_named_and_the_rest_is_checked(tmp_path):
    (tmp_path / "fine.toml").write_text(
        'conditions = ["N_0_0"]\nrepetitions = 1\n[scenario]\nstep_s = 0.05\nplan_step_s = 0.2\n'
    )
    sweep = ("sweep", "fine.toml", "--model", "constant+impulsive")
    env = environment(**plugin(tmp_path / "installed", IMPULSIVE))
    assert program.run(sweep, cwd=tmp_path, env=env).code == 0
    audit = program.run(("audit",), cwd=tmp_path, env=environment())
    assert audit.code == 0
    assert "not replayed: 1 trials, since unknown driver 'impulsive'; valid: " in audit.out
    assert "(install the package that registers it, or name the study: --study FILE)" in audit.out
    asked = program.run(sweep, cwd=tmp_path, env=environment())
    assert asked.code == 2
    assert "unknown model 'impulsive'; valid: " in asked.err
