"""Who asks what, across processes, so that two sweeps at once never make one call twice.

A claim is a lock on one byte of a file. The kernel frees it when its holder dies, however it dies.
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
        """Raises UsageError where the folder's file system has no locks."""
        self._closed = False
        try:
            # No link is followed: it would make a file wherever it leads.
            flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW
            self._file = os.open(folder / LOCK_FILE, flags, 0o600)
            if self.take(_TRIED):
                self.release(_TRIED)
        except OSError as exc:
            raise UsageError(
                f"the cache {folder} cannot be shared safely: {LOCK_FILE} cannot be locked "
                f"({exc.strerror}). Name a folder on a local disk with --cache"
            ) from exc

    def take(self, key: str) -> bool:
        """Claim a key; False while another process holds it."""
        try:
            fcntl.lockf(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, _offset(key))
        except (BlockingIOError, PermissionError):  # the two ways in which systems say so
            return False
        return True

    def take_all(self) -> bool:
        """Claim every key until this is closed; False while another process holds any."""
        try:
            fcntl.lockf(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except (BlockingIOError, PermissionError):
            return False
        return True

    async def claim(self, key: str) -> bool:
        """Claim a key; see ``take``."""
        return self.take(key)

    def release(self, key: str) -> None:
        """Give a claim up; all of them are when this is closed."""
        if self._closed:  # a call that was dropped at the end of a run may come late
            return
        fcntl.lockf(self._file, fcntl.LOCK_UN, 1, _offset(key))

    def close(self) -> None:
        """Give all claims up."""
        self._closed = True
        os.close(self._file)


def _offset(key: str) -> int:
    """The byte that stands for a key: 60 bits of its hash, so that two never meet."""
    return int(key[:15], 16)
