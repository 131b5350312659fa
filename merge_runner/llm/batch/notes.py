"""Batches and their notes in the cache, by which the next run finds them."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Collection
from dataclasses import dataclass, field

from pydantic import AwareDatetime, BaseModel, ValidationError

from merge_runner.errors import MergeRunnerError, RecordingError, TrialSuspended
from merge_runner.llm.budget import Reservation
from merge_runner.llm.cache import ResponseCache
from merge_runner.llm.http_outcome import AttemptOutcome
from merge_runner.records import ChatRequest

# The prefix of names in the cache.
PREFIX = "batch "


class BatchNote(BaseModel, frozen=True):
    """Note of a batch that was created, or is about to be.

    ``mark`` is its name at the provider, ``batch_id`` its id there, empty until it is known.
    ``lines`` has the number of the attempt by the key of each call. ``model`` is its name in the
    registry. ``number`` counts the batches noted in a cache, since a clock may be set back between
    two of them; it is 0 in notes of versions that did not count. ``submitted_at`` is UTC.
    """

    mark: str
    model: str
    number: int = 0
    submitted_at: AwareDatetime
    lines: dict[str, int]
    batch_id: str = ""


@dataclass(slots=True, eq=False)
class Batch:
    """A batch and its results.

    ``work`` follows it to its end; None: no call of this run waits for it yet. ``results`` has the
    outcomes that are not taken yet, by key. All other requests have ``default``; None: they
    go into the next round. ``suspended`` has, by key, why no money was reserved for a request.
    An ``error`` ends the sweep.
    """

    note: BatchNote
    results: dict[str, AttemptOutcome] = field(default_factory=dict)
    default: AttemptOutcome | None = None
    suspended: dict[str, TrialSuspended] = field(default_factory=dict)
    error: MergeRunnerError | None = None
    work: asyncio.Task[None] | None = None


@dataclass(slots=True, eq=False)
class BatchRequest:
    """An attempt that waits for the next round; ``batch`` will be the one that it goes into."""

    request: ChatRequest
    number: int
    reservation: Reservation
    model: str
    batch: asyncio.Future[Batch]


def noted_batches(cache: ResponseCache, models: Collection[str]) -> tuple[dict[str, Batch], int]:
    """Return the noted batches of models by mark, the oldest first, and the last number of all."""
    notes = []
    for name in cache.names(PREFIX):
        with contextlib.suppress(RecordingError, ValidationError):  # a damaged note is ignored
            notes.append(BatchNote.model_validate_json(cache.read(name) or ""))
    notes.sort(key=lambda note: (note.number, note.submitted_at))
    batches = {note.mark: Batch(note) for note in notes if note.model in models}
    return batches, max((note.number for note in notes), default=0)
