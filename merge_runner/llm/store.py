"""Store of recorded replies and their costs: one SQLite file, from which nothing is evicted.

An entry is a checksum, then the JSON of a request and all its attempts, the answering one last. It
is durable before a trial uses it: each group of writes is one synchronous SQLite transaction. The
file also holds the attempts of calls without an answer, the notes of batches, and damaged entries
in quarantine. Two of its tables are the ledgers of all sweeps: a reply and its cost are stored
together or not at all. A third table counts calls by request template.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import sqlite3
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Annotated, Any, Literal

import diskcache
from diskcache.core import MODE_RAW
from pydantic import ConfigDict, Field, TypeAdapter, ValidationError

from merge_runner.errors import CacheFailed, MergeRunnerError, RecordingError
from merge_runner.llm.cache_format import FAILURES, FILE, close_texts, open_texts, prepare, unusable
from merge_runner.llm.durable import Execute, GroupWriter, ModelLocks, Operation, Rows, connect
from merge_runner.records import DAMAGED, Attempt, ChatRequest, check_call

if TYPE_CHECKING:
    from merge_runner.llm.templates import TemplateCounts

CHECKSUM_LENGTH = 32
Attempts = tuple[Attempt, ...]
ATTEMPTS = TypeAdapter(Attempts, config=ConfigDict(defer_build=True))  # few runs need it
# Prefixes of keys that are no call keys.
UNANSWERED, _DAMAGED = "attempts ", "damaged "
UNSEEN = "the run ended before a reply was seen; it may have been charged"
_GET = "SELECT mode, filename, value FROM Cache WHERE key = ? AND raw = 1"
# The rows of a call, and of its attempts in flight.
_LOOK_UP = """
SELECT key, mode, filename, value FROM Cache WHERE raw = 1 AND key IN (?1, ?2)
UNION ALL SELECT NULL, attempt, NULL, since FROM open WHERE call = ?1 AND outcome = 'in flight'
"""
_ADD = "INSERT INTO Cache (key, raw, mode, value) VALUES (?, 1, 1, ?) ON CONFLICT DO NOTHING"
_KEYS = """
SELECT CAST(key AS BLOB) FROM Cache WHERE typeof(key) = 'text' AND key >= ? AND key < ? ORDER BY key
"""


@dataclass(frozen=True, slots=True)
class CachedCall:
    """A recorded call: its request, and all attempts, the answering one last."""

    request: ChatRequest
    attempts: Annotated[Attempts, Field(min_length=1)]

    def to_json(self) -> str:
        """Return the entry as one JSON text."""
        return _STORED.dump_json(_Stored(1, self)).decode()

    @classmethod
    def from_json(cls, text: str) -> CachedCall:
        """Read an entry; raise RecordingError."""
        try:
            return _STORED.validate_json(text, strict=True).entry
        except ValidationError as exc:
            why = exc.errors()[0]["msg"]
            raise RecordingError(f"the recorded reply is damaged: {why}") from exc


@dataclass(frozen=True, slots=True)
class _Stored:
    """An entry as it lies in the cache."""

    version: Literal[1]
    entry: CachedCall


_STORED: TypeAdapter[_Stored] = TypeAdapter(_Stored)
Overlay = tuple[Mapping[str, CachedCall], "TemplateCounts"]
"""A recording: its entries by key, and their counts by request template."""


class CacheFile:
    """Open file of a cache folder, read directly and written by a thread in groups.

    ``locks`` keep other live runs from asking the same model. ``write`` runs an operation in the
    next durable transaction, and returns its future result. ``closing`` has what ``close`` closes.
    """

    def __init__(self, folder: Path, *, read_only: bool, allow_previous: bool) -> None:
        """Open or make the folder; ``read_only`` changes nothing in it, and it must exist.

        A folder of the previous format is upgraded, or read as it is if ``read_only`` and
        ``allow_previous``. Raises UsageError for a folder that cannot be used.
        """
        self.folder = folder
        self.locks = ModelLocks(folder)
        self.closing = ExitStack()
        self._writer = GroupWriter(self._run_each)
        self.closing.callback(self._writer.close, self._close_connection)
        self.write = self._writer.write
        self.summed: object = None  # ledger that has summed in this transaction
        try:
            prepare(folder, read_only=read_only, allow_previous=allow_previous)
            self._opened = self._file
            self._one_query = Lock()
            self.reading = connect(folder / FILE)
        except FAILURES as exc:
            raise unusable(self.folder, exc) from exc
        if read_only:
            self.texts = None

    @cached_property
    def texts(self) -> Any:  # noqa: ANN401 # diskcache ships no types
        """The folder's diskcache, opened by the first write.

        To open it takes a dozen durable writes, and a replay writes nothing. Raises UsageError, or
        FileNotFoundError for a file that was removed: diskcache would make another one.
        """
        self._require_file()
        try:
            return open_texts(self.folder)
        except FAILURES as exc:
            raise unusable(self.folder, exc) from exc

    def rows(self, sql: str, *values: object, execute: Execute | None = None) -> Rows:
        """Return the rows of a query; with ``execute``, as its transaction sees them.

        Raises CacheFailed, or RecordingError for invalid text.
        """
        try:
            if execute is not None:
                return execute(sql, values).fetchall()
            with self._one_query:
                return self.reading.execute(sql, values).fetchall()
        except FAILURES as exc:
            raise self.failure("read", exc) from exc

    def run_now(self, operations: Sequence[Operation]) -> list[Any]:
        """Run operations in one durable transaction, in this thread."""
        try:
            with self.texts.transact():
                execute, self.summed = self.texts._sql, None
                results = [operation(execute) for operation in operations]
                self._require_file()
                return results
        except (diskcache.Timeout, *FAILURES) as exc:
            # On a full disk SQLite rolls back: diskcache's ROLLBACK then fails, and hides why.
            hidden = exc.__context__ if isinstance(exc, sqlite3.Error) else None
            raise self.failure("written", hidden or exc) from exc

    def _run_each(self, operations: Sequence[Operation]) -> list[Any]:
        """Run operations in one durable transaction; if that fails, each in its own.

        The result of one that fails is its error.
        """
        try:
            return self.run_now(operations)
        except CacheFailed:
            raise
        except (MergeRunnerError, *DAMAGED) as exc:
            alone = len(operations) == 1
            return [exc] if alone else [self._run_each([operation])[0] for operation in operations]

    def close(self) -> None:
        """Close the folder and its recording, and free its locks."""
        self.closing.close()
        self.locks.close()
        self.reading.close()  # before ``texts``: the last to close ends the journal
        if (texts := vars(self).get("texts")) is not None:
            close_texts(texts)

    def _close_connection(self) -> None:
        """Close the writing thread's connection: a finished thread does not close it."""
        if (texts := vars(self).get("texts")) is not None:
            texts.close()

    def failure(self, done: str, why: BaseException) -> CacheFailed | RecordingError:
        """Return the error for a folder that cannot be read or written, or for invalid text."""
        if "utf-8" in str(why).lower():  # the only trace in SQLite's message
            return RecordingError("the recorded reply is damaged: it is no text")
        reason = f"cannot be {done}: {str(why) or 'another program writes'}"
        if self._file != self._opened:
            reason = "was removed, moved or replaced while it was in use"
        return CacheFailed(
            f"the cache {self.folder} {reason}. When that is mended, or a copy of it put back, "
            "run the same command again: what is in no cache is asked again"
        )

    def _require_file(self) -> None:
        if self._file != self._opened:
            raise FileNotFoundError("it is no longer there")

    @property
    def _file(self) -> tuple[int, int] | None:
        """Identity of the file in the folder: SQLite would go on with a deleted one."""
        with contextlib.suppress(OSError):
            status = os.stat(self.folder / FILE)
            return status.st_dev, status.st_ino
        return None


class CallStore(CacheFile):
    """Recorded calls in a cache folder, and texts under other names."""

    def __init__(
        self,
        folder: Path,
        *,
        overlay: Callable[[], AbstractContextManager[Overlay]] | None = None,
        read_only: bool = False,
        allow_previous: bool = False,
    ) -> None:
        """Open or make the folder; ``overlay`` opens a recording, which takes precedence."""
        super().__init__(folder, read_only=read_only, allow_previous=allow_previous)
        self._open_overlay = overlay

    @cached_property
    def recording(self) -> Overlay:
        """The recording, opened on first use."""
        opened = self._open_overlay
        return self.closing.enter_context(opened()) if opened else ({}, {})

    def get(self, key: str, request: ChatRequest | None = None) -> CachedCall | None:
        """Return the entry of a call, of the recording or else of the folder.

        Raises RecordingError where the folder's is damaged, or does not match the ``request``.
        """
        return self.recording[0].get(key) or self._entry(key, request)

    def in_recording(self, key: str) -> bool:
        """Return whether the recording holds an entry of a call key."""
        return key in self.recording[0]

    def look_up(
        self, key: str, request: ChatRequest | None = None
    ) -> tuple[CachedCall | None, Attempts]:
        """Return the entry of a call, or its attempts without an answer, also those in flight.

        Raises RecordingError where the folder's are damaged, or do not match the ``request``.
        """
        if call := self.recording[0].get(key):
            return call, ()
        rows = self.rows(_LOOK_UP, key, UNANSWERED + key)
        if not rows:
            return None, ()
        texts = {name: row for name, *row in rows if name is not None}
        if key in texts:
            return verified(key, text_of(*texts[key]), request), ()
        earlier = attempts_of(text_of(*texts[UNANSWERED + key])) if texts else ()
        begun = sorted(row for row in rows if row[0] is None and row[1] > len(earlier))
        unseen = (
            Attempt(number, "unknown", started_at=since, error=UNSEEN)
            for number, (*_, since) in enumerate(begun, len(earlier) + 1)
        )
        return None, (*earlier, *unseen)

    def read(self, name: str) -> str | None:
        """Return the text under a name, or None; raise RecordingError where it is damaged."""
        rows = self.rows(_GET, name)
        return text_of(*rows[0]) if rows else None

    def names(self, prefix: str) -> list[str]:
        """Return the names with a prefix; none is a call key."""
        rows = self.rows(_KEYS, prefix, prefix + chr(0x10FFFF))
        return [name.decode(errors="replace") for (name,) in rows]

    def keep(self, entry: CachedCall, execute: Execute) -> CachedCall:
        """Store an entry unless there is one, and return the stored one. Runs in a transaction.

        A damaged one is quarantined.
        """
        key, content = entry.request.key, entry.to_json()
        text = checksum(content) + content
        if not execute(_ADD, (key, text)).rowcount:
            try:
                (row,) = self.rows(_GET, key, execute=execute)  # it may be of this transaction
                return verified(key, text_of(*row))
            except RecordingError:
                self._quarantine_row(key, execute)
                execute(_ADD, (key, text))
        if len(entry.attempts) > 1:
            self.texts.delete(UNANSWERED + key)
        return entry

    def _quarantine_row(self, name: str, execute: Execute) -> None:
        """Rename a damaged row and keep its content. Runs in a transaction."""
        renamed = _DAMAGED + name
        if earlier := self.names(renamed):
            renamed += f" {len(earlier) + 1}"
        execute("UPDATE Cache SET key = ? WHERE key = ? AND raw = 1", [renamed, name])

    def _entry(self, key: str, request: ChatRequest | None = None) -> CachedCall | None:
        text = self.read(key)
        return None if text is None else verified(key, text, request)


def both(first: Operation, then: Operation, execute: Execute) -> Any:  # noqa: ANN401 # of any
    """Run two operations as one, and return the result of the first."""
    result = first(execute)
    then(execute)
    return result


def attempts_of(text: str) -> Attempts:
    """Return the attempts in a text; raise RecordingError where it is damaged."""
    try:
        return ATTEMPTS.validate_json(text)
    except ValidationError as exc:
        raise RecordingError("the list of earlier attempts is damaged") from exc


def verified(key: str, text: str, request: ChatRequest | None = None) -> CachedCall:
    """Return the entry in a row; raise RecordingError unless it belongs to its key."""
    entry = CachedCall.from_json(text)
    try:
        check_call(key, entry.request, entry.attempts, request)
    except DAMAGED as exc:
        raise RecordingError(f"the recorded reply is damaged: {exc}") from exc
    return entry


def checksum(text: str) -> str:
    """Return what stands before a text in its row."""
    return hashlib.sha256(text.encode()).hexdigest()[:CHECKSUM_LENGTH]


def text_of(mode: object, filename: object, value: object) -> str:
    """Return the text of a row, without its checksum.

    Raises RecordingError where it is damaged, or not written by merge-runner.
    """
    if filename is not None or mode != MODE_RAW:
        raise RecordingError(
            "the cache holds a pickle or names a file: merge-runner did not write it"
        )
    if not isinstance(value, str):
        raise RecordingError("the recorded reply is damaged: it is no text")
    content = value[CHECKSUM_LENGTH:]
    if value[:CHECKSUM_LENGTH] != checksum(content):
        raise RecordingError("the recorded reply is damaged: its checksum is wrong")
    return content
