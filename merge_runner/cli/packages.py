"""Commands of installed packages, which name their modules under the entry point group GROUP.

    [project.entry-points."merge_runner.commands"]
    anything = "my_package.my_commands"

``importlib.metadata`` lists them too, but would add a fifth to the time of ``--help``.
"""

from __future__ import annotations

import re
import sys
from importlib import import_module
from pathlib import Path

GROUP = "merge_runner.commands"
_SECTION = re.compile(rf"^\[{re.escape(GROUP)}\]\s*$(.*?)(?=^\[|\Z)", re.MULTILINE | re.DOTALL)
_MODULE = re.compile(r"^[^#;=]+=\s*([\w.]+)", re.MULTILINE)


def command_modules() -> list[str]:
    """Return the modules that packages of the import path name, each once."""
    modules = {
        module
        for folder in filter(None, sys.path)
        for file in Path(folder).glob("*.dist-info/entry_points.txt")
        for section in _SECTION.findall(file.read_text(encoding="utf-8"))
        for module in _MODULE.findall(section)
    }
    return sorted(modules)


def load_commands() -> None:
    """Import these modules, each of which adds its commands to ``merge_runner.cli.app``.

    One that is missing is left out: the analysis need not be installed.
    """
    for module in command_modules():
        try:
            import_module(module)
        except ModuleNotFoundError as exc:
            if not f"{module}.".startswith(f"{exc.name}."):
                raise
