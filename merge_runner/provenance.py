"""Where results come from: the program's commit and the versions of what it runs on."""

from __future__ import annotations

import platform
import subprocess
from importlib.metadata import version

from merge_runner.places import PROJECT

PACKAGES = ("merge-runner", "diskcache", "duckdb", "httpx", "httpx-aiohttp", "pydantic", "tenacity")


def versions() -> dict[str, str]:
    """Python's and the packages' versions."""
    return {"python": platform.python_version(), **{name: version(name) for name in PACKAGES}}


def git_state() -> tuple[str | None, bool | None]:
    """The commit of the program's checkout and whether it is changed; None outside of git."""
    commit = _git("rev-parse", "HEAD")
    return commit, None if commit is None else bool(_git("status", "--porcelain"))


def _git(*arguments: str) -> str | None:
    try:
        done = subprocess.run(  # noqa: S603 # constant arguments
            ["git", "-C", str(PROJECT), *arguments],  # noqa: S607 # the user's own git
            capture_output=True,
            text=True,
            check=False,
        )
    except FileNotFoundError:
        return None
    return done.stdout.strip() if done.returncode == 0 else None
