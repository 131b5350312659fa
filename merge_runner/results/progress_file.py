"""The progress of a running sweep, for other processes, in a small file beside its database."""

from __future__ import annotations

import hashlib
import logging
import os
import platform
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Literal
from urllib.parse import quote

from pydantic import AwareDatetime, NonNegativeInt, TypeAdapter, ValidationError
from pydantic_core import to_json

EVERY_S = 1.0
STALE_S = 10.0
# While a sweep checks what it stored, the file is silent: only its process shows that it lives.
CHECKING_STALE_S = 600.0
MOST_BYTES = 1_000_000
LOG = logging.getLogger(__name__)
# Identifies the machine among those that share a folder: process ids mean nothing on another one.
MACHINE = hashlib.sha256(platform.node().encode()).hexdigest()[:8]


@dataclass(frozen=True, slots=True)
class Standing:
    """Where a sweep stands. ``committed_usd`` counts against ``cap_usd``, over all runs.

    ``ended`` trials have an outcome, those that were ``stored_before`` this run among them.
    ``waiting`` says what its calls wait for, ``warnings`` what its user should know. ``left_s`` is
    the estimated time left, None while there is no estimate.
    """

    sweep_id: str
    name: str
    model: str
    pid: int
    machine: str
    started_at: AwareDatetime
    updated_at: AwareDatetime
    doing: Literal["playing", "checking"]
    trials: NonNegativeInt
    stored_before: NonNegativeInt
    running: NonNegativeInt
    workers: NonNegativeInt | None
    ended: NonNegativeInt
    failed: NonNegativeInt
    calls_live: NonNegativeInt
    calls_cached: NonNegativeInt
    cost_usd: float
    cap_usd: float | None
    committed_usd: float | None
    left_s: float | None
    worst_stall_s: float
    waiting: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()

    @property
    def alive(self) -> bool:
        """Whether the sweep is still running, by its file and its process."""
        if self.machine == MACHINE and not _exists(self.pid):
            return False
        age_s = (datetime.now(UTC) - self.updated_at).total_seconds()
        return age_s < (CHECKING_STALE_S if self.doing == "checking" else STALE_S)


@cache  # a sweep only writes its file
def _standing() -> TypeAdapter[Standing]:
    return TypeAdapter(Standing)


@dataclass(slots=True)
class ProgressFile:
    """The file of one sweep. If it cannot be written, one warning says so; the sweep goes on."""

    db: Path
    sweep_id: str
    _told: bool = False

    def write(self, standing: Standing) -> None:
        """Replace the file as a whole: a reader sees the old state or the new one, never a part."""
        path = _path(self.db, self.sweep_id)
        made = path.with_suffix(".tmp")
        try:
            path.parent.mkdir(exist_ok=True)
            made.write_bytes(to_json(standing))
            os.replace(made, path)
        except OSError as exc:
            if not self._told:
                LOG.warning("nobody else can see how far the sweep is: %s", exc)
            self._told = True

    def remove(self) -> None:
        """Remove the file of a sweep that has ended normally."""
        path = _path(self.db, self.sweep_id)
        with suppress(OSError):
            path.with_suffix(".tmp").unlink(missing_ok=True)
            path.unlink(missing_ok=True)
            path.parent.rmdir()


def read_standing(db: Path, sweep_id: str) -> Standing | None:
    """Where a sweep stands, or stood when it was killed; None without a file."""
    standing = _read(_path(db, sweep_id))
    return standing if standing and standing.sweep_id == sweep_id else None


def running(db: Path) -> list[Standing]:
    """Where the sweeps into this database stand that are running now."""
    return [standing for _, standing in _standings(db) if standing.alive]


def clear_dead(db: Path) -> None:
    """Remove what killed sweeps left, and nothing else."""
    with suppress(OSError):
        for path, standing in _standings(db):
            if not standing.alive:
                path.unlink(missing_ok=True)


def _standings(db: Path) -> list[tuple[Path, Standing]]:
    folder = _folder(db)
    try:
        paths = [] if folder.is_symlink() else list(folder.iterdir())
    except OSError:
        return []
    return [(path, standing) for path in paths if (standing := _read(path))]


def _folder(db: Path) -> Path:
    return db.with_name(f"{db.name}.progress")


def _path(db: Path, sweep_id: str) -> Path:
    return _folder(db) / f"{quote(sweep_id, safe='+')}.json"


def _read(path: Path) -> Standing | None:
    if not path.is_file():
        return None  # reading a pipe might never end
    try:
        with path.open("rb") as file:
            return _standing().validate_json(file.read(MOST_BYTES))
    except (OSError, ValidationError):
        return None


def _exists(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
    return True
