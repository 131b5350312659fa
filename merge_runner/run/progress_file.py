"""The progress of a sweep in a small file next to the database, for other processes."""

from __future__ import annotations

import hashlib
import os
import socket
from collections.abc import Iterator
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal
from urllib.parse import quote

from pydantic import AwareDatetime, BaseModel, ConfigDict, Field, NonNegativeInt, ValidationError

STALE_S = 10.0
MOST_BYTES = 1_000_000
# Identifies the machine among those that share a folder: process ids mean nothing on another one.
MACHINE = hashlib.sha256(socket.gethostname().encode()).hexdigest()[:8]


def _own_pid() -> int:
    return os.getpid()  # of the builtin itself, pydantic would parse the signature at import


class ProgressSnapshot(BaseModel):
    """Snapshot of a sweep, for its display and for other processes.

    ``ended`` counts trials with an outcome, including those stored before this run. ``left_s`` is
    the estimated time left, None while there is no estimate. ``rows`` are those of the display,
    each with its name: ``WARNING``, ``waiting`` (for what), ``trials``, ``cost`` and so on.
    """

    model_config = ConfigDict(frozen=True)

    sweep_id: str
    pid: int = Field(default_factory=_own_pid, ge=1, lt=2**31)
    machine: str = MACHINE
    updated_at: AwareDatetime
    doing: Literal["playing", "checking"]
    ended: NonNegativeInt
    failed: NonNegativeInt
    cost_usd: float
    left_s: float | None
    rows: tuple[tuple[str, str], ...]

    @property
    def alive(self) -> bool:
        """True where the sweep is still running, by its file and its process."""
        try:
            if self.machine == MACHINE:
                os.kill(self.pid, 0)
        except ProcessLookupError:
            return False
        except PermissionError:
            pass  # it is another user's
        return (datetime.now(UTC) - self.updated_at).total_seconds() < STALE_S


def write_snapshot(db: Path, snapshot: ProgressSnapshot) -> None:
    """Replace a sweep's file as a whole: a reader sees the old state or the new one, no mixture.

    If it cannot be written, the sweep continues.
    """
    path = _path(db, snapshot.sweep_id)
    made = path.with_suffix(".tmp")
    with suppress(OSError):
        path.parent.mkdir(exist_ok=True)
        made.write_text(snapshot.model_dump_json(), encoding="utf-8")
        os.replace(made, path)


def remove_snapshot(db: Path, sweep_id: str) -> None:
    """Remove the file of a sweep that has ended normally."""
    path = _path(db, sweep_id)
    with suppress(OSError):
        path.with_suffix(".tmp").unlink(missing_ok=True)
        path.unlink(missing_ok=True)
        path.parent.rmdir()


def read_snapshot(db: Path, sweep_id: str) -> ProgressSnapshot | None:
    """Return the snapshot of a sweep that runs, or was killed; None without a file."""
    return _read(_path(db, sweep_id))


def running_sweeps(db: Path) -> list[ProgressSnapshot]:
    """Return the snapshots of the sweeps into this database that are running now."""
    return [snapshot for _, snapshot in _snapshots(db) if snapshot.alive]


def clear_dead(db: Path) -> None:
    """Remove the files of killed sweeps, and nothing else."""
    with suppress(OSError):
        for path, snapshot in _snapshots(db):
            if not snapshot.alive:
                path.unlink(missing_ok=True)


def _snapshots(db: Path) -> Iterator[tuple[Path, ProgressSnapshot]]:
    folder = _path(db, "").parent
    with suppress(OSError):
        for path in [] if folder.is_symlink() else list(folder.iterdir()):
            if snapshot := _read(path):
                yield path, snapshot


def _path(db: Path, sweep_id: str) -> Path:
    return db.with_name(f"{db.name}.progress") / f"{quote(sweep_id, safe='+')}.json"


def _read(path: Path) -> ProgressSnapshot | None:
    if not path.is_file():
        return None  # reading a pipe might never end
    try:
        with path.open("rb") as file:
            return ProgressSnapshot.model_validate_json(file.read(MOST_BYTES))
    except (OSError, ValidationError):
        return None
