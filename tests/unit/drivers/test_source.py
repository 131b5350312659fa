"""An edited driver is another driver: no row that it stored before is taken for its own."""

import importlib
import shutil
import sys
from importlib.machinery import SourceFileLoader

import pytest

from merge_runner.drivers.registry import PROGRAMS
from merge_runner.errors import UsageError
from merge_runner.run.plan import make_plan
from merge_runner.source import code_of, source_digest
from tests.support.harness import PROJECT

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
        changed = {f"{name}.py": text for name, text in changed.items()}
        for name, text in (PACKAGE | changed).items():
            (tmp_path / "plugged" / name).write_text(text)
        for name in [name for name in sys.modules if name.partition(".")[0] == "plugged"]:
            del sys.modules[name]
        importlib.invalidate_caches()
        return source_digest(importlib.import_module("plugged.driver").Mine)

    return write


def test_a_change_of_a_driver_or_of_what_it_rests_on_is_another_driver(digest):
    (same,) = {digest(), digest(), digest(unused="nothing = 1\n")}
    changes = {
        same,
        digest(driver=PACKAGE["driver.py"] + "REMARK = '# no comment'\n"),
        digest(params="GAP_M = 5.0\n"),
        digest(late="LATER = 2\n"),
        digest(__init__="import plugged.unused\n"),
    }
    assert len(changes) == 5


def test_another_wording_of_comments_and_docstrings_is_no_other_driver(digest):
    named = "class Mine:  # of gaps\n    'A driver.'\n"
    worded = '"""One."""\n# Two\n' + PACKAGE["driver.py"].replace("class Mine:\n", named)
    assert digest() == digest(driver=worded, params="\n\nGAP_M = 4.0  # m\n")


AS_IT_IS = [
    'X = "# no comment"\n',
    'X = """a\n\n# no comment\n"""\n',
    "def f(): 'no line of its own'; g()\n",
    "X = [\n    'a text'\n]\n",
    "f'{no} docstring'\n",
]


@pytest.mark.parametrize("source", AS_IT_IS)
def test_code_stays_as_it_is(source):
    assert "\n".join(code_of(source)) == source


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_what_is_cut_out_are_comments_docstrings_and_blank_lines(end):
    source = [
        *('"""Of the', 'module."""', "", "# why", "X = 1  # m", '"""What X is."""'),
        *("class Ä:", '    "Ä."', "", "    def f(self):", "        '''Does it.'''  # yes"),
        *("        return (", "            # inside", "", "            1)", ""),
    ]
    code = "X = 1\nclass Ä:\n    def f(self):\n        return (\n            1)\n"
    assert "\n".join(code_of(end.join(source))) == code


def test_a_driver_without_its_source_is_refused(digest, monkeypatch):
    digest()
    monkeypatch.setattr(SourceFileLoader, "get_source", lambda self, name: None)
    mine = type("Mine", (), {"__module__": "plugged.driver"})
    with pytest.raises(UsageError, match=r"the source of plugged\.driver is not there"):
        source_digest(mine)


def test_programs_have_a_source_of_their_own_and_share_what_both_rest_on(monkeypatch):
    def sources_and_trials():
        source_digest.cache_clear()
        plans = [make_plan("baseline", name) for name in ("constant", "emulator+constant")]
        trials = {spec.spec_hash for plan in plans for spec in plan.trial_specs()}
        return {source_digest(program.driver) for program in PROGRAMS.values()}, trials

    sources, trials = sources_and_trials()
    assert len(sources) == len(PROGRAMS)
    read = SourceFileLoader.get_source

    def edited(self, name):
        return read(self, name) + "EDITED = 1\n" * (name == "merge_runner.drivers.base")

    monkeypatch.setattr(SourceFileLoader, "get_source", edited)
    other_sources, other_trials = sources_and_trials()
    source_digest.cache_clear()
    assert not sources & other_sources
    assert not trials & other_trials


def test_the_spec_hashes_of_the_reference_drivers_are_the_committed_ones():
    """They change with the code of a driver alone: say in the commit why it does."""
    specs = make_plan("reference", repetitions=1).trial_specs()
    found = sorted({f"{one.model_left},{one.spec_hash}" for one in specs})
    committed = PROJECT / "tests/golden/reference-spec-hashes.csv"
    assert found == committed.read_text().splitlines()[1:]
