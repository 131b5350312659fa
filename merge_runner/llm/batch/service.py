"""What a batch mode is to a run: requests are submitted together, and their replies fetched."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Literal, Protocol

from merge_runner.errors import MergeRunnerError
from merge_runner.llm.http_outcome import RawReply
from merge_runner.records import ChatRequest

FailureKind = Literal["again", "smaller", "single", "quota", "refused", "lost"]
"""What to do after a failure.

``again``: the same once more, after a while. ``smaller``: wait until other batches have ended, or
submit fewer lines: too many tokens are enqueued. ``single``: ask the lines singly, since there is
no batch mode for them. ``quota`` and ``refused``: nothing at this endpoint will be answered, as the
same actions of an AttemptOutcome say. ``lost``: what became of the batch cannot be known, since its
server no longer has it, or answers with what cannot be read; its lines may have been charged.
"""


class BatchFailed(MergeRunnerError):
    """A batch mode did not do what it was asked.

    ``smaller`` and ``single`` come from ``submit`` and as the ``failure`` of a status (``single``
    also after results), ``lost`` from all other methods alone.
    ``delay_s`` is how long the server asks to wait. ``sent`` is False where certainly no batch was
    created; where it is True and ``kind`` is ``again``, there may be one all the same: look for it
    with ``find`` before the lines are submitted once more.
    """

    def __init__(
        self, kind: FailureKind, message: str, *, delay_s: float | None = None, sent: bool = True
    ) -> None:
        super().__init__(message)
        self.kind = kind
        self.delay_s = delay_s
        self.sent = sent


@dataclass(frozen=True, slots=True)
class BatchLine:
    """One request of a batch, known there by its key; ``attempt`` counts from 1, as for a call."""

    request: ChatRequest
    attempt: int = 1

    @property
    def key(self) -> str:
        """Its id there: 64 hexadecimal digits, as many characters as Anthropic takes."""
        return self.request.key


@dataclass(frozen=True, slots=True)
class BatchLimits:
    """The most that one batch takes: lines, and bytes as BatchService.size counts them."""

    lines: int
    size: int


@dataclass(frozen=True, slots=True)
class BatchStatus:
    """What became of a batch so far.

    ``ended``: there are results to fetch, perhaps not of all lines; also of one that expired or was
    cancelled. ``failed``: no line was asked and nothing is charged; ``failure`` says what to do.
    ``done`` of ``total`` lines have ended, None where the provider does not say. ``word`` is the
    provider's own for the state, ``message`` what it says beside it.
    """

    state: Literal["waiting", "ended", "failed"]
    word: str
    done: int | None = None
    total: int | None = None
    message: str = ""
    failure: FailureKind | None = None


@dataclass(frozen=True, slots=True)
class LineResult:
    """What became of one line.

    ``raw`` is what the plain endpoint would have replied, an answer (status 200) or an error, to be
    judged in the same way; None where the line was never asked and is not charged, since the batch
    expired or was cancelled before, as ``message`` says.
    """

    key: str
    raw: RawReply | None
    message: str = ""


@dataclass(frozen=True, slots=True)
class Found:
    """A batch that was submitted, and whose id was lost.

    ``sure`` is False where the provider does not tell one batch from another before it ends: then
    it may be somebody else's. It must not be cancelled; if none of its results has one of the keys
    it was another one, and ``find`` is to be asked once more without it.
    """

    batch_id: str
    sure: bool = True


class BatchService(Protocol):
    """The batch mode of one model at one endpoint; every method but ``size`` raises BatchFailed."""

    limits: BatchLimits

    def size(self, line: BatchLine) -> int:
        """How many bytes of a batch a line takes."""
        ...

    async def submit(self, lines: Sequence[BatchLine], mark: str) -> str:
        """Create a batch of lines with different keys, within the limits; returns its id.

        ``mark``, up to 64 letters, digits, _ and -, is attached where the provider takes a name.
        """
        ...

    async def find(
        self, mark: str, keys: Collection[str], *, since: datetime, known: Collection[str] = ()
    ) -> Found | None:
        """The batch that was submitted with a mark and keys, at ``since`` or later (UTC).

        ``known`` are ids of batches that are others. None: there is none. Raises BatchFailed with
        the kind ``lost`` where nobody can say.
        """
        ...

    async def status(self, batch_id: str) -> BatchStatus:
        """How far a batch is."""
        ...

    def results(self, batch_id: str) -> AsyncIterator[LineResult]:
        """The results of a batch that has ended, in any order, each key once.

        A line without a result was not asked. Results that cannot be read, not the second time
        either, are left out; after all others it raises BatchFailed with the kind ``single`` that
        says what was wrong. With ``again`` the connection was lost, or there are fewer results than
        the provider counts, a whole file of them perhaps: they can be read from the beginning. A
        provider may never show the others, so that the caller has to bound how long it asks.
        """
        ...

    async def cancel(self, batch_id: str) -> None:
        """Ask for the end of a batch, which then ends with the results that it has.

        One that has ended already stays as it is.
        """
        ...


def in_batches(
    lines: Iterable[BatchLine], limits: BatchLimits, size: Callable[[BatchLine], int]
) -> Iterator[list[BatchLine]]:
    """The lines in order, in as few batches as fit the limits."""
    batch: list[BatchLine] = []
    filled = 0
    for line in lines:
        taken = size(line)
        if batch and (len(batch) == limits.lines or filled + taken > limits.size):
            yield batch
            batch, filled = [], 0
        batch.append(line)
        filled += taken
    if batch:
        yield batch
