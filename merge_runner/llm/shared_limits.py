"""The limits of one key, kept by all processes of a user together.

What was sent within a window lies in a small file, which processes change in turn under a lock that
none of them waits for: whoever finds it taken tries again soon. The kernel frees the lock of a
process that dies. Times are those of the machine's clock since it was started, and the file's name
is a hash: nothing of the key can be read from it.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import stat
import struct
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from merge_runner.config import runtime_folder
from merge_runner.errors import UsageError

WINDOW_S = 60.0
BURST_S = 0.5
# No account's limit lets more be sent in a minute.
MOST_REQUESTS = 2**16
# The others hold the file for microseconds.
BUSY_S = 0.002
# Tokens are counted by the half second: the file stays small, and the window errs by no more.
BUCKET_S = 0.5
BUCKETS = 128
BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
_HEAD = struct.Struct("qd")  # requests sent ever, and until when all are to wait
_BUCKETS = struct.Struct("qq" * BUCKETS)  # the number of half a second, and its tokens
_TIME = struct.Struct("d")
SIZE = _HEAD.size + _BUCKETS.size + MOST_REQUESTS * _TIME.size


class SharedLimits:
    """What all processes have sent to one endpoint with one key for one model.

    ``rpm`` requests and ``tpm`` tokens are sent in ``window_s`` at most.
    """

    def __init__(
        self,
        file: Path,
        *,
        rpm: int | None = None,
        tpm: int | None = None,
        window_s: float = WINDOW_S,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._file = _opened(file)
        self._rules = request_rules(rpm, window_s) if rpm and rpm <= MOST_REQUESTS else []
        self._tpm = tpm
        self._window_s = window_s
        self._clock = clock
        self._closed = False
        self._owed: list[tuple[int, int]] = []
        self._paused_until = 0.0

    def take(self, tokens: int) -> float:
        """Take a turn; 0 where it is taken, else how long in s to wait at least."""
        with self._locked() as locked:
            if not locked:
                return BUSY_S  # the event loop never waits for another process, which may hang
            now = self._clock()
            sent, paused_until = self._head(now)
            buckets = self._buckets(now)
            free_at = max(
                paused_until,
                self._tokens_free_at(buckets, tokens),
                *(self._free_at(sent, *rule) for rule in self._rules),
            )
            if free_at <= now:
                os.pwrite(self._file, _TIME.pack(now), self._place(sent))
                sent += 1
                number = int(now / BUCKET_S)
                buckets[number] = buckets.get(number, 0) + tokens
            self._write(sent, paused_until, buckets)
        return max(0.0, free_at - now)

    def settle(self, taken_at: float, more_tokens: int) -> None:
        """A request used so many tokens more than its turn had counted; less if negative."""
        # Kept here until the file is free: an unused estimate must not be lost for the others.
        self._owed.append((int(taken_at / BUCKET_S), more_tokens))
        self._tell()

    def pause(self, seconds: float) -> None:
        """Nobody sends anything for a while."""
        self._paused_until = max(self._paused_until, self._clock() + seconds)
        self._tell()

    def close(self) -> None:
        """Close the file."""
        self._closed = True
        os.close(self._file)

    def _tell(self) -> None:
        """Tell the others now, or where the file is taken with the next turn."""
        if self._closed:
            return
        with self._locked() as locked:
            if locked:
                now = self._clock()
                self._write(*self._head(now), self._buckets(now))

    @contextmanager
    def _locked(self) -> Iterator[bool]:
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            yield False
            return
        try:
            yield True
        finally:
            fcntl.flock(self._file, fcntl.LOCK_UN)

    def _head(self, now: float) -> tuple[int, float]:
        """How many were sent ever, and until when all wait."""
        sent, paused_until = _HEAD.unpack(os.pread(self._file, _HEAD.size, 0))
        if self._sent_at(sent, 1) > now:  # the machine was restarted, and its clock with it
            sent, paused_until = 0, 0.0
        return sent, max(paused_until, self._paused_until)

    def _free_at(self, sent: int, limit: int, period_s: float) -> float:
        return self._sent_at(sent, limit) + period_s if sent >= limit else 0.0

    def _sent_at(self, sent: int, back: int) -> float:
        """When the last request but so many was sent."""
        if sent < back:
            return 0.0
        at: float = _TIME.unpack(os.pread(self._file, _TIME.size, self._place(sent - back)))[0]
        return at

    @staticmethod
    def _place(number: int) -> int:
        return _HEAD.size + _BUCKETS.size + number % MOST_REQUESTS * _TIME.size

    def _buckets(self, now: float) -> dict[int, int]:
        """The tokens of each half second that the window still holds, with what was owed."""
        numbers = _BUCKETS.unpack(os.pread(self._file, _BUCKETS.size, _HEAD.size))
        oldest = (now - self._window_s) / BUCKET_S - 1
        pairs = zip(numbers[::2], numbers[1::2], strict=True)
        kept = {n: tokens for n, tokens in pairs if tokens and oldest < n <= now / BUCKET_S}
        for number, tokens in self._owed:
            if number > oldest:
                kept[number] = kept.get(number, 0) + tokens
        self._owed.clear()
        return kept

    def _tokens_free_at(self, buckets: Mapping[int, int], tokens: int) -> float:
        if self._tpm is None or sum(buckets.values()) + tokens <= self._tpm:
            return 0.0
        return (min(buckets, default=0) + 1) * BUCKET_S + self._window_s

    def _write(self, sent: int, paused_until: float, buckets: Mapping[int, int]) -> None:
        cells = [0] * (2 * BUCKETS)
        for number, tokens in buckets.items():
            at = 2 * (number % BUCKETS)
            cells[at : at + 2] = number, tokens
        os.pwrite(self._file, _HEAD.pack(sent, paused_until) + _BUCKETS.pack(*cells), 0)


def request_rules(rpm: int, window_s: float) -> list[tuple[int, float]]:
    """How many in how many s: an even flow, and at most ``rpm`` in any window.

    Half a second's worth goes at a time: a whole window at once would trip finer limits.
    """
    burst = max(1, int(rpm * BURST_S / window_s))
    return [(burst, burst * window_s / rpm), (rpm, window_s)]


def limits_file(base_url: str, model: str, secrets: Mapping[str, str]) -> Path:
    """The file of one endpoint, model and key. Raises UsageError where it cannot be ours alone."""
    # The clock begins anew when the machine is started: then it is another file.
    boot = BOOT_ID.read_text() if BOOT_ID.is_file() else ""
    what = json.dumps([base_url, model, sorted(secrets.items()), boot])
    return _own_folder() / hashlib.sha256(what.encode()).hexdigest()[:32]


def _opened(file: Path) -> int:
    """The file at its full size, so that the disk cannot be found full in the midst of a run."""
    try:
        opened = os.open(file, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
        if hasattr(os, "posix_fallocate"):  # not on macOS
            os.posix_fallocate(opened, 0, SIZE)
        else:
            os.ftruncate(opened, SIZE)
    except OSError as exc:
        raise _unusable(file, exc) from exc
    return opened


def _unusable(place: Path, exc: OSError) -> UsageError:
    return UsageError(
        f"{place}, where sweeps share the limits of a key, cannot be used: {exc.strerror}. "
        "Name another folder with XDG_RUNTIME_DIR"
    )


def _own_folder() -> Path:
    """A folder of this user alone, of this machine."""
    folder = runtime_folder() / f"merge-runner-{os.getuid()}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
    except OSError as exc:
        raise _unusable(folder, exc) from exc
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o077:
        raise UsageError(
            f"{folder}, where sweeps share the limits of a key, is not yours alone: remove it, or "
            "name another folder with XDG_RUNTIME_DIR"
        )
    return folder
