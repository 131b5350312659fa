"""Open batches: found, waited for, cancelled in time, and their results handed to their lines."""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import Awaitable, Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from functools import partial
from typing import TypeVar

from merge_runner.errors import EndpointRefused, MergeRunnerError, QuotaExhausted
from merge_runner.llm.batch.background import Background
from merge_runner.llm.batch.journal import Journal, OpenBatch, now
from merge_runner.llm.batch.lines import Line, LineEnd
from merge_runner.llm.batch.service import (
    BatchFailed,
    BatchService,
    BatchStatus,
    FailureKind,
    LineResult,
)

SHORTEST_POLL_S, LONGEST_POLL_S, POLL_SHARE = 0.25, 60.0, 0.1
# A creation whose answer was lost may be in effect only after this: gateways keep requests.
ARRIVAL_S = 30.0
# How old a batch may be; then it is cancelled, and what it has not answered is asked singly.
ROUND_DEADLINE_S = 7200.0
# How long a batch may take to end once it was asked to, and then to show its results.
ENDING_S = 3600.0
T = TypeVar("T")


@dataclass(slots=True, eq=False)
class Followed:
    """An open batch of which this process waits for ``lines``, by key.

    ``results`` are those that nobody has asked for yet. It is ``created`` once its id is known, and
    ``looked`` at once the provider was asked for its state, in vain perhaps.
    ``gone`` is the end of all lines that join it from then on; a batch that ``never_was`` has none.
    """

    batch: OpenBatch
    lines: dict[str, Line] = field(default_factory=dict)
    results: dict[str, LineResult] = field(default_factory=dict)
    seen: set[str] = field(default_factory=set)
    status: BatchStatus | None = None
    created: bool = False
    looked: bool = False
    fetching: bool = False
    gone: LineEnd | None = None
    never_was: bool = False
    keys: frozenset[str] = field(init=False)

    def __post_init__(self) -> None:
        self.keys = frozenset(self.batch.keys)

    def end(self, end: LineEnd) -> None:
        """End the lines that have not ended yet, and those that join it."""
        self.gone = end
        for line in self.lines.values():
            line.ends(end)
        self.lines.clear()

    @property
    def is_open(self) -> bool:
        """Whether it may bring results yet."""
        return self.gone is None and not self.never_was

    @property
    def age_s(self) -> float:
        """How long ago it was submitted."""
        return (datetime.now(UTC) - self.batch.since).total_seconds()


class Following:
    """Follows open batches; see Rounds for the fields.

    A batch that failed for its size is handed to ``split``, with the reason.
    """

    def __init__(
        self,
        journal: Journal,
        services: Mapping[str, BatchService],
        background: Background,
        *,
        submits: bool,
        free: Collection[str],
        split: Callable[[Followed, str], None],
        say: Callable[[str], None],
    ) -> None:
        self.batch_ended = asyncio.Event()
        self._journal = journal
        self._services = services
        self._background = background
        self._submits = submits
        self._free = free
        self._split = split
        self._say = say

    async def identified(self, followed: Followed, batch_id: str, *, sure: bool = True) -> None:
        """Note the id of a batch, which is known now."""
        followed.batch = replace(followed.batch, batch_id=batch_id, sure=sure)
        followed.created = True
        await self._journal.note(followed.batch)

    async def found(self, followed: Followed) -> bool:
        """Look for a batch whose id is not known; False: there is none."""
        batch = followed.batch
        found = await self._services[batch.model].find(
            batch.mark, batch.keys, since=batch.since, known=self._known_ids(followed)
        )
        if found is None:
            return False
        await self.identified(followed, found.batch_id, sure=found.sure)
        return True

    async def follow(self, followed: Followed) -> None:
        """Wait for the end of a batch, and hand its results out."""
        try:
            while await self._has_ended(followed) and not await self._handed_out(followed):
                # It was somebody else's.
                followed.fetching, followed.status = False, None
                batch = followed.batch
                others = (*batch.others, batch.batch_id)
                followed.batch = replace(batch, others=others, ended_at="")
                if not await self.found_patiently(followed):
                    followed.end(LineEnd(None, outcome="not_created", singly=True))
        except BatchFailed as exc:
            self.lost(followed, exc)
        finally:
            self.batch_ended.set()

    async def found_patiently(self, followed: Followed) -> bool:
        """Look for a batch, as ``found`` does, until its provider answers."""
        return await self._patiently(followed, partial(self.found, followed))

    async def arrived(
        self, followed: Followed, find: Callable[[Followed], Awaitable[bool]]
    ) -> bool:
        """Look for a batch until its creation, if it was ever sent, must be in effect."""
        waited_s = 0.0
        while not await find(followed):
            if waited_s >= ARRIVAL_S:
                return False
            pause_s = min(max(1.0, waited_s), ARRIVAL_S - waited_s)
            await self._background.rest(pause_s)
            waited_s += pause_s
        return True

    def _known_ids(self, followed: Followed) -> set[str]:
        """The ids of batches that are others than this one."""
        batch = followed.batch
        others = (each for each in self._journal.batches() if each.mark != batch.mark)
        own = {each.batch_id for each in others if each.sure} | self._journal.ended_ids()
        return (own | {*batch.others}) - {""}

    async def _has_ended(self, followed: Followed) -> bool:
        """Wait for the end of a batch; False where it failed as a whole."""
        status = followed.status or await self._look(followed)
        while status.state == "waiting":
            await self._cancel_in_time(followed)
            if _takes_too_long(followed.batch):
                batch = followed.batch
                why = f"the batch was cancelled at {batch.cancelled_at} and does not end"
                self._say(f"{batch.model}: {why}: its calls are asked singly")
                followed.end(
                    LineEnd(
                        batch.batch_id, outcome="no_result", message=why, unclear=True, singly=True
                    )
                )
                return False
            await self._background.rest(self._until_next_look_s(followed))
            status = await self._look(followed)
        if status.state == "ended":
            followed.fetching = True
            return True
        kind = status.failure or "again"
        if kind == "smaller":
            self._split(followed, status.message)
        else:
            batch = followed.batch
            followed.end(self.without_reply(batch, kind, status.message, "batch_failed"))
        return False

    async def _look(self, followed: Followed) -> BatchStatus:
        batch = followed.batch
        look = partial(self._services[batch.model].status, batch.batch_id)
        followed.status = await self._patiently(followed, look)
        followed.looked = True
        return followed.status

    def _until_next_look_s(self, followed: Followed) -> float:
        usual_s = min(LONGEST_POLL_S, max(SHORTEST_POLL_S, POLL_SHARE * followed.age_s))
        left_s = ROUND_DEADLINE_S - followed.age_s
        if followed.batch.cancelled_at or not followed.batch.sure:
            return usual_s
        return max(SHORTEST_POLL_S, min(usual_s, left_s))

    async def _cancel_in_time(self, followed: Followed) -> None:
        if followed.batch.cancelled_at or not followed.batch.sure:
            return
        if followed.age_s < ROUND_DEADLINE_S:
            return
        batch = followed.batch
        await self._patiently(followed, partial(self._services[batch.model].cancel, batch.batch_id))
        followed.batch = replace(batch, cancelled_at=now())
        await self._journal.note(followed.batch)
        self._say(
            f"{batch.model}: batch {batch.batch_id} has waited for "
            f"{duration(followed.age_s)} and is cancelled: what it has answered is taken, the "
            "rest is asked singly"
        )

    async def _handed_out(self, followed: Followed) -> bool:
        """Hand the results of a batch out; False where it was somebody else's."""
        batch, left_out = followed.batch, ""
        began_s = asyncio.get_running_loop().time() - await self._ended_s_ago(followed)
        is_last = False
        for tries in itertools.count(1):
            try:
                async for result in self._services[batch.model].results(followed.batch.batch_id):
                    self._hand_out(followed, result)
                break
            except BatchFailed as exc:
                if exc.kind == "again" and not is_last:
                    await self._rest_after(followed, exc, tries)
                    if asyncio.get_running_loop().time() - began_s > ENDING_S:
                        await self._look(followed)  # after an outage all is asked for once more
                        is_last = True
                elif exc.kind in ("again", "single"):
                    left_out = str(exc)
                    self._say(f"{batch.model}: {exc}")
                    break
                else:
                    raise
        if not (followed.batch.sure or followed.seen or left_out):
            return False
        followed.end(
            LineEnd(
                followed.batch.batch_id,
                outcome="no_result",
                message=left_out or "the batch has ended without a result for it",
                # What a cancelled batch does not tell of was not asked, if all was read.
                unclear=bool(left_out) or not followed.batch.cancelled_at,
                singly=True,
            )
        )
        return True

    async def _ended_s_ago(self, followed: Followed) -> float:
        """How long ago a batch was first seen to have ended, by whatever process."""
        if not followed.batch.ended_at:
            followed.batch = replace(followed.batch, ended_at=now())
            await self._journal.note(followed.batch)
        return _s_ago(followed.batch.ended_at)

    def _hand_out(self, followed: Followed, result: LineResult) -> None:
        if result.key in followed.seen or result.key not in followed.keys:
            return
        followed.seen.add(result.key)
        line = followed.lines.pop(result.key, None)
        if line is None:
            followed.results[result.key] = result
        else:
            line.ends(answered(followed, result))

    def lost(self, followed: Followed, exc: BatchFailed) -> None:
        """Nobody knows what became of a batch: what was set aside for it stays so."""
        batch = followed.batch
        free = batch.model in self._free
        # A key that is refused is another account's, perhaps: there the batch goes on.
        gives_up = not self._submits and exc.kind not in ("refused", "quota")
        if free or gives_up:
            followed.end(
                LineEnd(batch.batch_id, outcome="batch_lost", message=str(exc), unclear=not free)
            )
            return
        error = EndpointRefused(
            f"{batch.model}: {batch.batch_id} is refused to this key ({exc}): set the key of the "
            "account that has submitted it. If it is gone, the same command without --batch asks "
            "its calls anew"
        )
        for line in followed.lines.values():
            line.fails(error)

    def without_reply(
        self, batch: OpenBatch, kind: FailureKind, message: str, outcome: str
    ) -> LineEnd:
        """The end of a line that the provider never took."""
        who = batch.model
        error: MergeRunnerError | None = None
        if kind == "single":
            told = counted(len(batch.keys))
            self._say(f"{who}: asked singly, at the full price: {told} ({message})")
        if kind == "quota":
            error = QuotaExhausted(
                f"{who}: the account's quota is exhausted ({message}). Every reply so far is "
                "saved; when there is credit again, run the same command to go on."
            )
        elif kind == "refused":
            error = EndpointRefused(f"{who}: its batch mode refuses: {message}")
        return LineEnd(
            batch.batch_id or None,
            outcome=outcome,
            message=message,
            singly=kind == "single",
            error=error,
        )

    async def _patiently(self, followed: Followed, ask: Callable[[], Awaitable[T]]) -> T:
        """Ask until a provider answers that may only be down; raises BatchFailed for anything else.

        A batch waits for a day: whoever waits for it can wait for its provider.
        """
        for tries in itertools.count(1):
            try:
                return await ask()
            except BatchFailed as exc:
                if exc.kind != "again":
                    raise
                await self._rest_after(followed, exc, tries)
        raise AssertionError("unreachable: it counts for ever")

    async def _rest_after(self, followed: Followed, exc: BatchFailed, tries: int) -> None:
        """Rest before a provider is asked again; meanwhile nothing of the batch is on its way."""
        followed.looked = True
        fetching, followed.fetching = followed.fetching, False
        if tries == 1:
            self._say(f"{followed.batch.model}: {exc}; it is asked again until it answers")
        await self._background.rest(max(exc.delay_s or 0.0, backoff_s(tries)))
        followed.fetching = fetching


def answered(followed: Followed, result: LineResult) -> LineEnd:
    """What a result means for its line."""
    batch_id = followed.batch.batch_id
    if result.raw is None:
        return LineEnd(batch_id, outcome="expired", message=result.message, singly=True)
    return LineEnd(batch_id, result.raw, message=result.message)


def _takes_too_long(batch: OpenBatch) -> bool:
    """Whether a batch that was asked to end should have done so by now."""
    return bool(batch.cancelled_at) and _s_ago(batch.cancelled_at) > ENDING_S


def _s_ago(moment: str) -> float:
    return (datetime.now(UTC) - datetime.fromisoformat(moment)).total_seconds()


def backoff_s(tries: int) -> float:
    """How long to wait after so many tries."""
    return min(LONGEST_POLL_S, 0.5 * 2.0 ** min(tries, 10))


def counted(calls: int) -> str:
    """So many calls, for a reader."""
    return "1 call" if calls == 1 else f"{calls} calls"


def duration(seconds: float) -> str:
    """A duration for a reader, such as 1:05 h or 40 s."""
    if seconds < 60:
        return f"{seconds:.0f} s"
    minutes = timedelta(seconds=seconds) // timedelta(minutes=1)
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60}:{minutes % 60:02} h"
