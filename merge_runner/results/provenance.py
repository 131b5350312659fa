"""Provenance of results: the program's commit or version, and its packages' versions."""

from __future__ import annotations

import platform
import subprocess
from importlib.metadata import version

from merge_runner.paths import PROJECT

PACKAGES = ("merge-runner", "diskcache", "duckdb", "httpx", "httpx-aiohttp", "pydantic", "tenacity")


def versions() -> dict[str, str]:
    """Return the versions of Python and the packages."""
    return {"python": platform.python_version(), **{name: version(name) for name in PACKAGES}}


def git_state() -> tuple[str, bool | None]:
    """Return the commit of the program's checkout, and whether it has uncommitted changes.

    Untracked files, such as a user's study, are no change of the program. Without a checkout that
    tracks the package, return the installed version and None.
    """
    tracked = _git("ls-files", "--error-unmatch", "merge_runner/__init__.py")
    if tracked and (commit := _git("rev-parse", "HEAD")):
        return commit, bool(_git("status", "--porcelain", "--untracked-files=no"))
    return f"merge-runner {version('merge-runner')}", None


def program() -> str:
    """Return the program's version in words, for the head of a report."""
    version_name, changed = git_state()
    if changed is None:
        return f"{version_name}, installed"
    suffix = ", with changes that are not committed" if changed else ""
    return f"merge-runner at commit {version_name}{suffix}"


def _git(*arguments: str) -> str:
    """Return git's output for the repository at PROJECT, never one around it; "" on failure."""
    place = ["-C", str(PROJECT), f"--git-dir={PROJECT / '.git'}", f"--work-tree={PROJECT}"]
    try:
        done = subprocess.run(  # noqa: S603 # constant arguments
            ["git", *place, *arguments],  # noqa: S607 # the user's own git
            capture_output=True,
            text=True,
            check=True,
        )
    except (FileNotFoundError, subprocess.CalledProcessError):
        return ""
    return done.stdout.strip()
