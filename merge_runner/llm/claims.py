"""Who makes which call, across processes, so that two sweeps at once never make one twice.

A claim is a lock on one byte of a file. The kernel frees it when its holder dies, however it dies:
no lock is ever left behind, as a file or a row would be.
"""

from __future__ import annotations

import fcntl
import os
from pathlib import Path

from merge_runner.errors import UsageError

LOCK_FILE = "claims.lock"
_TRIED = "f" * 64


class Claims:
    """The claims of this process on call keys, among all processes that use the same folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._held: set[str] = set()
        self._file: int | None = None

    def open(self) -> int:
        """The lock file, opened once; raises UsageError where its file system has no locks."""
        if self._file is None:
            try:
                # No link is followed: it would make a file wherever it leads.
                flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW
                self._file = os.open(self._folder / LOCK_FILE, flags, 0o600)
                if self.take(_TRIED):
                    self.release(_TRIED)
            except OSError as exc:
                self.close()
                raise UsageError(
                    f"the cache {self._folder} cannot be shared safely: {LOCK_FILE} cannot be "
                    f"locked ({exc.strerror}). Name a folder on a local disk with --cache"
                ) from exc
        return self._file

    def take(self, key: str) -> bool:
        """Claim a key; False while another process, or another call of this one, holds it."""
        # The kernel's lock is the whole process's: it keeps no two calls of this one apart.
        if key in self._held or not self._locked(1, _offset(key)):
            return False
        self._held.add(key)
        return True

    def take_all(self) -> bool:
        """Claim every key until this is closed; False while another process holds any."""
        return self._locked(0, 0)  # 0 bytes are all, to the end of the file and beyond

    def release(self, key: str) -> None:
        """Give a claim up; all of them are when this is closed."""
        self._held.discard(key)
        if self._file is not None:  # a call that was dropped at the end of a run may come late
            fcntl.lockf(self._file, fcntl.LOCK_UN, 1, _offset(key))

    def close(self) -> None:
        """Give all claims up."""
        if self._file is not None:
            os.close(self._file)
            self._file = None

    def _locked(self, length: int, start: int) -> bool:
        try:
            fcntl.lockf(self.open(), fcntl.LOCK_EX | fcntl.LOCK_NB, length, start)
        except (BlockingIOError, PermissionError):  # the two ways in which systems say so
            return False
        return True


def _offset(key: str) -> int:
    """The byte that stands for a key: 60 bits of its hash, so that two never meet."""
    return int(key[:15], 16)
