"""Notes on trials and decisions: lines of a file beside the database, never in it.

Lines are only added, so that two explorers may write at once and nothing is lost.
"""

from __future__ import annotations

import fcntl
import getpass
import os
import re
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path
from typing import Annotated

from pydantic import AwareDatetime, StringConstraints, TypeAdapter, ValidationError

from merge_runner.errors import UsageError
from merge_runner.records import Side

LONGEST_TEXT, LONGEST_NAME = 4_000, 60
TAG = re.compile(r"(?<!\w)#(\w[\w-]*)")


@dataclass(frozen=True, slots=True)
class Note:
    """A reader's note on a trial or, with ``side`` and ``decision``, on a decision.

    The spec says which trial is meant in a copy of the study, too. ``#words`` of the text are tags.
    """

    at: AwareDatetime
    reader: Annotated[str, StringConstraints(min_length=1, max_length=LONGEST_NAME)]
    trial_id: str
    spec_hash: str
    side: Side | None
    decision: int | None
    text: Annotated[str, StringConstraints(min_length=1, max_length=LONGEST_TEXT)]

    def __post_init__(self) -> None:
        if (self.side is None) != (self.decision is None):
            raise ValueError("a decision has a side and a number")


LINE = TypeAdapter(Note)


@dataclass(frozen=True, slots=True)
class StoredNotes:
    """The notes of a file, the earliest first, and what could not be read."""

    notes: tuple[Note, ...] = ()
    damage: tuple[str, ...] = ()
    tags: tuple[tuple[str, str, str], ...] = ()
    """(trial, spec, tag) of each trial and its decisions, each once."""


class Notes:
    """The notes beside a database, and the reader who adds to them."""

    def __init__(self, db: Path, reader: str = "") -> None:
        self.path = db.with_name(f"{db.stem}.notes.jsonl")
        self.reader = reader

    def read(self) -> StoredNotes:
        """Return the content of the file: the same object while the file is the same."""
        try:
            stat = self.path.stat()
            return _parsed(self.path, (stat.st_ino, stat.st_mtime_ns, stat.st_size))
        except FileNotFoundError:
            return StoredNotes()
        except OSError as exc:
            return StoredNotes(damage=(f"{self.path.name} cannot be read: {exc.strerror}",))

    def of(self, trial_id: str, spec_hash: str) -> list[Note]:
        """Return the notes of a trial."""
        at = trial_id, spec_hash
        return [note for note in self.read().notes if (note.trial_id, note.spec_hash) == at]

    def add(
        self, trial_id: str, spec_hash: str, side: str, decision: int | None, text: str
    ) -> None:
        """Note something of a trial, or of a decision by its side and number; raises UsageError."""
        of = {"trial_id": trial_id, "spec_hash": spec_hash, "side": side or None}
        written = {"at": datetime.now(UTC), "reader": self.reader, "decision": decision}
        try:
            line = LINE.dump_json(LINE.validate_python({**of, **written, "text": text}))
        except ValueError as exc:
            raise UsageError(
                f"nothing was noted: a note has up to {LONGEST_TEXT:,} characters, and is of a "
                "trial, or of a decision: side left or right, and a number"
            ) from exc
        try:
            with self.path.open("ab+") as file:
                fcntl.flock(file, fcntl.LOCK_EX)  # against another explorer
                size = file.seek(0, os.SEEK_END)
                torn = size > 0 and os.pread(file.fileno(), 1, size - 1) != b"\n"
                file.write((b"\n" if torn else b"") + line + b"\n")
                file.flush()
                os.fsync(file.fileno())
        except OSError as exc:
            raise UsageError(f"nothing was noted: {self.path}: {exc.strerror}") from exc


@lru_cache(1)
def _parsed(path: Path, _: tuple[int, ...]) -> StoredNotes:
    """Return the content of a file with this stamp; raises OSError."""
    notes, damage = [], []
    for number, line in enumerate(path.read_bytes().splitlines(), 1):
        try:
            if line.strip():
                notes.append(LINE.validate_json(line))
        except ValidationError:
            damage.append(f"line {number} of {path.name} is damaged, and is left out")
    tags = {
        (of.trial_id, of.spec_hash, tag) for of in notes for tag in TAG.findall(of.text.lower())
    }
    return StoredNotes(tuple(notes), tuple(damage), tuple(sorted(tags)))


def reader_of(given: str | None) -> str:
    """Return the reader's name: the given one, or the system's; raises UsageError."""
    try:
        name = " ".join((getpass.getuser() if given is None else given).split())
    except (KeyError, OSError):  # the system knows no name, as in some containers
        name = "reader"
    if not 0 < len(name) <= LONGEST_NAME:
        raise UsageError(f"--reader needs a name of up to {LONGEST_NAME} characters")
    return name
