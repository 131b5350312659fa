"""Which calls wait in which batches: written before a batch is created, in the cache.

A process that is killed leaves here what the next one needs: the batch to look for, or to wait for,
and under which of its attempts each call waits there. One process at a time asks a model in a
cache, so that it knows all rows of its models once it has read them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

from pydantic import AwareDatetime, BaseModel, ValidationError

from merge_runner.errors import RecordingError
from merge_runner.llm.cache import ResponseCache
from merge_runner.records import Attempt

# The prefix of names in the cache.
_BATCH = "batch "


class OpenBatch(BaseModel, frozen=True):
    """A batch that was created, or is about to be.

    ``mark`` is its name at the provider, ``batch_id`` its id, empty until the provider has told it.
    ``lines`` has the number of the attempt by the key of each call. ``model`` is its name in the
    registry, ``ledger`` that of the money. ``submitted_at`` is UTC.
    """

    mark: str
    model: str
    ledger: str
    submitted_at: AwareDatetime
    lines: dict[str, int]
    batch_id: str = ""

    def holds(self, key: str, attempts: Iterable[Attempt]) -> bool:
        """Whether its attempt at a call, as far as these tell, has not ended."""
        return all(each.number != self.lines[key] or each.outcome == "unknown" for each in attempts)


class Journal:
    """The open batches of a cache."""

    def __init__(self, cache: ResponseCache) -> None:
        self._cache = cache
        found = filter(None, map(self._read, cache.names(_BATCH)))
        ordered = sorted(found, key=lambda batch: batch.submitted_at)
        self._open = {batch.mark: batch for batch in ordered}

    def batches(self) -> list[OpenBatch]:
        """Return all open batches, the oldest first."""
        return [*self._open.values()]

    def batch_of(self, key: str) -> OpenBatch | None:
        """Return where a call was submitted last; None: nowhere."""
        return next((each for each in reversed(self._open.values()) if key in each.lines), None)

    def waits(self, batch: OpenBatch) -> bool:
        """Whether a call of the batch waits there yet, and in no later one."""
        return any(self.batch_of(key) is batch and self._waits(key, batch) for key in batch.lines)

    async def begin(self, batch: OpenBatch, begins: Callable[[str], bool]) -> OpenBatch:
        """Note that a batch is about to be created, with those of its calls that may begin.

        ``begins``, an operation on the cache, is told the key of each; all is one transaction.
        """

        def operation() -> OpenBatch:
            with self._cache.money.transaction():
                begun = {key: attempt for key, attempt in batch.lines.items() if begins(key)}
            taken = batch.model_copy(update={"lines": begun})
            if begun:
                self._write(taken)
            return taken

        taken = await self._cache.write(operation)
        if taken.lines:
            self._open[taken.mark] = taken
        return taken

    async def note(self, batch: OpenBatch) -> None:
        """Note what is known of a batch by now."""
        await self._cache.write(lambda: self._write(batch))
        self._open[batch.mark] = batch

    async def tidy(self) -> None:
        """Remove the batches of which no call waits any more."""

        def operation() -> None:
            for batch in self.batches():
                if not self.waits(batch):
                    self._cache.remove(_BATCH + batch.mark)

        if self._open:
            await self._cache.write(operation)

    def _waits(self, key: str, batch: OpenBatch) -> bool:
        try:
            return batch.holds(key, self._cache.unanswered(key)) and self._cache.get(key) is None
        except RecordingError:
            return True  # whoever asks for the call will set what is damaged aside

    def _read(self, name: str) -> OpenBatch | None:
        """Return the batch in a row; a damaged one is none."""
        try:
            return OpenBatch.model_validate_json(self._cache.read(name) or "")
        except (RecordingError, ValidationError):
            return None

    def _write(self, batch: OpenBatch) -> None:
        self._cache.replace(_BATCH + batch.mark, batch.model_dump_json())
