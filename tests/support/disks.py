"""Folders that cannot be written or are full."""

import contextlib
import shutil
import subprocess
import sys

import pytest


@contextlib.contextmanager
def mount(folder, *arguments):
    """Mount something; skips where the system does not let us."""
    if sys.platform != "linux" or shutil.which("mount") is None:
        pytest.skip("mounting needs Linux")
    done = subprocess.run(["mount", *map(str, arguments), folder], capture_output=True, check=False)
    if done.returncode:
        pytest.skip(f"mounting needs more rights: {done.stderr.decode().strip()}")
    try:
        yield
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


@pytest.fixture
def read_only():
    """Makes a folder read-only for everybody, root too."""

    @contextlib.contextmanager
    def make(folder):
        with mount(folder, "--bind", folder):
            subprocess.run(["mount", "-o", "remount,bind,ro", str(folder)], check=True)
            yield

    return make


@pytest.fixture
def small_disk(tmp_path):
    """A folder on a disk of its own, of so many KiB."""

    @contextlib.contextmanager
    def make(kib):
        folder = tmp_path / "small"
        folder.mkdir()
        with mount(folder, "-t", "tmpfs", "-o", f"size={kib}k", "tmpfs"):
            yield folder

    return make
