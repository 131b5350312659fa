"""Rounds: what all trials ask now is submitted together, and each answer goes to who waits for it.

A round is closed when nothing can go on before an answer comes, so that all trials advance by one
decision at a time, and a sweep takes as many rounds as its longest trial has decisions. A line that
failed is in the next round again. The journal knows of a batch before its provider does: a call
that waits in an open batch is not asked anew, it joins those that wait there.
"""

from __future__ import annotations

import asyncio
import itertools
from collections import defaultdict
from collections.abc import Awaitable, Callable, Collection, Coroutine, Iterable, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from functools import partial
from typing import Any, Protocol, TypeVar

from merge_runner.errors import (
    EndpointRefused,
    MergeRunnerError,
    ProviderDown,
    QuotaExhausted,
    TrialSuspended,
    WaitingForBatches,
)
from merge_runner.llm.batch.journal import Journal, OpenBatch, OpenLine, mark_of, now
from merge_runner.llm.batch.service import (
    BatchFailed,
    BatchLine,
    BatchService,
    BatchStatus,
    FailureKind,
    LineResult,
    in_batches,
)
from merge_runner.llm.http_outcome import RawReply
from merge_runner.records import Attempt

USUAL_DEADLINE_S = 7200.0
# How often it is looked whether a round can be closed: what is seen then decides, not the time.
LOOK_S = 0.02
# A task that can go on shows that when the loop has come round once; a chain of them, soon after.
LOOKS = 5
SHORTEST_POLL_S, LONGEST_POLL_S, POLL_SHARE = 0.25, 60.0, 0.1
# A request that a process sent right before it died may be in effect only after this.
ARRIVAL_S = 3.0
NOBODY_S, OUTAGE_S = 5.0, 600.0
T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class LineEnd:
    """What became of a line.

    Without a ``raw`` reply ``outcome`` names why, and nothing was charged unless it is ``unclear``.
    Then it is asked again: ``singly`` or in another batch. An ``error`` ends the sweep.
    """

    batch_id: str | None
    raw: RawReply | None = None
    outcome: str = ""
    message: str = ""
    unclear: bool = False
    singly: bool = False
    error: MergeRunnerError | None = None


class Money(Protocol):
    """The money of an attempt; see budget.PaidAttempt."""

    def set_aside(self, attempts: Sequence[Attempt]) -> bool:
        """An operation on the cache: the attempt begins, after these; False if a cap forbids it."""
        ...

    def begun(self) -> None:
        """What ``set_aside`` wrote is durable."""
        ...


@dataclass(slots=True, eq=False)
class Line:
    """An attempt that waits for a batch to be submitted, or to end; ``open`` where it is in one.

    ``model`` is its name in the registry, ``ledger`` that of its ``money``, ``attempts`` are those
    before it.
    """

    line: BatchLine
    model: str
    ledger: str
    money: Money
    attempts: tuple[Attempt, ...]
    open: OpenLine | None = None
    end: asyncio.Future[LineEnd] = field(init=False)

    @property
    def key(self) -> str:
        """That of its call."""
        return self.line.key

    def ends(self, end: LineEnd) -> None:
        """Tell who waits for it."""
        if not self.end.done():
            self.end.set_result(end)

    def fails(self, error: BaseException) -> None:
        """Raise this for who waits for it."""
        if not self.end.done():
            self.end.set_exception(error)


@dataclass(slots=True, eq=False)
class _Followed:
    """An open batch of which this process waits for ``lines``, by key.

    ``results`` are those that nobody has asked for yet. It is ``created`` once its id is known, and
    ``looked`` at once the provider was asked for its state, in vain perhaps.
    ``gone`` is the end of all lines that join it from then on; a batch that ``never_was`` has none.
    ``others`` are ids of batches that were taken for it.
    """

    batch: OpenBatch
    lines: dict[str, Line] = field(default_factory=dict)
    results: dict[str, LineResult] = field(default_factory=dict)
    seen: set[str] = field(default_factory=set)
    status: BatchStatus | None = None
    created: bool = False
    looked: bool = False
    fetching: bool = False
    sure: bool = True
    gone: LineEnd | None = None
    never_was: bool = False
    others: set[str] = field(default_factory=set)
    keys: frozenset[str] = field(init=False)

    def __post_init__(self) -> None:
        self.keys = frozenset(self.batch.keys)

    @property
    def is_open(self) -> bool:
        return self.gone is None and not self.never_was

    @property
    def age_s(self) -> float:
        return (datetime.now(UTC) - self.batch.since).total_seconds()


@dataclass(frozen=True, slots=True)
class BatchWays:
    """How a run uses batches: whether it ``submits`` any, or only takes what others have submitted.

    A batch is cancelled ``deadline_s`` after its submission. With ``detach`` the run ends when all
    that is left waits for batches. ``most_rounds`` is how many there are if no line fails.
    """

    submits: bool
    deadline_s: float
    detach: bool
    most_rounds: int


class Rounds:
    """The rounds of a run; ``services`` are the batch modes of its models, by registered name.

    Those that are ``free`` cost nothing.
    """

    def __init__(
        self,
        journal: Journal,
        services: dict[str, BatchService],
        ways: BatchWays,
        *,
        free: Collection[str] = (),
        say: Callable[[str], None],
    ) -> None:
        self.ways = ways
        self._free = free
        self._journal = journal
        self.services = services
        self._say = say
        self._forming: list[Line] = []
        self._followed: dict[str, _Followed] = {}
        self._most_lines: dict[str, int] = {}
        self._reached: set[str] = set()
        self._batch_ended = asyncio.Event()
        self._tasks: set[asyncio.Task[None]] = set()
        self._resting: set[asyncio.Task[Any] | None] = set()
        self._submitting = 0

    def open_line(self, key: str, attempts: Iterable[Attempt] = ()) -> OpenLine | None:
        """Where a call with these attempts waits already; None: nowhere that can be reached."""
        line = self._journal.line(key)
        if line is None or not line.goes_on(attempts):
            return None
        return line if self._known(line.mark) else None

    def ledger_of(self, line: OpenLine) -> str:
        """The ledger in which the money of an open line is set aside."""
        known = self._known(line.mark)
        assert known is not None
        return known.ledger

    async def ask(self, line: Line) -> LineEnd:
        """Wait for the end of a line, in the next round or where it waits already."""
        line.end = asyncio.get_running_loop().create_future()
        if line.open is None:
            self._forming.append(line)
        else:
            self._join(line, line.open)
        try:
            return await line.end
        finally:
            if line in self._forming:
                self._forming.remove(line)

    def ended(self, line: Line) -> None:
        """What came of a line is durable."""
        if line.open is not None:
            self._journal.line_ended(line.key, line.open)

    async def watch(self, is_idle: Callable[[], bool]) -> None:
        """Close each round when nothing else goes on; ``is_idle`` says whether that is so."""
        while True:
            await asyncio.sleep(LOOK_S)
            if not (self._forming or self.ways.detach):
                continue
            if await _is_settled(lambda: is_idle() and not self._hands_out):
                if self._forming:
                    self._close_round()
                elif not self._submitting:
                    self._detach()

    def standing(self) -> list[str]:
        """Which batches are waited for, a line each."""
        return [self._described(each) for each in self._followed.values() if each.is_open]

    async def close(self) -> None:
        """End the waiting; batches that are being submitted get their ids noted first."""
        for task in self._tasks:
            if task.get_name() == _POLLING or task in self._resting:
                task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await self._journal.tidy()

    @property
    def _hands_out(self) -> bool:
        """Whether results are on their way to lines: those of a batch, or of one not looked at."""
        return any(not each.looked or each.fetching for each in self._all() if each.is_open)

    def _known(self, mark: str) -> OpenBatch | None:
        if mark in self._followed:
            return self._followed[mark].batch
        batch = self._journal.batch(mark)
        return batch if batch is not None and batch.model in self.services else None

    def _service(self, batch: OpenBatch) -> BatchService:
        return self.services[batch.model]

    def _start(self, work: Coroutine[Any, Any, None], lines: Iterable[Line], name: str) -> None:
        """Do something in a task of its own; what it raises is raised for these lines."""
        task = asyncio.create_task(work, name=name)
        self._tasks.add(task)

        def done(task: asyncio.Task[None]) -> None:
            self._tasks.discard(task)
            error = None if task.cancelled() else task.exception()
            for line in list(lines) if error else ():
                line.fails(error)  # type: ignore[arg-type] # it is one, or there are no lines

        task.add_done_callback(done)

    async def _rest(self, seconds: float) -> None:
        """Sleep, so that nothing is lost by the end of the run."""
        task = asyncio.current_task()
        self._resting.add(task)
        try:
            await asyncio.sleep(seconds)
        finally:
            self._resting.discard(task)

    # A round.

    def _close_round(self) -> None:
        forming, self._forming = self._forming, []
        groups: defaultdict[tuple[str, str], dict[str, Line]] = defaultdict(dict)
        for line in forming:
            groups[line.model, line.ledger][line.key] = line
        for (model, _), lines in groups.items():
            service = self.services[model]
            limits = service.limits
            most = min(limits.lines, self._most_lines.get(model, limits.lines))
            waiting = [line.line for line in lines.values()]
            for part in in_batches(waiting, replace(limits, lines=most), service.size):
                together = [lines[each.key] for each in part]
                self._start(self._submit(together), together, _SUBMITTING)

    async def _submit(
        self, lines: Sequence[Line], *, salt: str = "", instead_of: Sequence[str] = ()
    ) -> None:
        self._submitting += 1
        try:
            followed = await self._noted(lines, salt, instead_of)
            if followed is None:
                return
            try:
                await self._create(followed)
            except BatchFailed as exc:
                await self._not_created(followed, exc)
                return
        finally:
            self._submitting -= 1
        self._start(self._follow(followed), followed.lines.values(), _POLLING)

    async def _noted(
        self, lines: Sequence[Line], salt: str, instead_of: Sequence[str]
    ) -> _Followed | None:
        """Note what is about to be submitted; None where no line of it may begin."""
        by_key = {line.key: line for line in lines if not line.end.done()}
        if not by_key:
            return None
        attempts = {key: line.line.attempt for key, line in by_key.items()}
        first = lines[0]
        batch = OpenBatch(
            mark=mark_of(attempts.items(), salt),
            model=first.model,
            endpoint=first.line.request.endpoint,
            ledger=first.ledger,
            number=1 + max(line.line.request.slot.decision for line in lines),
            submitted_at=now(),
            keys=tuple(by_key),
        )

        def begin(key: str) -> bool:
            line = by_key[key]
            return line.open is not None or line.money.set_aside(line.attempts)

        batch = await self._journal.submitting(batch, attempts, begin, instead_of)
        begun = {key: by_key.pop(key) for key in batch.keys}
        for line in begun.values():
            if line.open is None and not line.end.done():
                line.money.begun()
            line.open = OpenLine(batch.mark, line.line.attempt)
        for line in by_key.values():
            line.fails(TrialSuspended("another run spends from the same cap, and has used it up"))
        if not begun:
            return None
        followed = self._followed[batch.mark] = _Followed(batch, begun, looked=True)
        return followed

    async def _create(self, followed: _Followed) -> None:
        """Create a batch; where it may have been created already, look for it first."""
        batch, service = followed.batch, self._service(followed.batch)
        lines = [line.line for line in followed.lines.values()]
        began_s = _loop_s()
        for tries in itertools.count(1):
            try:
                if tries == 1 or not await self._found(followed):
                    await self._identified(followed, await service.submit(lines, batch.mark))
            except BatchFailed as exc:
                nobody = not exc.sent and batch.model not in self._reached
                patience_s = NOBODY_S if nobody else OUTAGE_S
                if exc.kind != "again" or _loop_s() - began_s > patience_s:
                    raise
                await self._rest(max(exc.delay_s or 0.0, _backoff_s(tries)))
            else:
                self._reached.add(batch.model)
                return

    async def _identified(self, followed: _Followed, batch_id: str) -> None:
        followed.batch = replace(followed.batch, batch_id=batch_id)
        followed.created = followed.looked = True
        await self._journal.note(followed.batch)

    async def _not_created(self, followed: _Followed, exc: BatchFailed) -> None:
        batch = followed.batch
        if exc.kind == "smaller":
            # Beside this: where a run is to detach, it does not wait for room.
            work = self._in_parts(followed, exc.delay_s, str(exc))
            self._start(work, list(followed.lines.values()), _SUBMITTING)
            return
        if exc.kind == "again":
            # It may be there all the same: the next run looks for it, and nothing is settled yet.
            for line in followed.lines.values():
                line.fails(
                    ProviderDown(
                        f"{batch.model}: no batch can be submitted ({exc}): nothing else is asked. "
                        "When the service answers again, run the same command"
                    )
                )
            return
        self._end_all(followed, self._without_reply(batch, exc.kind, str(exc), "not_created"))

    async def _in_parts(self, followed: _Followed, delay_s: float | None, why: str) -> None:
        """Submit the lines of a batch again, in halves, when there may be room for them."""
        batch, lines = followed.batch, list(followed.lines.values())
        followed.lines.clear()
        followed.never_was = True
        half = max(1, len(lines) // 2)
        self._most_lines[batch.model] = half
        self._say(f"{batch.model}: {len(lines)} calls go in smaller batches: {why}")
        await self._room(batch.model, delay_s)
        parts = [part for part in (lines[:half], lines[half:]) if part]
        for part in parts:
            # The row of the whole goes with the last part: until then it tells of the rest.
            old = [batch.mark] if part is parts[-1] else []
            await self._submit(part, salt=batch.mark, instead_of=old)

    async def _room(self, model: str, delay_s: float | None) -> None:
        """Wait until a batch of the model has ended, or for a while."""
        others = any(f.created and f.is_open and f.batch.model == model for f in self._all())
        self._batch_ended.clear()
        left_s = delay_s or (LONGEST_POLL_S if others else 1.0)
        while left_s > 0 and not self._batch_ended.is_set():
            await self._rest(min(left_s, 1.0))
            left_s -= 1.0

    def _all(self) -> Iterable[_Followed]:
        return self._followed.values()

    # An open batch.

    def _join(self, line: Line, where: OpenLine) -> None:
        followed = self._followed.get(where.mark)
        if followed is None:
            batch = self._journal.batch(where.mark)
            if batch is None:  # another process has seen its end just now
                line.ends(LineEnd(None, outcome="no_result", unclear=True, singly=True))
                return
            followed = self._followed[where.mark] = _Followed(batch)
            self._start(self._take_up(followed), followed.lines.values(), _POLLING)
        if followed.never_was:
            self._form_anew(line)
        elif line.key in followed.results:
            line.ends(_answered(followed, followed.results.pop(line.key)))
        elif followed.gone is not None:
            line.ends(followed.gone)
        else:
            followed.lines[line.key] = line

    async def _take_up(self, followed: _Followed) -> None:
        """Go on with a batch that an earlier run has submitted, or was about to."""
        followed.created = bool(followed.batch.batch_id)
        try:
            if followed.created or await self._find_in_time(followed):
                await self._follow(followed)
                return
        except BatchFailed as exc:
            self._lost(followed, exc)
            return
        followed.never_was = True
        for line in list(followed.lines.values()):
            self._form_anew(line)
        followed.lines.clear()

    async def _find_in_time(self, followed: _Followed) -> bool:
        """Look for a batch twice: its creation may come into effect after its process died."""
        if await self._find(followed):
            return True
        await self._rest(ARRIVAL_S)
        return await self._find(followed)

    def _form_anew(self, line: Line) -> None:
        """A line whose batch was never created goes with the next round."""
        if self.ways.submits:
            self._forming.append(line)
        else:
            line.ends(
                LineEnd(None, outcome="not_created", message="the run ended before", singly=True)
            )

    async def _found(self, followed: _Followed) -> bool:
        """Look for a batch whose id is not known; False: there is none."""
        batch = followed.batch
        found = await self._service(batch).find(
            batch.mark, batch.keys, since=batch.since, known=self._known_ids(followed)
        )
        if found is None:
            return False
        followed.sure = found.sure
        await self._identified(followed, found.batch_id)
        return True

    async def _find(self, followed: _Followed) -> bool:
        return await self._patiently(followed, partial(self._found, followed))

    def _known_ids(self, followed: _Followed) -> set[str]:
        """The ids of batches that are others than this one."""
        others = (each for each in self._journal.batches() if each.mark != followed.batch.mark)
        own = {batch.batch_id for batch in others} | self._journal.ended_ids()
        return (own | followed.others) - {""}

    async def _follow(self, followed: _Followed) -> None:
        """Wait for the end of a batch, and hand its results out."""
        try:
            while await self._has_ended(followed) and not await self._handed_out(followed):
                # It was somebody else's.
                followed.fetching = False
                followed.others.add(followed.batch.batch_id)
                if not await self._find(followed):
                    self._end_all(followed, LineEnd(None, outcome="not_created", singly=True))
        except BatchFailed as exc:
            self._lost(followed, exc)
        finally:
            self._batch_ended.set()

    def _lost(self, followed: _Followed, exc: BatchFailed) -> None:
        """Nobody knows what became of a batch: what was set aside for it stays so."""
        batch = followed.batch
        if batch.model in self._free or self.ways.deadline_s == 0:
            end = LineEnd(batch.batch_id, outcome="batch_lost", message=str(exc), unclear=True)
            self._end_all(followed, end)
            return
        error = EndpointRefused(
            f"{batch.model}: {batch.batch_id} is refused to this key ({exc}): set the key of the "
            "account that has submitted it. If it is gone, --round-deadline 0 asks its calls anew"
        )
        for line in followed.lines.values():
            line.fails(error)

    async def _has_ended(self, followed: _Followed) -> bool:
        """Wait for the end of a batch; False where it failed as a whole."""
        batch = followed.batch
        while True:
            if not followed.looked or followed.status is not None:
                followed.status = await self._patiently(
                    followed, partial(self._service(batch).status, followed.batch.batch_id)
                )
                followed.looked = True
            else:
                followed.status = BatchStatus("waiting", "submitted")
            if followed.status.state != "waiting":
                break
            await self._cancel_in_time(followed)
            await self._rest(self._until_next_look_s(followed))
        if followed.status.state == "ended":
            followed.fetching = True
            return True
        kind, why = followed.status.failure or "again", followed.status.message
        if kind == "smaller":
            await self._in_parts(followed, None, why)
        else:
            self._end_all(followed, self._without_reply(batch, kind, why, "batch_failed"))
        return False

    def _until_next_look_s(self, followed: _Followed) -> float:
        usual_s = min(LONGEST_POLL_S, max(SHORTEST_POLL_S, POLL_SHARE * followed.age_s))
        left_s = self.ways.deadline_s - followed.age_s
        return usual_s if followed.batch.cancelled else max(SHORTEST_POLL_S, min(usual_s, left_s))

    async def _cancel_in_time(self, followed: _Followed) -> None:
        if followed.batch.cancelled or not followed.sure:
            return
        if followed.age_s < self.ways.deadline_s:
            return
        batch = followed.batch
        await self._patiently(followed, partial(self._service(batch).cancel, batch.batch_id))
        followed.batch = replace(batch, cancelled=True)
        await self._journal.note(followed.batch)
        self._say(
            f"{batch.model}: batch {batch.batch_id} has waited for "
            f"{_duration(followed.age_s)} and is cancelled: what it has answered is taken, the "
            "rest is asked singly"
        )

    async def _handed_out(self, followed: _Followed) -> bool:
        """Hand the results of a batch out; False where it was somebody else's."""
        batch, left_out = followed.batch, ""
        tries = itertools.count(1)
        while True:
            try:
                async for result in self._service(batch).results(followed.batch.batch_id):
                    self._hand_out(followed, result)
                break
            except BatchFailed as exc:
                if exc.kind == "again":
                    await self._rest(exc.delay_s or _backoff_s(next(tries)))
                elif exc.kind == "single":
                    left_out = str(exc)
                    self._say(f"{batch.model}: {exc}")
                    break
                else:
                    raise
        if not followed.sure and not followed.seen:
            return False
        message = left_out or "the batch has ended without a result for it"
        end = LineEnd(
            followed.batch.batch_id, outcome="no_result", message=message, unclear=True, singly=True
        )
        self._end_all(followed, end)
        return True

    def _hand_out(self, followed: _Followed, result: LineResult) -> None:
        if result.key in followed.seen or result.key not in followed.keys:
            return
        followed.seen.add(result.key)
        line = followed.lines.pop(result.key, None)
        if line is None:
            followed.results[result.key] = result
        else:
            line.ends(_answered(followed, result))

    def _end_all(self, followed: _Followed, end: LineEnd) -> None:
        """End the lines of a batch that have not ended yet, and those that join it."""
        followed.gone = end
        for line in followed.lines.values():
            line.ends(end)
        followed.lines.clear()

    def _without_reply(
        self, batch: OpenBatch, kind: FailureKind, message: str, outcome: str
    ) -> LineEnd:
        """The end of a line that the provider never took."""
        who = batch.model
        error: MergeRunnerError | None = None
        if kind == "single":
            self._say(
                f"{who}: {len(batch.keys)} calls are asked singly, at the full price: {message}"
            )
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

    async def _patiently(self, followed: _Followed, ask: Callable[[], Awaitable[T]]) -> T:
        """Ask until a provider answers that may only be down; raises BatchFailed for anything else.

        A batch waits for a day: whoever waits for it can wait for its provider.
        """
        for tries in itertools.count(1):
            try:
                return await ask()
            except BatchFailed as exc:
                if exc.kind != "again":
                    raise
                followed.looked = True
                if tries == 1:
                    model = followed.batch.model
                    self._say(f"{model}: {exc}; it is asked again until it answers")
                await self._rest(max(exc.delay_s or 0.0, _backoff_s(tries)))
        raise AssertionError("unreachable: it counts for ever")

    # What a user sees.

    def _detach(self) -> None:
        """End the run where all that is left waits for batches, each of which was looked at."""
        waiting = [each for each in self._all() if each.is_open]
        lines = [line for each in waiting for line in each.lines.values()]
        if not lines or not all(each.looked for each in waiting):
            return
        batches = f"{len(waiting)} batch{'es' * (len(waiting) > 1)}"
        told = "; ".join(map(self._described, waiting))
        lines[0].fails(
            WaitingForBatches(
                f"{len(lines)} calls wait in {batches}: {told}. Nothing is lost: the same command "
                "goes on"
            )
        )

    def _described(self, followed: _Followed) -> str:
        batch, status = followed.batch, followed.status
        most = max(self.ways.most_rounds, batch.number)
        done = (
            f", {status.done} of {status.total} done"
            if status is not None and status.done is not None and status.total
            else ""
        )
        where = f"in batch {batch.batch_id}" if batch.batch_id else "in a batch that is submitted"
        return (
            f"round {batch.number} of at most {most}: {len(batch.keys)} calls of {batch.model} "
            f"{where} since {batch.since:%H:%M:%S} UTC ({_duration(followed.age_s)}){done}"
        )


_SUBMITTING, _POLLING = "submitting", "polling"


def _answered(followed: _Followed, result: LineResult) -> LineEnd:
    batch_id = followed.batch.batch_id
    if result.raw is None:
        return LineEnd(batch_id, outcome="expired", message=result.message, singly=True)
    return LineEnd(batch_id, result.raw, message=result.message)


async def _is_settled(is_idle: Callable[[], bool]) -> bool:
    """Whether nothing goes on, and does not begin to when the loop comes round a few times."""
    for _ in range(LOOKS):
        if not is_idle():
            return False
        await asyncio.sleep(0)
    return is_idle()


def _backoff_s(tries: int) -> float:
    return min(LONGEST_POLL_S, 0.5 * 2.0 ** min(tries, 10))


def _loop_s() -> float:
    return asyncio.get_running_loop().time()


def _duration(seconds: float) -> str:
    """A duration for a reader, such as 1:05 h or 40 s."""
    if seconds < 60:
        return f"{seconds:.0f} s"
    minutes = timedelta(seconds=seconds) // timedelta(minutes=1)
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60}:{minutes % 60:02} h"
