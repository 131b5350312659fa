"""The hash of a driver's source on every Python."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from merge_runner.drivers.registry import PROGRAMS
from merge_runner.source import source_digest
from tests.support.harness import PROJECT

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


@pytest.mark.parametrize("python", PYTHONS, ids=lambda python: python.parents[1].name)
def test_the_sources_have_the_same_hash_on_every_python(python):
    modules = {name: program.driver.__module__ for name, program in PROGRAMS.items()}
    command = [python, "-c", HASHED, PROJECT / "merge_runner/drivers", *modules.values()]
    roots = os.environ | {"PYTHONPATH": f"{PROJECT}:{PROJECT / 'plugins'}"}
    done = subprocess.run(command, env=roots, capture_output=True, text=True, check=True)
    assert dict(zip(modules, done.stdout.split(), strict=True)) == {
        name: source_digest(program.driver) for name, program in PROGRAMS.items()
    }
