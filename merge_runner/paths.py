"""Default paths, shipped files, and a check before a file is overwritten."""

from __future__ import annotations

import shlex
from pathlib import Path

from merge_runner.errors import UsageError

PACKAGE = Path(__file__).resolve().parent
PROJECT = PACKAGE.parent


def shipped(in_wheel: Path, in_checkout: str) -> Path:
    """Return the path of a shipped file or folder, in the wheel or in the checkout."""
    return in_wheel if in_wheel.exists() else PROJECT / in_checkout


def named_queries(path: Path) -> dict[str, str]:
    """Return the blocks of an SQL file by name; the first block has none."""
    blocks = path.read_text("utf-8").split("\n\n")[1:]
    return {block[3 : block.index(":")]: block.rstrip(";\n") for block in blocks}


SHIPPED_EXPERIMENTS = shipped(PACKAGE / "experiments", "experiments")
SHIPPED_RECORDINGS = shipped(PACKAGE / "recordings", "cache/recordings")
DEFAULT_DB = Path("results/merge.duckdb")
DEFAULT_CACHE = Path("cache/responses")


def home_of(study: str) -> Path:
    """Return the folder of a study's results: its file's folder, or the parent of ``experiments``.

    A study given by name has its results in the working directory.
    """
    if not study.endswith(".toml"):
        return Path()
    folder = Path(study).absolute().parent
    home = folder.parent if folder.name == "experiments" else folder
    return home.relative_to(Path.cwd()) if home.is_relative_to(Path.cwd()) else home


def db_words(db: Path, study: str = "") -> list[str]:
    """Return ``--db`` with the database, unless it is the study's default one."""
    is_default = (home_of(study) / DEFAULT_DB).absolute() == db.absolute()
    return [] if is_default else ["--db", str(db)]


def command_at(command: str, option: str, place: Path | str, usual: Path) -> str:
    """Return a command to type, with the option unless its path is the ``usual`` one.

    >>> command_at("merge-runner audit", "--db", "other.duckdb", DEFAULT_DB)
    'merge-runner audit --db other.duckdb'
    """
    at = "" if Path(place) == usual else f" {option} {shlex.quote(str(place))}"
    return f"{command}{at}"


def check_kind(file: Path, begins: bytes, kind: str) -> None:
    """Raise UsageError if a file exists and does not begin like a file of this kind."""
    if not file.is_file():
        return
    with file.open("rb") as existing:
        head = existing.read(len(begins))
    if head.lower() != begins.lower():
        raise UsageError(
            f"{file} is there, and is no {kind}: name another file, or remove that one"
        )
