"""An edited driver is another driver: no row that it stored before is taken for its own."""

import importlib
import shutil
import sys
from importlib.machinery import SourceFileLoader

import pytest

from merge_runner.drivers.registry import PROGRAMS
from merge_runner.errors import UsageError
from merge_runner.run.plan import make_plan
from merge_runner.source import source_digest
from tests.harness import PROJECT

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
        digest(driver=PACKAGE["driver.py"] + "# a remark\n"),
        digest(params="GAP_M = 5.0\n"),
        digest(late="LATER = 2\n"),
        digest(__init__="import plugged.unused\n"),
    }
    assert len(changes) == 4
    assert not same & changes


def test_a_driver_without_its_source_is_refused(digest, monkeypatch):
    digest()
    monkeypatch.setattr(SourceFileLoader, "get_source", lambda self, name: None)
    mine = type("Mine", (), {"__module__": "plugged.driver"})
    with pytest.raises(UsageError, match=r"the source of plugged\.driver is not there"):
        source_digest(mine)


def test_programs_have_a_source_of_their_own_and_share_what_both_rest_on(monkeypatch):
    before = {name: program.source for name, program in PROGRAMS.items()}
    assert len(set(before.values())) == len(PROGRAMS)
    read = SourceFileLoader.get_source

    def edited(self, name):
        return read(self, name) + "# edited\n" * (name == "merge_runner.drivers.base")

    monkeypatch.setattr(SourceFileLoader, "get_source", edited)
    source_digest.cache_clear()
    after = {name: program.source for name, program in PROGRAMS.items()}
    source_digest.cache_clear()
    own = [n for n, one in PROGRAMS.items() if one.driver.__module__.startswith("merge_runner.")]
    assert all(before[name] != after[name] for name in own)


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
    for folder in ("merge_runner", "analysis", "experiments"):
        shutil.copytree(PROJECT / folder, edited / folder)
    driver = edited / "merge_runner/drivers/constant.py"
    driver.write_text(driver.read_text().replace("held(0.0)", "held(0.1)"))
    run = await merge_runner.start(*part, "--json", PYTHONPATH=str(edited))
    out, _ = await run.communicate()
    assert b'"stored_before": 0' in out
