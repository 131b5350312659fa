"""Trials that wait on disk until the database can be written."""

from __future__ import annotations

import pickle
import tempfile
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import IO

from merge_runner.records import TrialRecord


class Spill:
    """Batches of trials in a file without a name, which only this process has open.

    The file goes with the process: the replies are in the cache, from which the trials are played
    again.
    """

    def __init__(self) -> None:
        self.trials = 0
        self._file: IO[bytes] | None = None
        self._batches: deque[tuple[int, int]] = deque()  # where each begins, and its trials

    def put(self, batch: Sequence[TrialRecord], folder: Path) -> None:
        """Write a batch into the file, which is made in this folder; raises OSError."""
        if self._file is None:
            self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115 # open as long as it is used
        begins = self._file.seek(0, 2)
        pickle.dump(list(batch), self._file)
        self._file.flush()
        self._batches.append((begins, len(batch)))
        self.trials += len(batch)

    def take(self) -> list[TrialRecord]:
        """The oldest batch, which is no longer in the spill; nothing if there is none."""
        if not self._batches or self._file is None:
            return []
        begins, trials = self._batches.popleft()
        self._file.seek(begins)
        batch: list[TrialRecord] = pickle.load(self._file)  # noqa: S301 # nobody else can write it
        if not self._batches:
            self._file.truncate(0)
        self.trials -= trials
        return batch
