"""Locks of a cache folder, so that one live run at a time asks a model.

A lock is one on an open file, and the kernel frees it when its holder dies: no lock is ever left
behind, as a file or a row would be. The file holds the id of its holder's process.
"""

from __future__ import annotations

import fcntl
import os
import re
from collections.abc import Iterable
from pathlib import Path

from merge_runner.errors import UsageError

# Live runs share it, and who releases what is set aside holds it alone.
LIVE = "live.lock"


class ModelLocks:
    """The locks that this run holds on a folder; ``close`` frees them."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._files: list[int] = []

    def take(self, models: Iterable[str]) -> None:
        """Lock models for a live run; raises UsageError where another run asks one of them."""
        self._lock(LIVE, fcntl.LOCK_SH)
        for model in sorted(models):
            name = re.sub(r"[^\w. -]", "_", model)[:200] + ".lock"
            if not self._lock(name, fcntl.LOCK_EX | fcntl.LOCK_NB):
                holder = (self._folder / name).read_text(errors="replace")
                self.close()
                raise UsageError(
                    f"another merge-runner ({holder}) asks {model} with the cache {self._folder}: "
                    "wait until it has ended, or name another folder with --cache; `merge-runner "
                    "sweep A B` plays several sweeps one after the other"
                )
            os.ftruncate(self._files[-1], 0)
            os.write(self._files[-1], f"PID {os.getpid()} on {os.uname().nodename}".encode())

    def take_all(self) -> bool:
        """Keep live runs from beginning; False while there is any."""
        return self._lock(LIVE, fcntl.LOCK_EX | fcntl.LOCK_NB)

    def close(self) -> None:
        """Free all locks."""
        while self._files:
            os.close(self._files.pop())

    def _lock(self, name: str, how: int) -> bool:
        try:
            file = os.open(self._folder / name, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
            self._files.append(file)
            fcntl.flock(file, how)
        except BlockingIOError:
            os.close(self._files.pop())
            return False
        except OSError as exc:
            self.close()
            raise UsageError(
                f"the cache {self._folder} cannot be shared safely: {name} cannot be locked "
                f"({exc.strerror}). Name a folder on a local disk with --cache"
            ) from exc
        return True
