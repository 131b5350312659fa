"""An edited driver is another driver: no row that it stored before is taken for its own."""

import importlib
import os
import shutil
import subprocess
import sys
from importlib.machinery import SourceFileLoader
from pathlib import Path

import pytest

from merge_runner.drivers.registry import PROGRAMS
from merge_runner.errors import UsageError
from merge_runner.run.plan import make_plan
from merge_runner.source import code_of, source_digest
from tests.support.harness import PROJECT, environment

PACKAGE = {
    "__init__.py": "",
    "driver.py": """
import json

from .params import GAP_M

class Mine:
    def decide(self):
        from plugged import late
        return GAP_M, late.LATER, json
""",
    "params.py": "GAP_M = 4.0\n",
    "late.py": "LATER = 1\n",
    "unused.py": "nothing = 0\n",
}

SPEC_HASHES = PROJECT / "tests/golden/reference-spec-hashes.csv"
PYENV = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv"))
PYTHONS = [Path(sys.executable), *sorted(PYENV.glob("versions/3.1[1-9].*/bin/python"))]
# The packages that drivers need are not in every Python: none of ours is imported for its path.
HASHED = """
import sys
from types import ModuleType
drivers = sys.modules["merge_runner.drivers"] = ModuleType("merge_runner.drivers")
drivers.__path__ = [sys.argv[1]]
from merge_runner.source import source_digest
for module in sys.argv[2:]:
    print(source_digest(type("Driver", (), {"__module__": module})))
"""


@pytest.fixture
def digest(tmp_path, monkeypatch):
    """The hash of the driver of a package of somebody's, with some files changed."""
    monkeypatch.syspath_prepend(tmp_path)

    def write(**changed):
        shutil.rmtree(tmp_path / "plugged", ignore_errors=True)
        (tmp_path / "plugged").mkdir()
        for name, text in (
            PACKAGE | {f"{name}.py": text for name, text in changed.items()}
        ).items():
            (tmp_path / "plugged" / name).write_text(text)
        for name in [name for name in sys.modules if name.partition(".")[0] == "plugged"]:
            del sys.modules[name]
        importlib.invalidate_caches()
        return source_digest(importlib.import_module("plugged.driver").Mine)

    return write


def test_a_change_of_a_driver_or_of_what_it_rests_on_is_another_driver(digest):
    same = {digest(), digest(), digest(unused="nothing = 1\n")}
    assert len(same) == 1
    changes = {
        digest(driver=PACKAGE["driver.py"] + "REMARK = '# no comment'\n"),
        digest(params="GAP_M = 5.0\n"),
        digest(late="LATER = 2\n"),
        digest(__init__="import plugged.unused\n"),
    }
    assert len(changes) == 4
    assert not same & changes


def test_another_wording_of_comments_and_docstrings_is_no_other_driver(digest):
    named = "class Mine:  # of gaps\n    'A driver.'\n"
    worded = '"""One."""\n# Two\n' + PACKAGE["driver.py"].replace("class Mine:\n", named)
    assert digest() == digest(driver=worded, params="\n\nGAP_M = 4.0  # m\n")


@pytest.mark.parametrize(
    "source",
    [
        'X = "# no comment"\n',
        'X = """a\n\n# no comment\n"""\n',
        "def f(): 'no line of its own'; g()\n",
        "X = [\n    'a text'\n]\n",
        "f'{no} docstring'\n",
    ],
)
def test_code_stays_as_it_is(source):
    assert "\n".join(code_of(source)) == source


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_what_is_cut_out_are_comments_docstrings_and_blank_lines(end):
    source = [
        *('"""Of the', 'module."""', "", "# why", "X = 1  # m", '"""What X is."""'),
        *("class Ä:", '    "Ä."', "", "    def f(self):", "        '''Does it.'''  # yes"),
        *("        return (", "            # inside", "", "            1", "        )", ""),
    ]
    code = (
        "X = 1",
        "class Ä:",
        "    def f(self):",
        "        return (",
        "            1",
        "        )",
    )
    assert code_of(end.join(source)) == (*code, "")


def test_a_driver_without_its_source_is_refused(digest, monkeypatch):
    digest()
    monkeypatch.setattr(SourceFileLoader, "get_source", lambda self, name: None)
    mine = type("Mine", (), {"__module__": "plugged.driver"})
    with pytest.raises(UsageError, match=r"the source of plugged\.driver is not there"):
        source_digest(mine)


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
    done = subprocess.run(
        [sys.executable, *how],
        cwd=tmp_path,
        env=environment(PYTHONPATH=str(PROJECT)),
        capture_output=True,
        text=True,
        check=False,
    )
    said = done.stderr.splitlines()[-1]
    assert said.startswith("merge_runner.errors.UsageError: the source of Mine cannot be found")
    assert said.endswith("put it into a file of its own, such as my_driver.py, and import it")


def test_programs_have_a_source_of_their_own_and_share_what_both_rest_on(monkeypatch):
    before = {name: source_digest(program.driver) for name, program in PROGRAMS.items()}
    assert len(set(before.values())) == len(PROGRAMS)
    read = SourceFileLoader.get_source

    def edited(self, name):
        return read(self, name) + "EDITED = 1\n" * (name == "merge_runner.drivers.base")

    monkeypatch.setattr(SourceFileLoader, "get_source", edited)
    source_digest.cache_clear()
    after = {name: source_digest(program.driver) for name, program in PROGRAMS.items()}
    source_digest.cache_clear()
    assert all(before[name] != after[name] for name in PROGRAMS)


def test_the_spec_hashes_of_the_reference_drivers_are_the_committed_ones():
    """They change with the code of a driver alone: say in the commit why it does."""
    specs = make_plan("reference", repetitions=1).trial_specs()
    found = sorted({f"{one.model_left},{one.spec_hash}" for one in specs})
    assert found == SPEC_HASHES.read_text().splitlines()[1:]


@pytest.mark.long
@pytest.mark.parametrize("python", PYTHONS, ids=lambda python: python.parents[1].name)
def test_the_sources_have_the_same_hash_on_every_python(python):
    modules = {name: program.driver.__module__ for name, program in PROGRAMS.items()}
    command = [python, "-c", HASHED, PROJECT / "merge_runner/drivers", *modules.values()]
    done = subprocess.run(command, cwd=PROJECT, capture_output=True, text=True, check=True)
    assert dict(zip(modules, done.stdout.split(), strict=True)) == {
        name: source_digest(program.driver) for name, program in PROGRAMS.items()
    }


@pytest.mark.parametrize("model", ["constant", "projected-order", "emulator+constant"])
def test_the_trials_of_an_edited_program_are_other_trials(monkeypatch, model):
    plan = make_plan("baseline", model)
    before = {spec.spec_hash for spec in plan.trial_specs()}
    monkeypatch.setattr("merge_runner.drivers.registry.source_digest", lambda *_, **__: "edited")
    assert not before & {spec.spec_hash for spec in plan.trial_specs()}


async def test_an_edited_program_is_played_anew(merge_runner, tmp_path):
    part = ("sweep", "baseline", "--model", "constant", "--reps", 1, "--conditions", "N_0_0")
    assert (await merge_runner(*part, "--json")).summary["trials"]["stored_before"] == 0
    again = await merge_runner(*part, "--json")
    assert again.summary["trials"]["stored_before"] == 1
    edited = tmp_path / "edited"
    for folder in ("merge_runner", "merge_runner_analysis", "experiments"):
        shutil.copytree(PROJECT / folder, edited / folder)
    driver = edited / "merge_runner/drivers/constant.py"
    driver.write_text(driver.read_text().replace("held(0.0)", "held(0.1)"))
    run = await merge_runner.start(*part, "--json", PYTHONPATH=str(edited))
    out, _ = await run.communicate()
    assert b'"stored_before": 0' in out
