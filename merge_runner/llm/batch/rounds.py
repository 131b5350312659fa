"""Rounds: what all trials ask now is submitted together, and each answer goes to who waits for it.

A round is closed when nothing can go on before an answer comes, so that all trials advance by one
decision at a time, and a sweep takes as many rounds as its longest trial has decisions. A line that
failed is asked singly. The journal knows of a batch before its provider does: a call
that waits in an open batch is not asked anew, it joins those that wait there.
"""

from __future__ import annotations

import asyncio
import itertools
import math
import secrets
from collections import defaultdict
from collections.abc import Awaitable, Callable, Collection, Coroutine, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from functools import partial
from typing import Any, Literal, TypeVar

from merge_runner.errors import (
    EndpointRefused,
    MergeRunnerError,
    ProviderDown,
    QuotaExhausted,
    TrialSuspended,
)
from merge_runner.llm.batch.journal import Journal, OpenBatch, OpenLine
from merge_runner.llm.batch.lines import Line, LineEnd
from merge_runner.llm.batch.service import (
    BatchFailed,
    BatchService,
    BatchStatus,
    FailureKind,
    LineResult,
    Unreadable,
)
from merge_runner.llm.http_outcome import backoff_s
from merge_runner.records import Attempt

# How often it is looked whether a round can be closed: what is seen then decides, not the time.
LOOK_S = 0.05
# A task that can go on shows that when the loop has come round once; a chain of them, soon after.
LOOKS = 5
# Fewer than any provider takes: one batch that is lost or late concerns no more calls.
MOST_CALLS = 5_000
SHORTEST_POLL_S, LONGEST_POLL_S, POLL_SHARE = 0.25, 60.0, 0.1
# A creation whose answer was lost may be in effect only after this: gateways keep requests.
ARRIVAL_S = 30.0
# How long the first creation of a run is tried again, and all others: the provider is there.
FIRST_S, OUTAGE_S = 60.0, 600.0
# How often a line may be refused for the size of its batch before it is asked singly.
MOST_REFUSALS = 5
# How old a batch may be; then it is cancelled, and what it has not answered is asked singly.
ROUND_DEADLINE_S = 7200.0
# How long a batch may take to end once it was asked to, and then to show its results.
ENDING_S = 3600.0
T = TypeVar("T")


@dataclass(slots=True, eq=False)
class Batch:
    """An open batch of which this process waits for ``lines``, by key.

    While it is "reading" results may be on their way to their calls; the calls of one that was
    "never" created go with the next round. ``results`` are those that nobody has asked for yet,
    ``seen`` hashes of all by key. ``rest`` is the end of the calls without a result, once the batch
    has ended. It ``is_broken`` where a result could not be used.
    """

    note: OpenBatch
    lines: dict[str, Line] = field(default_factory=dict)
    state: Literal["waiting", "reading", "never"] = "waiting"
    status: BatchStatus | None = None
    results: dict[str, LineResult] = field(default_factory=dict)
    seen: dict[str, int] = field(default_factory=dict)
    rest: LineEnd | None = None
    is_broken: bool = False

    @property
    def is_open(self) -> bool:
        """Whether it may bring results yet."""
        return self.rest is None and self.state != "never"

    @property
    def age_s(self) -> float:
        """How long ago it was submitted."""
        return _s_ago(self.note.submitted_at)

    def take(self, result: LineResult) -> bool:
        """Give a result to its call; False where it has none, or differs from the first one."""
        key, content = result.key, hash(result.raw and (result.raw.status, result.raw.body))
        if key not in self.note.lines or self.seen.setdefault(key, content) != content:
            return False
        if line := self.lines.pop(key, None):
            expired = "expired" if result.raw is None else ""
            line.ends(LineEnd(self.note.batch_id, result.raw, expired, result.message))
        elif key not in self.results:
            self.results[key] = result
        return True

    def end(
        self,
        outcome: str,
        message: str,
        *,
        unclear: bool = False,
        error: MergeRunnerError | None = None,
    ) -> None:
        """End the lines that have not ended yet, and those that join it; see LineEnd."""
        batch_id = self.note.batch_id or None
        self.rest = LineEnd(batch_id, None, outcome, message, unclear, error)
        for line in self.lines.values():
            line.ends(self.rest)
        self.lines.clear()

    def fail(self, error: Exception) -> None:
        """Raise an error for all who wait."""
        for line in self.lines.values():
            line.fails(error)


@dataclass(slots=True)
class Crowd:
    """A model of which a batch was too large: its batches go one after the other.

    The next one has at most ``calls`` calls. The last ``refusals`` batches were refused.
    """

    calls: int = MOST_CALLS
    refusals: int = 0


class Rounds:
    """The rounds of a run; ``services`` are the batch modes of its models, by registered name.

    A run that does not ``submits`` takes only what earlier runs have submitted. There are
    ``most_rounds`` if no line fails. Nobody charges for the models that are ``free``.
    """

    def __init__(
        self,
        journal: Journal,
        services: dict[str, BatchService],
        *,
        submits: bool,
        most_rounds: int,
        free: Collection[str] = (),
        say: Callable[[str], None],
    ) -> None:
        self.submits = submits
        self.services = services
        self._most_rounds = most_rounds
        self._journal = journal
        self._free = free
        self._say = say
        self._forming: list[Line] = []
        self._batches: dict[str, Batch] = {}
        self._tasks: set[asyncio.Task[None]] = set()
        self._creations: set[asyncio.Task[None]] = set()
        self._reached: set[str] = set()  # models of which a batch was created
        self._crowds: dict[str, Crowd] = {}

    def open_line(self, key: str, attempts: Iterable[Attempt] = ()) -> OpenLine | None:
        """Return where a call with these attempts waits; None: nowhere that can be reached."""
        line = self._journal.line(key)
        if line is None or not line.goes_on(attempts) or line.batch.model not in self.services:
            return None
        return line

    async def ask(self, line: Line) -> LineEnd:
        """Wait for the end of a line, in the next round or where it waits already."""
        line.end = asyncio.get_running_loop().create_future()
        if line.open is None:
            self._forming.append(line)
        else:
            self._join(line, line.open.batch)
        return await line.end

    async def watch(self, is_idle: Callable[[], bool]) -> None:
        """Close each round when nothing else goes on; ``is_idle`` says whether that is so."""
        while True:
            await asyncio.sleep(LOOK_S)
            for _ in range(LOOKS):
                await asyncio.sleep(0)
                reading = any(batch.state == "reading" for batch in self._open())
                if not self._forming or reading or not is_idle():
                    break
            else:
                self._close_round()

    def standing(self) -> list[str]:
        """Return which batches are waited for, a line each."""
        return [self._described(batch) for batch in self._open()]

    async def close(self) -> None:
        """End the waiting; batches that are being created get their ids noted first."""
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, *self._creations, return_exceptions=True)
        await self._journal.tidy()

    def _open(self, model: str | None = None) -> list[Batch]:
        """Return the batches that may bring results yet: they take room at their provider."""
        return [
            batch
            for batch in self._batches.values()
            if batch.is_open and model in (None, batch.note.model)
        ]

    def _close_round(self) -> None:
        groups: defaultdict[tuple[str, str], list[Line]] = defaultdict(list)
        for line in self._forming:
            groups[line.model, line.ledger].append(line)
        self._forming = []
        for (model, _), lines in groups.items():
            crowd = self._crowds.get(model)
            if crowd and self._open(model):
                self._forming += lines
                continue
            most = crowd.calls if crowd else MOST_CALLS
            parts = [*_parts(lines, self.services[model], most)]
            now, later = (parts[:1], parts[1:]) if crowd else (parts, [])
            for part in now:
                batch = _batch_of(part)
                self._start(self._begin(batch), batch)
            self._forming += itertools.chain.from_iterable(later)

    def _start(self, work: Coroutine[Any, Any, None], batch: Batch) -> None:
        """Do something for a batch in a task of its own; what it raises is raised for its lines."""

        async def do() -> None:
            try:
                await work
            except BatchFailed as exc:
                self._lost(batch, exc)
            except Exception as error:  # noqa: BLE001 # it reaches the calls
                batch.fail(error)

        task = asyncio.create_task(do())
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _begin(self, batch: Batch) -> None:
        """Note a batch with those of its lines that may begin, and submit it."""
        lines = batch.lines

        def begins(key: str) -> bool:
            line = lines[key]
            if line.end.done():  # nobody waits for it any more
                return False
            return line.open is not None or line.money.set_aside(line.attempts)

        batch.note = note = await self._journal.begin(batch.note, begins)
        for key, line in [*lines.items()]:
            if key not in note.lines:
                why = "another run spends from the same cap, and has used it up"
                lines.pop(key).fails(TrialSuspended(why))
                continue
            if line.open is None and not line.end.done():
                line.money.begun()
            line.open = OpenLine(note, line.line.attempt)
        if lines:
            self._batches[note.mark] = batch
            await self._submit(batch)

    async def _submit(self, batch: Batch) -> None:
        """Create a batch, and follow it to its end."""
        model = batch.note.model
        patience_s = OUTAGE_S if model in self._reached else FIRST_S
        try:
            await self._patiently(batch, partial(self._create, batch), patience_s)
        except BatchFailed as exc:
            if exc.kind == "lost" and not self.services[model].takes_mark:
                batch.end("batch_lost", str(exc), unclear=True)
            elif exc.kind in ("again", "lost"):
                # It may be there all the same: the next run looks for it, and nothing is settled.
                why = (
                    f"{model}: no batch can be submitted ({exc}): nothing else is asked. "
                    "When the service answers again, run the same command"
                )
                batch.fail(ProviderDown(why))
            elif exc.kind == "single" and model not in self._reached:
                why = f"{model}: there is no batch mode there ({exc}): leave --batch out"
                batch.end("not_created", why, error=EndpointRefused(why))
            else:
                await self._not_asked(batch, exc, "not_created")
            return
        self._reached.add(model)
        await self._follow(batch)

    async def _create(self, batch: Batch) -> None:
        """Create a batch; where its answer is lost, look for it."""
        service = self.services[batch.note.model]

        async def create() -> None:
            lines = [line.line for line in batch.lines.values()]
            await self._note(batch, batch_id=await service.create(lines, batch.note.mark))

        creation = asyncio.create_task(create())
        self._creations.add(creation)
        creation.add_done_callback(self._creations.discard)
        try:
            await asyncio.shield(creation)  # its id is noted even if the run ends now
        except BatchFailed as exc:
            if exc.sent and not service.takes_mark:
                raise BatchFailed("lost", f"whether it was created is not known ({exc})") from exc
            if not (exc.sent and await self._arrived(batch)):
                raise

    async def _note(self, batch: Batch, **known: object) -> None:
        batch.note = batch.note.model_copy(update=known)
        await self._journal.note(batch.note)

    async def _not_asked(self, batch: Batch, exc: BatchFailed, outcome: str) -> None:
        """End a batch of which the provider asks no line, or let its lines go in smaller ones."""
        model, lines = batch.note.model, len(batch.note.lines)
        error: MergeRunnerError | None = None
        match exc.kind:
            case "quota":
                error = QuotaExhausted(
                    f"{model}: the account's quota is exhausted ({exc}). Every reply so far is "
                    "saved; when there is credit again, run the same command to go on."
                )
            case "refused":
                error = EndpointRefused(f"{model}: its batch mode refuses: {exc}")
            case "smaller" | "again" if await self._try_smaller(batch, exc):
                return
            case _:
                self._say(f"{model}: asked singly, at the full price: {_counted(lines)} ({exc})")
        batch.end(outcome, str(exc), error=error)

    async def _try_smaller(self, batch: Batch, exc: BatchFailed) -> bool:
        """Let the lines of a batch go in the next ones, when there may be room for them.

        Returns False where one line was refused so often that there seems to be none.
        """
        model, lines = batch.note.model, len(batch.note.lines)
        if model not in self._crowds:
            self._say(f"{model}: {_counted(lines)} go in smaller batches: {exc}")
        crowd = self._crowds.setdefault(model, Crowd())
        if self._open(model) == [batch]:
            crowd.refusals += 1
            crowd.calls = max(1, lines // 2)
            if lines == 1 and crowd.refusals >= MOST_REFUSALS:
                return False
            # It counts as open, so that no other one is submitted meanwhile.
            await asyncio.sleep(max(exc.delay_s or 0.0, backoff_s(crowd.refusals)))
        self._form_anew(batch)
        return True

    def _join(self, line: Line, note: OpenBatch) -> None:
        batch = self._batches.get(note.mark)
        if batch is None:  # until it was looked at, its results may be there
            batch = self._batches[note.mark] = Batch(note, state="reading")
            self._start(self._take_up(batch), batch)
        batch.lines[line.key] = line
        if batch.state == "never":
            self._form_anew(batch)
        elif line.key in batch.results:
            batch.take(batch.results.pop(line.key))
        elif batch.rest is not None:
            batch.lines.pop(line.key).ends(batch.rest)

    async def _take_up(self, batch: Batch) -> None:
        """Go on with a batch that an earlier run has submitted, or was about to."""
        if not batch.note.batch_id and not self.services[batch.note.model].takes_mark:
            batch.end("batch_lost", "the run ended before its id was known", unclear=True)
        elif batch.note.batch_id or await self._arrived(batch):
            await self._follow(batch)
        else:
            self._form_anew(batch)

    def _form_anew(self, batch: Batch) -> None:
        """The lines of a batch that was never created go with the next round."""
        batch.state = "never"
        lines, batch.lines = batch.lines, {}
        for line in lines.values():
            if self.submits:
                self._forming.append(line)
            else:
                line.ends(LineEnd(outcome="not_created", message="the run ended before"))

    async def _arrived(self, batch: Batch) -> bool:
        """Look for a batch until its creation, if it was ever sent, must be in effect."""
        note, waited_s = batch.note, 0.0
        find = partial(self.services[note.model].find, note.mark, note.submitted_at)
        while (batch_id := await self._patiently(batch, find)) is None:
            if waited_s >= ARRIVAL_S:
                return False
            pause_s = min(max(1.0, waited_s), ARRIVAL_S - waited_s)
            await asyncio.sleep(pause_s)
            waited_s += pause_s
        await self._note(batch, batch_id=batch_id)
        return True

    async def _follow(self, batch: Batch) -> None:
        """Wait for the end of a batch, and hand its results out."""
        status = await self._ended(batch)
        if status.state == "ended":
            await self._hand_out(batch)
        elif status.state == "failed":
            failure = BatchFailed(status.failure or "again", status.message)
            await self._not_asked(batch, failure, "batch_failed")

    async def _ended(self, batch: Batch) -> BatchStatus:
        """Wait for the end of a batch, which is cancelled in time; not for ever after that."""
        service = self.services[batch.note.model]
        while (status := await self._look(batch)).state == "waiting":
            cancelled_at = batch.note.cancelled_at
            if cancelled_at is None and batch.age_s >= ROUND_DEADLINE_S:
                await self._patiently(batch, partial(service.cancel, batch.note.batch_id))
                await self._note(batch, cancelled_at=datetime.now(UTC))
                self._say(
                    f"{batch.note.model}: batch {batch.note.batch_id} has waited for "
                    f"{_duration(batch.age_s)} and is cancelled: what it has answered is taken, "
                    "the rest is asked singly"
                )
            elif cancelled_at and _s_ago(cancelled_at) > ENDING_S:
                moment = f"{cancelled_at:%Y-%m-%d %H:%M:%S} UTC"
                why = f"the batch was cancelled at {moment} and does not end"
                self._say(f"{batch.note.model}: {why}: its calls are asked singly")
                batch.end("no_result", why, unclear=True)
                break
            pause_s = min(LONGEST_POLL_S, POLL_SHARE * batch.age_s)
            await asyncio.sleep(max(SHORTEST_POLL_S, pause_s))
        return status

    async def _look(self, batch: Batch) -> BatchStatus:
        """Ask for the state of a batch; one that was seen to have ended has ended."""
        service = self.services[batch.note.model]
        status = await self._patiently(batch, partial(service.status, batch.note.batch_id))
        if batch.status is None or batch.status.state == "waiting" or status.state == "ended":
            batch.status = status
        batch.state = "reading" if batch.status.state == "ended" else "waiting"
        return batch.status

    async def _hand_out(self, batch: Batch) -> None:
        """Read the results of a batch until there is one for each call, or no more can be had."""
        ended_at = batch.note.ended_at or datetime.now(UTC)
        await self._note(batch, ended_at=ended_at)
        why, patience_s = "", max(0.0, ENDING_S - _s_ago(ended_at))
        try:
            await self._patiently(batch, partial(self._read, batch), patience_s)
        except BatchFailed as exc:
            if exc.kind not in ("again", "single"):
                raise
            why = str(exc)
            self._say(f"{batch.note.model}: {why}")
        # What a cancelled batch does not tell of was not asked, if all was read.
        unclear = bool(why) or batch.note.cancelled_at is None
        batch.end(
            "no_result", why or "the batch has ended without a result for it", unclear=unclear
        )
        if crowd := self._crowds.get(batch.note.model):
            crowd.calls, crowd.refusals = max(crowd.calls, 2 * len(batch.note.lines)), 0

    async def _read(self, batch: Batch) -> None:
        """Give each result to its call; raises BatchFailed where there should be others."""
        note, status = batch.note, await self._look(batch)
        foreign, wrong = 0, []
        results = self.services[note.model].results(note.batch_id, status, len(note.lines))
        async for result in results:
            if isinstance(result, Unreadable):
                wrong.append(result.why)
            else:
                foreign += not batch.take(result)
        if foreign:
            self._say(
                f"{note.model}: {foreign} results of batch {note.batch_id} are ignored: they are "
                "of none of its calls, or differ from an earlier one"
            )
        if len(batch.seen) == len(note.lines):
            return
        if wrong:  # one may have been broken on its way: all are read twice
            kind: FailureKind = "single" if batch.is_broken else "again"
            batch.is_broken = True
            which = "a result" if len(wrong) == 1 else f"{len(wrong)} results"
            raise BatchFailed(kind, f"{which} of the batch cannot be used: {wrong[0]}")
        if len(batch.seen) < status.results:
            raise BatchFailed(
                "again", f"{len(batch.seen)} of the {status.results} results are there"
            )

    def _lost(self, batch: Batch, exc: BatchFailed) -> None:
        """End a batch that cannot be read: what was set aside for it stays so."""
        note = batch.note
        # A key that is refused is another account's, perhaps: there the batch goes on.
        gives_up = not self.submits and exc.kind not in ("refused", "quota")
        if note.model in self._free or gives_up:
            batch.end("batch_lost", str(exc), unclear=True)
            return
        error = EndpointRefused(
            f"{note.model}: {note.batch_id} is refused to this key ({exc}): set the key of the "
            "account that has submitted it. If it is gone, the same command without --batch asks "
            "its calls anew"
        )
        batch.fail(error)

    async def _patiently(
        self,
        batch: Batch,
        ask: Callable[[], Awaitable[T]],
        patience_s: float = math.inf,
    ) -> T:
        """Ask until a provider answers that may only be down; raises BatchFailed for anything else.

        A batch waits for a day: whoever waits for it can wait for its provider.
        """
        clock_s = asyncio.get_running_loop().time
        began_s = clock_s()
        for tries in itertools.count(1):
            try:
                return await ask()
            except BatchFailed as exc:
                if exc.kind != "again" or clock_s() - began_s > patience_s:
                    raise
                # Meanwhile nothing of the batch is on its way.
                state, batch.state = batch.state, "waiting"
                if tries == 1:
                    self._say(f"{batch.note.model}: {exc}; it is asked again until it answers")
                await asyncio.sleep(max(exc.delay_s or 0.0, backoff_s(tries)))
                batch.state = state
        raise AssertionError("unreachable: it counts for ever")

    def _described(self, batch: Batch) -> str:
        note, status = batch.note, batch.status
        most = max(self._most_rounds, note.number)
        done = (
            f", {status.done} of {status.total} done"
            if status is not None and status.done is not None and status.total
            else ""
        )
        where = f"in batch {note.batch_id}" if note.batch_id else "in a batch that is submitted"
        return (
            f"round {note.number} of at most {most}: {_counted(len(note.lines))} of {note.model} "
            f"{where} since {note.submitted_at:%H:%M:%S} UTC ({_duration(batch.age_s)}){done}"
        )


def _batch_of(lines: Sequence[Line]) -> Batch:
    """A new batch of lines of one model, whose money is in one ledger."""
    note = OpenBatch(
        mark=secrets.token_hex(16),
        model=lines[0].model,
        ledger=lines[0].ledger,
        number=1 + max(line.line.request.slot.decision for line in lines),
        submitted_at=datetime.now(UTC),
        lines={line.key: line.line.attempt for line in lines},
    )
    return Batch(note, {line.key: line for line in lines})


def _parts(lines: Iterable[Line], service: BatchService, most: int) -> Iterator[list[Line]]:
    """The lines in order, in as few batches of at most so many as may be."""
    part: list[Line] = []
    filled = 0
    for line in lines:
        size = len(service.line(line.line)) + 1
        if part and (len(part) == most or filled + size > service.most_bytes):
            yield part
            part, filled = [], 0
        part.append(line)
        filled += size
    if part:
        yield part


def _s_ago(moment: datetime) -> float:
    return (datetime.now(UTC) - moment).total_seconds()


def _counted(calls: int) -> str:
    return "1 call" if calls == 1 else f"{calls} calls"


def _duration(seconds: float) -> str:
    """A duration for a reader, such as 1:05 h or 40 s."""
    if seconds < 60:
        return f"{seconds:.0f} s"
    minutes = timedelta(seconds=seconds) // timedelta(minutes=1)
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60}:{minutes % 60:02} h"
