"""Which calls wait in which batches: written before a batch is created, in the cache.

A process that is killed leaves here what the next one needs: the batch to look for, or to wait for,
and under which of its attempts each call waits there. One process at a time asks a model in a
cache, so that it knows all rows of its models once it has read them.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable
from functools import partial

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
    """The open batches of a cache, by mark, the oldest first; those that have ended are removed."""

    def __init__(self, cache: ResponseCache) -> None:
        self._cache = cache
        noted = []
        for name in cache.names(_BATCH):
            with contextlib.suppress(RecordingError, ValidationError):  # a damaged one is none
                noted.append(OpenBatch.model_validate_json(cache.read(name) or ""))
        noted.sort(key=lambda batch: batch.submitted_at)
        self.batches = {batch.mark: batch for batch in noted}
        if ended := [batch.mark for batch in noted if not self._waits(batch)]:
            cache.run_now([partial(cache.remove, _BATCH + mark) for mark in ended])
        for mark in ended:
            del self.batches[mark]

    def batch_of(self, key: str) -> OpenBatch | None:
        """Return where a call was submitted last; None: nowhere."""
        return next((each for each in reversed(self.batches.values()) if key in each.lines), None)

    async def note(
        self, batch: OpenBatch, begins: Callable[[str], bool] | None = None
    ) -> OpenBatch:
        """Note what is known of a batch by now; returns what is noted.

        That is of those of its calls alone which may begin, as ``begins``, an operation on the
        cache, says of the key of each; all is one transaction.
        """

        def operation() -> OpenBatch:
            noted = batch
            if begins is not None:
                with self._cache.money.transaction():
                    begun = {key: attempt for key, attempt in batch.lines.items() if begins(key)}
                noted = batch.model_copy(update={"lines": begun})
            self._cache.replace(_BATCH + batch.mark, noted.model_dump_json())
            return noted

        noted = self.batches[batch.mark] = await self._cache.write(operation)
        return noted

    def _waits(self, batch: OpenBatch) -> bool:
        """Whether a call of the batch waits there yet, and in no later one."""
        for key in (each for each in batch.lines if self.batch_of(each) is batch):
            try:
                tried = self._cache.unanswered(key)
                if batch.holds(key, tried) and self._cache.get(key) is None:
                    return True
            except RecordingError:
                return True  # whoever asks for the call will set what is damaged aside
        return False
