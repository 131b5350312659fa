"""Cache folder: list, import and quarantine recorded calls; store other texts."""

from __future__ import annotations

import contextlib
import json
import operator
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing
from functools import partial
from itertools import islice
from pathlib import Path

from merge_runner.errors import RecordingError
from merge_runner.llm.cache_format import FAILURES, FOREIGN_KEY
from merge_runner.llm.durable import Execute, Operation
from merge_runner.llm.store import (
    ATTEMPTS,
    UNANSWERED,
    Attempts,
    CachedCall,
    CallStore,
    attempts_of,
    checksum,
    text_of,
    verified,
)
from merge_runner.records import DAMAGED, check_body

BATCH = 1_000
# A call's key has 64 characters, without a space; keys of another type are reported as damaged.
_IS_CALL = """(
typeof(key) != 'text' OR raw IS NOT 1 OR length(CAST(key AS BLOB)) = 64 AND NOT instr(key, ' ')
)"""
_CALLS = f"SELECT rowid FROM Cache NOT INDEXED WHERE {_IS_CALL}"  # noqa: S608 # constants
_NUMBER = f"SELECT count(*) FROM Cache WHERE {_IS_CALL}"  # noqa: S608 # constants
_NEWEST = """
SELECT CAST(key AS BLOB) FROM Cache NOT INDEXED WHERE typeof(key) = 'text' AND raw = 1
AND length(CAST(key AS BLOB)) = 64 AND NOT instr(key, ' ') ORDER BY rowid DESC LIMIT ?
"""
# One of the keys in a JSON array that no row has.
_MISSING = """
SELECT 1 FROM json_each(?) AS call
WHERE NOT EXISTS (SELECT 1 FROM Cache WHERE key = call.value AND raw = 1) LIMIT 1
"""
_CALL = "SELECT key, raw, mode, filename, value FROM Cache WHERE rowid = ?"


class ResponseCache(CallStore):
    """Calls of a cache folder and of a recording, and other texts in the folder."""

    def put_now(
        self,
        entries: Iterable[CachedCall],
        unanswered: Iterable[tuple[str, Attempts]] = (),
        money: Iterable[Operation] = (),
    ) -> list[CachedCall]:
        """Store entries, and attempts of calls without an answer, in one transaction here.

        The operations ``money`` book costs in the same transaction. Returns the stored entries,
        which may be earlier ones.
        """
        entries = list(entries)
        damaged = [partial(self.quarantine, entry.request.key) for entry in entries]
        kept = [partial(self.keep, entry) for entry in entries]
        others = [partial(self.remove, UNANSWERED + entry.request.key) for entry in entries]
        others += [partial(self.keep_attempts, *attempts) for attempts in unanswered]
        return self.run_now([*damaged, *kept, *others, *money])[len(damaged) :][: len(kept)]

    def add_missing(self, entries: Iterable[CachedCall]) -> tuple[int, int]:
        """Store the entries that the cache lacks; return (added, already present)."""
        added = seen = 0
        waiting = iter(entries)
        while batch := list(islice(waiting, BATCH)):
            added += sum(map(operator.is_, self.put_now(batch), batch))
            seen += len(batch)
        return added, seen - added

    def replace(self, name: str, text: str, _: Execute) -> None:
        """Store a text with its checksum; its name is no call key. Runs in a transaction."""
        self.texts.set(name, checksum(text) + text)

    def remove(self, name: str, _: Execute) -> None:
        """Delete the text under a name that is no call key. Runs in a transaction."""
        self.texts.delete(name)

    def keep_attempts(self, key: str, attempts: Attempts, execute: Execute) -> None:
        """Store the attempts of a call that has no answer yet. Runs in a transaction."""
        self.replace(UNANSWERED + key, ATTEMPTS.dump_json(attempts).decode(), execute)

    def entries(self, left_out: list[str] | None = None) -> Iterator[CachedCall]:
        """Yield all verified entries, of the folder and of the recording.

        Rows that are damaged, or not written by merge-runner, are left out; the reason is added to
        ``left_out``.
        """
        try:
            for row in self.reading.execute(_CALLS):
                try:
                    ((key, raw, *value),) = self.rows(_CALL, *row)
                    if not (raw and isinstance(key, str)):
                        raise RecordingError(FOREIGN_KEY)
                    entry = verified(key, text_of(*value))
                    check_body(entry.request.body)
                    yield entry
                except (RecordingError, *DAMAGED) as exc:
                    if left_out is not None:
                        left_out.append(str(exc))
        except FAILURES as exc:
            raise self.failure("read", exc) from exc
        yield from self.recording[0].values()

    def newest(self, most: int) -> Iterator[CachedCall]:
        """Yield the newest calls of the folder, the newest first; damaged ones are left out."""
        for (key,) in self.rows(_NEWEST, most):
            call = None
            with contextlib.suppress(RecordingError):
                call = self._entry(key.decode(errors="replace"))
            if call is not None:
                yield call

    def has_all(self, keys: Sequence[str]) -> bool:
        """Return whether the folder has the calls with these keys; damaged ones count."""
        return not self.rows(_MISSING, json.dumps(keys))

    @property
    def number(self) -> int:
        """Number of calls in the folder, including damaged ones."""
        return int(self.rows(_NUMBER)[0][0])

    def quarantine(self, key: str, execute: Execute) -> list[str]:
        """Quarantine a damaged entry or list of attempts, unchanged. Runs in a transaction.

        Returns the names of what was damaged.
        """
        damaged = []
        for name, check in ((key, partial(verified, key)), (UNANSWERED + key, attempts_of)):
            try:
                if (text := self.read(name)) is not None:
                    check(text)
            except RecordingError:
                damaged.append(name)
                self._quarantine_row(name, execute)
        return damaged


def import_folder(folder: Path, cache: ResponseCache) -> tuple[int, int]:
    """Add the replies of another folder that the cache lacks; return (added, already present).

    The folder is only read. Raises RecordingError after all others are added, if any was damaged.
    """
    left_out: list[str] = []
    with closing(ResponseCache(folder, read_only=True, allow_previous=True)) as source:
        added, known = cache.add_missing(source.entries(left_out))
    if left_out:
        raise RecordingError(
            f"{added} calls of {folder} added to {cache.folder}, {known} were there already, and "
            f"{len(left_out)} rows are left out, the first: {left_out[0]}"
        )
    return added, known
