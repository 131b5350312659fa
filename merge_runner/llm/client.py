"""Client for one model: returns the recorded reply to a prompt, or calls the API.

A stored reply is read from the cache. Otherwise the request joins the call under way for its key,
or starts a new call: it waits for admission, quarantines damaged entries, waits for the probe, and
repeats attempts until the model answers. The client reserves money for an attempt. A sender waits
for the rate limiter, makes the reservation durable, sends the request and judges the reply. The
client then books reply and cost.
"""

from __future__ import annotations

import asyncio
from contextlib import closing, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from functools import partial
from typing import TYPE_CHECKING

from merge_runner.drivers.language_model import Question
from merge_runner.errors import RecordingError, SweepStopped
from merge_runner.llm.attempts import Meter
from merge_runner.llm.budget import Budget, Reservation
from merge_runner.llm.cache import ResponseCache
from merge_runner.llm.call import LONG_WAIT_S, Call, Calls, Wait
from merge_runner.llm.delays import TryAgain, next_wait_s
from merge_runner.llm.endpoint_state import EndpointState
from merge_runner.llm.ledger import TOLERANCE_USD, CallLabel, reserved_usd_of
from merge_runner.llm.prices import attempt_usd, worst_case
from merge_runner.llm.recorded import RecordedReplies
from merge_runner.llm.sender import DirectSender, Sent
from merge_runner.llm.store import Attempts, CachedCall
from merge_runner.records import (
    SCRIPTED_HEADER,
    Attempt,
    CallFailed,
    ChatReply,
    ChatRequest,
    Decision,
    says_scripted,
)

if TYPE_CHECKING:
    from merge_runner.llm.batch.rounds import BatchSender

NO_ROOM = "calls: the cap leaves money for few trials at a time"
NO_MONEY = "until calls in flight are paid: the cap leaves no money for more at once"


@dataclass(slots=True)
class LlmClient:
    """Client of one model: returns its replies to prompts.

    ``direct`` sends normal requests, ``batch`` sends them in batches. ``calls`` are the run's
    calls. A call whose trials are all cancelled goes on if it may be billed, so that its reply is
    stored. Any other is cancelled. ``strict``: a reply of another model stops the sweep.
    """

    endpoint: EndpointState
    cache: ResponseCache
    direct: DirectSender
    budget: Budget
    batch: BatchSender | None = None
    strict: bool = False
    calls: Calls = field(default_factory=Calls)
    meter: Meter = field(default_factory=Meter)
    replies: RecordedReplies = field(init=False)
    _alone: asyncio.Lock = field(default_factory=asyncio.Lock)

    def __post_init__(self) -> None:
        endpoint, entry = self.endpoint, self.endpoint.entry
        self.replies = RecordedReplies(
            endpoint.name, entry, endpoint.identity, endpoint.wire, self.cache, self.meter
        )

    async def answer(self, question: Question, *, order: int = 0) -> Decision:
        """Return the decision of the model's reply; lower ``order`` is served first.

        Raises CallFailed, TrialSuspended, SweepStopped or UsageError.
        """
        prompt, request = self.replies.request_of(question)
        reply, attempts = None, None
        with suppress(RecordingError):  # damaged: no reply, and attempts stays None
            stored, attempts = self.cache.look_up(request.key, request)
            if stored:
                reply = self.replies.read(stored)
        if reply is None:
            reply = await self._join_or_start(request, order, attempts)
        self.replies.count_reply(reply, shared=request.key in self.calls.answered)
        served = reply.attempts[-1].model_served
        if self.strict and served not in self.replies.own_names:
            entry = self.endpoint.entry
            raise SweepStopped(
                f"{self.endpoint.driver}: {served} answered where {entry.id} was asked for, at "
                f"{question.slot}: leave --strict-model out, or name it in `aliases` of "
                f"{entry.place}"
            )
        return question.decision(prompt, reply)

    async def _join_or_start(
        self, request: ChatRequest, order: int, attempts: Attempts | None
    ) -> ChatReply:
        """Return the reply to a request, from the call under way for it or from a new call."""
        call = self.calls.under_way.get(request.key)
        is_shared = call is not None and not call.given_up
        if call is None or not is_shared:
            call = self._start(request, order, attempts)
        call.trials.append(order)
        call.order = min(call.order, order)
        if is_shared:
            self.budget.queue.reorder()
        try:
            # Shielded: the call may be paid for already when its trial is cancelled.
            reply = await asyncio.shield(call.task)
        except CallFailed as failed:
            if not is_shared:
                raise
            attempts = failed.attempts
            raise CallFailed(str(failed), request, attempts, len(attempts)) from failed
        finally:
            call.trials.remove(order)
            if call.trials:
                self.budget.queue.reorder()
            elif call.wait is not None and not call.wait.charged:
                call.give_up()  # it would take money for a trial that has ended
        # The attempts are counted once, for the first trial that asked.
        return reply._replace(cached_attempts=len(reply.attempts)) if is_shared else reply

    def _start(self, request: ChatRequest, order: int, earlier: Attempts | None) -> Call:
        entry = self.endpoint.entry
        worst, usd = worst_case(entry, request.body)
        label = CallLabel(self.endpoint.driver, str(request.slot), usd)
        call = Call(request, order, label, worst, entry.deadline_s, damaged=earlier is None)
        call.attempts, call.earlier_attempts = [*(earlier or ())], len(earlier or ())
        call.task = asyncio.create_task(self._run(call))
        self.calls.under_way[request.key] = call

        def forget(done: asyncio.Task[ChatReply]) -> None:
            if self.calls.under_way.get(request.key) is call:  # no new call has replaced it
                del self.calls.under_way[request.key]
            if not done.cancelled():
                done.exception()  # retrieved, since all who asked may be gone by now

        call.task.add_done_callback(forget)
        return call

    async def _run(self, call: Call) -> ChatReply:
        """Admit a call's trial and make attempts; the first normal call of a run is a probe."""
        if self.batch is not None:
            call.pending_batch = self.batch.rounds.pending.get(call.request.key)
        if call.pending_batch:
            self.budget.readmit(call.order)
        has_cap = self.budget.ledger.cap is not None
        if has_cap and call.order not in self.budget.expected_usd:
            self.calls.wait(call, Wait(NO_ROOM, blocked=True))
            await self.budget.admit(call.trials)
            call.wait = None
        if call.damaged:
            await self._quarantine(call)
        if call.pending_batch:  # its attempt there is not over
            end = call.pending_batch.note.lines[call.request.key]
            call.attempts = [a for a in call.attempts if a.number < end]
            call.earlier_attempts = len(call.attempts)
        elif not self.endpoint.verified:
            return await self._probe(call)
        return await self._until_answered(call)

    async def _probe(self, call: Call) -> ChatReply:
        """Make a call alone until the first accepted reply, so that a wrong key costs one call."""
        self.calls.wait(call, Wait(f"for the first reply of {self.endpoint.driver}"))
        await self._alone.acquire()
        call.wait = None
        if self.endpoint.verified:
            self._alone.release()
            return await self._until_answered(call)
        call.is_probe = True
        note = asyncio.get_running_loop().call_later(LONG_WAIT_S, self._note_probe, call)
        is_released = True
        try:
            return await self._until_answered(call)
        except SweepStopped:
            is_released = False  # the next call would only be refused in the same way
            raise
        finally:
            note.cancel()
            if is_released:
                self._alone.release()

    def _note_probe(self, call: Call) -> None:
        driver, entry = self.endpoint.driver, self.endpoint.entry
        left = timedelta(seconds=entry.deadline_s - LONG_WAIT_S)
        last = f"after {call.last_failure}" if call.own_attempts else "nothing has come yet"
        self.meter.notes.append(
            f"{driver}: {call.label.slot}: the first call of this run waits for its reply "
            f"until {datetime.now(UTC) + left:%H:%M:%S} UTC, {last}"
        )

    async def _quarantine(self, call: Call) -> None:
        key = call.request.key
        for name in await self.cache.write(partial(self.cache.quarantine, key)):
            self.meter.damaged.append(name)
            self.meter.notes.append(
                f"{self.endpoint.driver}: {call.label.slot}: what is recorded is damaged; it is "
                f"quarantined as 'damaged {name}' in the cache, and asked again"
            )
        _, earlier = self.cache.look_up(key)
        call.attempts, call.earlier_attempts = [*earlier], len(earlier)

    async def _until_answered(self, call: Call) -> ChatReply:
        """Repeat attempts, with backoff, until the model answers or the deadline would pass."""
        try:
            return await self._attempt(call)
        except TryAgain as exc:
            failures = [exc]
        # Imported here, since most calls need no second attempt.
        from tenacity import AsyncRetrying, retry_if_exception_type

        async def next_attempt() -> ChatReply:
            if failures:
                raise failures.pop()
            return await self._attempt(call)

        again = AsyncRetrying(
            retry=retry_if_exception_type(TryAgain),
            wait=next_wait_s,
            stop=lambda state: state.upcoming_sleep >= call.left_s,
            sleep=partial(self._sleep, call),
            reraise=True,
        )
        try:
            return await again(next_attempt)
        except TryAgain as exc:
            raise self.endpoint.out_of_time(call, exc.delay_s or 0.0) from exc

    async def _sleep(self, call: Call, seconds: float) -> None:
        call.left_s -= seconds
        until = datetime.now(UTC) + timedelta(seconds=seconds)
        why = f"after {call.last_failure}"
        self.calls.wait(call, Wait(why, until))
        if seconds >= LONG_WAIT_S:
            self.meter.notes.append(
                f"{self.endpoint.driver}: {call.label.slot} waits until {until:%H:%M:%S} UTC {why}"
            )
        await asyncio.sleep(seconds)
        call.wait = None

    async def _attempt(self, call: Call) -> ChatReply:
        sender: DirectSender | BatchSender = self.direct
        if self.batch is not None and self.batch.takes(call):
            sender = self.batch
        key, worst_usd = call.request.key, call.label.worst_usd * sender.price_factor
        label = call.label._replace(worst_usd=worst_usd)
        if self.calls.stopping or not (call.trials or call.pending_batch):
            raise self.calls.given_up(call)
        if call.pending_batch:
            usd = reserved_usd_of(self.cache, key)  # by an earlier run, of any sweep
            reservation = Reservation(self.budget, call.order, key, label, usd, queued=False)
        else:
            call.wait = Wait(NO_MONEY, blocked=True)
            reservation = await self.budget.reserve(call.trials, key, label, is_probe=call.is_probe)
        number = len(call.attempts) + 1
        with closing(reservation):
            sent = await sender.send(call, number, reservation)
            cost_usd = attempt_usd(sent, call.worst, self.endpoint, sender.price_factor)
            attempt = self._record(call, number, sent, cost_usd, reservation.usd)
            attempts = tuple(call.attempts)
            error = sent.error or self.endpoint.error_of(call, sent.outcome)
            if error is not None:
                keep = partial(self.cache.keep_attempts, key, attempts)
                await reservation.book(attempt, keep)  # before the error, which may end the run
                raise error
            answered = CachedCall(call.request, attempts)
            self.calls.answered.add(key)  # before others can find the reply in the cache
            kept = await reservation.book(attempt, partial(self.cache.keep, answered))
        if kept is not answered:  # an import has stored another reply first, which is used
            return self.replies.read(kept)
        text = sent.outcome.reading.text
        return ChatReply(text, attempt.outcome, call.request, attempts, call.earlier_attempts)

    def _record(
        self, call: Call, number: int, sent: Sent, usd: float | None, reserved_usd: float
    ) -> Attempt:
        outcome, meter, endpoint = sent.outcome, self.meter, self.endpoint
        raw, reading = outcome.raw, outcome.reading
        attempt = Attempt(
            number=number,
            outcome=outcome.name,
            http_status=raw.status if raw else None,
            model_served=reading.model_served,
            finish_reason=reading.finish_reason,
            usage=reading.usage,
            reply=raw.body if raw else None,
            error=outcome.message,
            started_at=sent.began.isoformat(timespec="milliseconds"),
            latency_s=sent.took_s and round(sent.took_s, 4),
            cost_usd=usd,
            scripted=raw is not None
            and (SCRIPTED_HEADER in raw.headers or says_scripted(raw.body)),
            batch_id=sent.batch_id,
        )
        call.attempts.append(attempt)
        meter.outcomes[attempt.outcome] += 1
        meter.cost_usd += usd or 0.0
        meter.cost_unknown += usd is None
        if reading.service_tier in endpoint.underpriced_tiers:
            meter.underpriced[reading.service_tier] += 1
        # The reservation is 0 where a user has released it meanwhile.
        if reserved_usd and (usd or 0.0) > reserved_usd + TOLERANCE_USD:
            meter.notes.append(
                f"{endpoint.driver}: {call.label.slot}: the reply cost {usd:.4f} USD, and "
                f"{reserved_usd:.4f} were reserved for it: the server does not keep to the cap of "
                f"{endpoint.entry.max_output_tokens} output tokens. More is reserved from now on"
            )
        return attempt
