"""What is said of the program is said of its own checkout, or of what is installed."""

import shutil
import subprocess
import sys

from tests.support.harness import PROJECT, environment

SAY = """
from merge_runner.results.provenance import git_state, program
print(git_state(), program(), sep="\\n")
"""


def git(folder, *arguments):
    who = ("-c", "user.name=n", "-c", "user.email=e")
    done = subprocess.run(
        ["git", "-C", folder, *who, *arguments], capture_output=True, text=True, check=True
    )
    return done.stdout.strip()


def committed(folder, *what):
    """Make a repository in a folder, with a commit; returns that."""
    git(folder, "init", "--quiet")
    (folder / "study.txt").write_text("the user's own")
    (folder / ".gitignore").write_text("__pycache__\n")
    git(folder, "add", ".gitignore", "study.txt", *what)
    git(folder, "commit", "--quiet", "-m", "m")
    return git(folder, "rev-parse", "HEAD")


def copied(folder):
    """Copy the package to a folder."""
    ignored = shutil.ignore_patterns("__pycache__")
    shutil.copytree(PROJECT / "merge_runner", folder / "merge_runner", ignore=ignored)
    return folder


def said_in(packages, **changes):
    env = environment(PYTHONPATH=str(packages), **changes)
    code = [sys.executable, "-c", SAY]
    done = subprocess.run(code, cwd=packages, env=env, capture_output=True, text=True, check=True)
    return done.stdout.splitlines()


def test_a_users_repository_around_an_installed_copy_is_not_the_programs(tmp_path):
    for place, tracked in (("", ()), (".venv/lib/site-packages", (".venv",))):
        packages = copied(tmp_path / place)
        committed(tmp_path, *tracked)
        # A hook of that repository names it to everything that it runs.
        for hook in ({}, {"GIT_DIR": str(tmp_path / ".git")}):
            told = ["('merge-runner 0.1.0', None)", "merge-runner 0.1.0, installed"]
            assert said_in(packages, **hook) == told


def test_a_checkout_is_named_by_its_commit_and_whether_it_is_changed(tmp_path):
    checkout = copied(tmp_path / "main")
    commit = committed(checkout, "merge_runner")
    (checkout / "study.toml").write_text("a user's own")
    clean = [f"('{commit}', False)", f"merge-runner at commit {commit}"]
    assert said_in(checkout) == clean
    git(checkout, "worktree", "add", "--quiet", tmp_path / "other")
    assert said_in(tmp_path / "other") == clean
    (checkout / "study.txt").write_text("changed")
    changed = f"{clean[1]}, with changes that are not committed"
    assert said_in(checkout) == [f"('{commit}', True)", changed]
