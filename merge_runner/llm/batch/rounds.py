"""Rounds: what all trials ask now is submitted together, and each answer goes to who waits for it.

A round is closed when nothing can go on before an answer comes, so that all trials advance by one
decision at a time, and a sweep takes as many rounds as its longest trial has decisions. A line that
failed is in the next round again. The journal knows of a batch before its provider does: a call
that waits in an open batch is not asked anew, it joins those that wait there.
"""

from __future__ import annotations

import asyncio
import itertools
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import replace

from merge_runner.errors import EndpointRefused, ProviderDown, TrialSuspended
from merge_runner.llm.batch.background import Background
from merge_runner.llm.batch.following import (
    LONGEST_POLL_S,
    Followed,
    Following,
    answered,
    backoff_s,
    counted,
    duration,
)
from merge_runner.llm.batch.journal import Journal, OpenBatch, OpenLine, new_mark, now
from merge_runner.llm.batch.lines import Line, LineEnd
from merge_runner.llm.batch.service import BatchFailed, BatchService, BatchStatus, in_batches
from merge_runner.llm.http_outcome import NOBODY_S
from merge_runner.records import Attempt

# How often it is looked whether a round can be closed: what is seen then decides, not the time.
LOOK_S = 0.05
# A task that can go on shows that when the loop has come round once; a chain of them, soon after.
LOOKS = 5
# How long a creation is tried again, once the provider has answered any.
OUTAGE_S = 600.0
# How often a line that is alone in its batch may be refused for its size before it is asked singly.
MOST_REFUSALS = 5


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
        self._say = say
        self._background = Background()
        self._following = Following(
            journal,
            services,
            self._background,
            submits=submits,
            free=free,
            split=self._split,
            say=say,
        )
        self._forming: list[Line] = []
        self._followed: dict[str, Followed] = {}
        self._most_lines: dict[str, int] = {}
        self._too_large: set[str] = set()  # models of which the last batch was too large
        self._refusals: Counter[str] = Counter()  # of lines alone in their batches, by key
        self._reached: set[str] = set()

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

    def submitted_at(self, line: Line) -> str | None:
        """When the batch of a line was submitted, in UTC; None: it was in none."""
        known = None if line.open is None else self._known(line.open.mark)
        return None if known is None else known.submitted_at

    def ended(self, line: Line) -> None:
        """A line has ended, and what came of it was given to the cache to keep."""
        if line.open is not None:
            self._journal.line_ended(line.key, line.open)

    async def watch(self, is_idle: Callable[[], bool]) -> None:
        """Close each round when nothing else goes on; ``is_idle`` says whether that is so."""
        while True:
            await asyncio.sleep(LOOK_S)
            if not self._forming:
                continue
            if await _is_settled(lambda: is_idle() and not self._hands_out):
                self._close_round()

    def standing(self) -> list[str]:
        """Which batches are waited for, a line each."""
        return [self._described(each) for each in self._followed.values() if each.is_open]

    async def close(self) -> None:
        """End the waiting; batches that are being submitted get their ids noted first."""
        await self._background.close()
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
                self._background.start(self._submit(together), together)

    async def _submit(self, lines: Sequence[Line], *, instead_of: Sequence[str] = ()) -> None:
        followed = await self._noted(lines, instead_of)
        if followed is None:
            return
        try:
            await self._create(followed)
        except BatchFailed as exc:
            await self._not_created(followed, exc)
            return
        work = self._following.follow(followed)
        self._background.start(work, followed.lines.values(), reads=True)

    async def _noted(self, lines: Sequence[Line], instead_of: Sequence[str]) -> Followed | None:
        """Note what is about to be submitted; None where no line of it may begin."""
        by_key = {line.key: line for line in lines if not line.end.done()}
        if not by_key:
            return None
        attempts = {key: line.line.attempt for key, line in by_key.items()}
        first = lines[0]
        batch = OpenBatch(
            mark=new_mark(),
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
        followed = self._followed[batch.mark] = Followed(batch, begun, looked=True)
        return followed

    async def _create(self, followed: Followed) -> None:
        """Create a batch; where it may have been created already, look for it first."""
        batch, service = followed.batch, self.services[followed.batch.model]
        lines = [line.line for line in followed.lines.values()]
        began_s, sent = _loop_s(), False
        for tries in itertools.count(1):
            try:
                if not (sent and await self._following.arrived(followed, self._following.found)):
                    sent = False
                    batch_id = await service.submit(lines, batch.mark)
                    await self._following.identified(followed, batch_id)
            except BatchFailed as exc:
                sent = sent or exc.sent
                nobody = not exc.sent and batch.model not in self._reached
                patience_s = NOBODY_S if nobody else OUTAGE_S
                if exc.kind != "again" or _loop_s() - began_s > patience_s:
                    raise
                await self._background.rest(max(exc.delay_s or 0.0, backoff_s(tries)))
            else:
                self._reached.add(batch.model)
                self._fits(batch.model, len(lines))
                followed.status = BatchStatus("waiting", "submitted")
                return

    def _fits(self, model: str, lines: int) -> None:
        """A batch of so many lines was taken: the next one may have twice as many."""
        self._too_large.discard(model)
        if model in self._most_lines:
            self._most_lines[model] = max(self._most_lines[model], 2 * lines)

    async def _not_created(self, followed: Followed, exc: BatchFailed) -> None:
        batch = followed.batch
        if exc.kind == "smaller":
            self._split(followed, str(exc), exc.delay_s)
            return
        if exc.kind in ("again", "lost"):
            # It may be there all the same: the next run looks for it, and nothing is settled yet.
            for line in followed.lines.values():
                line.fails(
                    ProviderDown(
                        f"{batch.model}: no batch can be submitted ({exc}): nothing else is asked. "
                        "When the service answers again, run the same command"
                    )
                )
            return
        if exc.kind == "single" and batch.model not in self._reached:
            why = f"{batch.model}: there is no batch mode there ({exc}): leave --batch out"
            end = LineEnd(None, outcome="not_created", message=why, error=EndpointRefused(why))
        else:
            end = self._following.without_reply(batch, exc.kind, str(exc), "not_created")
        followed.end(end)

    def _split(self, followed: Followed, why: str, delay_s: float | None = None) -> None:
        """Submit the lines of a batch again, in halves, when there may be room for them."""
        batch, lines = followed.batch, list(followed.lines.values())
        if len(lines) == 1 and not self._has_open(batch.model):
            self._refusals[lines[0].key] += 1
            if self._refusals[lines[0].key] == MOST_REFUSALS:
                end = self._following.without_reply(batch, "single", why, "not_created")
                followed.end(end)
                return
        followed.lines.clear()
        followed.never_was = True
        if batch.model not in self._too_large:
            self._too_large.add(batch.model)
            self._say(f"{batch.model}: {counted(len(lines))} go in smaller batches: {why}")
        # Beside what calls this, and whose end may make room.
        self._background.start(self._in_halves(batch, lines, delay_s), lines)

    async def _in_halves(
        self, batch: OpenBatch, lines: Sequence[Line], delay_s: float | None
    ) -> None:
        half = max(1, len(lines) // 2)
        self._most_lines[batch.model] = half
        await self._room(batch.model, delay_s, self._refusals[lines[0].key])
        parts = [part for part in (lines[:half], lines[half:]) if part]
        for part in parts:
            # The row of the whole goes with the last part: until then it tells of the rest.
            old = [batch.mark] if part is parts[-1] else []
            await self._submit(part, instead_of=old)

    def _has_open(self, model: str) -> bool:
        """Whether a batch of the model takes room at its provider."""
        return any(f.created and f.is_open and f.batch.model == model for f in self._all())

    async def _room(self, model: str, delay_s: float | None, refusals: int) -> None:
        """Wait until a batch of the model has ended, or for a while."""
        self._following.batch_ended.clear()
        left_s = delay_s or (LONGEST_POLL_S if self._has_open(model) else backoff_s(refusals))
        while left_s > 0 and not self._following.batch_ended.is_set():
            await self._background.rest(min(left_s, 1.0))
            left_s -= 1.0

    def _all(self) -> Iterable[Followed]:
        return self._followed.values()

    def _join(self, line: Line, where: OpenLine) -> None:
        followed = self._followed.get(where.mark)
        if followed is None:
            batch = self._journal.batch(where.mark)
            if batch is None:  # another process has seen its end just now
                line.ends(LineEnd(None, outcome="no_result", unclear=True, singly=True))
                return
            followed = self._followed[where.mark] = Followed(batch)
            work = self._take_up(followed)
            self._background.start(work, followed.lines.values(), reads=True)
        if followed.never_was:
            self._form_anew(line)
        elif line.key in followed.results:
            line.ends(answered(followed, followed.results.pop(line.key)))
        elif followed.gone is not None:
            line.ends(followed.gone)
        else:
            followed.lines[line.key] = line

    async def _take_up(self, followed: Followed) -> None:
        """Go on with a batch that an earlier run has submitted, or was about to."""
        followed.created = bool(followed.batch.batch_id)
        try:
            following = self._following
            if followed.created or await following.arrived(followed, following.found_patiently):
                await self._following.follow(followed)
                return
        except BatchFailed as exc:
            self._following.lost(followed, exc)
            return
        followed.never_was = True
        for line in list(followed.lines.values()):
            self._form_anew(line)
        followed.lines.clear()

    def _form_anew(self, line: Line) -> None:
        """A line whose batch was never created goes with the next round."""
        if self.submits:
            self._forming.append(line)
        else:
            line.ends(
                LineEnd(None, outcome="not_created", message="the run ended before", singly=True)
            )

    def _described(self, followed: Followed) -> str:
        batch, status = followed.batch, followed.status
        most = max(self._most_rounds, batch.number)
        done = (
            f", {status.done} of {status.total} done"
            if status is not None and status.done is not None and status.total
            else ""
        )
        where = f"in batch {batch.batch_id}" if batch.batch_id else "in a batch that is submitted"
        return (
            f"round {batch.number} of at most {most}: {counted(len(batch.keys))} of {batch.model} "
            f"{where} since {batch.since:%H:%M:%S} UTC ({duration(followed.age_s)}){done}"
        )


async def _is_settled(is_idle: Callable[[], bool]) -> bool:
    """Whether nothing goes on, and does not begin to when the loop comes round a few times."""
    for _ in range(LOOKS):
        if not is_idle():
            return False
        await asyncio.sleep(0)
    return is_idle()


def _loop_s() -> float:
    return asyncio.get_running_loop().time()
