"""Which calls wait in which batches: written before a batch is asked for, in the cache.

A process that is killed leaves here what the next one needs: the batch to look for, or to wait for,
and under which of its attempts each call waits there.
"""

from __future__ import annotations

import secrets
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta

from pydantic import TypeAdapter, ValidationError

from merge_runner.errors import RecordingError
from merge_runner.llm.cache import ResponseCache
from merge_runner.records import Attempt

# Prefixes of names in the cache.
_BATCH, _LINE, _ENDED = "batch ", "line ", "ended batches"
# How long an ended batch may be mistaken for one whose id was lost.
REMEMBERED = timedelta(days=2)
MARK_BYTES = 16


@dataclass(frozen=True, slots=True)
class OpenLine:
    """Where a call waits: the mark of its batch, and the number of the attempt that it is there."""

    mark: str
    attempt: int

    def goes_on(self, attempts: Iterable[Attempt]) -> bool:
        """Whether that attempt, as far as these tell, has not ended."""
        return all(each.number != self.attempt or each.outcome == "unknown" for each in attempts)


@dataclass(frozen=True, slots=True)
class OpenBatch:
    """A batch that was submitted, or is about to be.

    ``mark`` is its name at the provider. ``batch_id`` is empty until the provider has told it, and
    may be somebody else's while it is not ``sure``; ``others`` are ids that turned out to be so.
    ``model`` is its name in the registry, ``ledger`` that of the money. ``number`` is the round:
    which decision its trials wait for at most, counted from 1. ``submitted_at``, ``cancelled_at``
    and ``ended_at`` are UTC in ISO 8601; empty: it was not asked to end, or not seen to have ended.
    """

    mark: str
    model: str
    endpoint: str
    ledger: str
    number: int
    submitted_at: str
    keys: tuple[str, ...]
    batch_id: str = ""
    sure: bool = True
    others: tuple[str, ...] = ()
    cancelled_at: str = ""
    ended_at: str = ""

    @property
    def since(self) -> datetime:
        """When it was submitted."""
        return datetime.fromisoformat(self.submitted_at)


_OPEN_BATCH, _OPEN_LINE = TypeAdapter(OpenBatch), TypeAdapter(OpenLine)
_TIMES = TypeAdapter(dict[str, str])


def new_mark() -> str:
    """A name for a batch that no other one has, of whatever run, at whatever provider."""
    return secrets.token_hex(MARK_BYTES)


class Journal:
    """The open batches of a cache, which several processes may share."""

    def __init__(self, cache: ResponseCache) -> None:
        self._cache = cache
        self._ended: list[tuple[str, OpenLine]] = []

    def line(self, key: str) -> OpenLine | None:
        """Where a call waits; None: nowhere. A damaged row is none."""
        try:
            text = self._cache.read(_LINE + key)
            return None if text is None else _OPEN_LINE.validate_json(text)
        except (RecordingError, ValidationError):
            return None

    def batch(self, mark: str) -> OpenBatch | None:
        """An open batch; None where there is none. A damaged row is none."""
        try:
            text = self._cache.read(_BATCH + mark)
            return None if text is None else _OPEN_BATCH.validate_json(text)
        except (RecordingError, ValidationError):
            return None

    def batches(self) -> list[OpenBatch]:
        """All open batches, the oldest first."""
        marks = (name.removeprefix(_BATCH) for name in self._cache.names(_BATCH))
        found = [batch for batch in map(self.batch, marks) if batch is not None]
        return sorted(found, key=lambda batch: batch.submitted_at)

    def waiting(self, batch: OpenBatch) -> list[str]:
        """The keys of a batch whose calls wait there yet."""
        lines = ((key, self.line(key)) for key in batch.keys)
        return [
            key
            for key, line in lines
            if line is not None and line.mark == batch.mark and self._is_open(key, line)
        ]

    async def submitting(
        self,
        batch: OpenBatch,
        attempts: dict[str, int],
        begin: Callable[[str], bool],
        instead_of: Collection[str] = (),
    ) -> OpenBatch:
        """Note that a batch is about to be submitted, with what of it may ``begin``.

        All in one transaction. It takes the place of the batches of the marks ``instead_of``.
        """

        def operation() -> OpenBatch:
            with self._cache.money.transaction():
                begun = tuple(key for key in batch.keys if begin(key))
            taken = replace(batch, keys=begun)
            for key in begun:
                line = OpenLine(batch.mark, attempts[key])
                self._cache.replace(_LINE + key, _OPEN_LINE.dump_json(line).decode())
            for mark in instead_of:
                self._cache.remove(_BATCH + mark)
            if begun:
                self._write(taken)
            return taken

        return await self._cache.write(operation)

    async def note(self, batch: OpenBatch) -> None:
        """Note what is known of a batch by now."""
        await self._cache.write(lambda: self._write(batch))

    def line_ended(self, key: str, line: OpenLine) -> None:
        """The attempt has ended; once that is durable, the row goes with the next ``tidy``."""
        self._ended.append((key, line))

    async def tidy(self) -> None:
        """Remove the rows of lines that have ended, and of batches where all have."""
        ended, self._ended = self._ended, []

        oldest = (datetime.now(UTC) - REMEMBERED).isoformat()

        def operation() -> None:
            times = self._ended_at()
            for key, line in ended:
                # It may wait in another batch by now, or what came of it could not be kept.
                if self.line(key) == line and not self._is_open(key, line):
                    self._cache.remove(_LINE + key)
            for batch in self.batches():
                if not self.waiting(batch):
                    self._cache.remove(_BATCH + batch.mark)
                    if batch.sure:
                        times[batch.batch_id] = batch.submitted_at
            recent = {each: at for each, at in times.items() if at >= oldest}
            self._cache.replace(_ENDED, _TIMES.dump_json(recent).decode())

        if ended or self.batches():
            await self._cache.write(operation)

    def ended_ids(self) -> set[str]:
        """The ids of batches that have ended of late."""
        return {*self._ended_at()}

    def _ended_at(self) -> dict[str, str]:
        try:
            return _TIMES.validate_json(self._cache.read(_ENDED) or "{}")
        except (RecordingError, ValidationError):
            return {}

    def _is_open(self, key: str, line: OpenLine) -> bool:
        try:
            return self._cache.get(key) is None and line.goes_on(self._cache.unanswered(key))
        except RecordingError:
            return True  # whoever asks for the call will set what is damaged aside

    def _write(self, batch: OpenBatch) -> None:
        self._cache.replace(_BATCH + batch.mark, _OPEN_BATCH.dump_json(batch).decode())


def now() -> str:
    """The present as a journal has it."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")
