"""A new folder with a study that runs as it is."""

from __future__ import annotations

import shutil
from pathlib import Path

from merge_runner.errors import UsageError

TEMPLATE = Path(__file__).with_name("template")
PLUGIN = "plugin.py"
FILES = ("study.toml", "models.toml", PLUGIN, "README.md", "CITATION.cff", "Makefile")
IGNORED = "gitignore"  # with a dot it would hold for the template itself


def write_folder(folder: Path) -> list[Path]:
    """Write the files of a new study; raises UsageError where the folder is not empty."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if any(folder.iterdir()):
            raise UsageError(f"{folder} is not empty: name a new folder")
        named = {name: name for name in FILES} | {IGNORED: f".{IGNORED}"}
        return [shutil.copyfile(TEMPLATE / ours, folder / name) for ours, name in named.items()]
    except OSError as exc:
        raise UsageError(f"{folder} cannot be written: {exc.strerror}") from exc
