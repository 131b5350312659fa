"""Where results come from: the program's commit or version, and its packages' versions."""

from __future__ import annotations

import platform
import subprocess
from importlib.metadata import version

from merge_runner.paths import PROJECT

PACKAGES = ("merge-runner", "diskcache", "duckdb", "httpx", "httpx-aiohttp", "pydantic", "tenacity")


def versions() -> dict[str, str]:
    """Python's and the packages' versions."""
    return {"python": platform.python_version(), **{name: version(name) for name in PACKAGES}}


def git_state() -> tuple[str, bool | None]:
    """The commit of the program's own checkout, and whether there are uncommitted changes.

    Files that git does not track, such as a study of the user's, are no change of the program.
    Without a checkout that tracks the package: the installed version and None.
    """
    tracked = _git("ls-files", "--error-unmatch", "merge_runner/__init__.py")
    if tracked and (commit := _git("rev-parse", "HEAD")):
        return commit, bool(_git("status", "--porcelain", "--untracked-files=no"))
    return f"merge-runner {version('merge-runner')}", None


def program() -> str:
    """The program that made a text, for its readers."""
    made_by, changed = git_state()
    if changed is None:
        return f"{made_by}, installed"
    also = ", with changes that are not committed" if changed else ""
    return f"merge-runner at commit {made_by}{also}"


def _git(*arguments: str) -> str:
    """What git says about the repository at PROJECT, and about no other around it; or nothing."""
    own = ["-C", str(PROJECT), f"--git-dir={PROJECT / '.git'}", f"--work-tree={PROJECT}"]
    try:
        done = subprocess.run(  # noqa: S603 # constant arguments
            ["git", *own, *arguments],  # noqa: S607 # the user's own git
            capture_output=True,
            text=True,
            check=True,
        )
    except (FileNotFoundError, subprocess.CalledProcessError):
        return ""
    return done.stdout.strip()
