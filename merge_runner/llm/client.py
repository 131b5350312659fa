"""The client of one model: cache, then claim, then money, limiter, transport and record.

What an attempt means for its call is decided in consequences.py.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from functools import partial

from merge_runner.config import ModelEntry
from merge_runner.errors import (
    CallFailed,
    ModelSwapped,
    ProviderDown,
    RecordingError,
    SweepStopped,
)
from merge_runner.llm.batch.lines import Batches, LineEnd
from merge_runner.llm.budget import Unpaid
from merge_runner.llm.cache import CachedCall
from merge_runner.llm.call import Call, Wait, slot_text
from merge_runner.llm.consequences import Consequences
from merge_runner.llm.content_hashes import make_request
from merge_runner.llm.first_call import FirstCall
from merge_runner.llm.formats import FORMATS
from merge_runner.llm.formats.base import WireFormat
from merge_runner.llm.http_outcome import (
    AttemptOutcome,
    RawReply,
    is_web_page,
    judge,
    may_be_charged,
)
from merge_runner.llm.ledger import TOLERANCE_USD, Asked
from merge_runner.llm.meter import Meter
from merge_runner.llm.prices import cost_usd
from merge_runner.llm.retry import Deadline, OutOfTime, RequestFailed, retries
from merge_runner.llm.shared_services import (
    AttemptPort,
    BudgetPort,
    CachePort,
    RateLimitPort,
    Settle,
)
from merge_runner.llm.transport import Transport, TransportFailure
from merge_runner.llm.verify import reply_object
from merge_runner.records import (
    SCRIPTED_HEADER,
    Attempt,
    ChatReply,
    ChatRequest,
    Slot,
    Usage,
    says_scripted,
)
from merge_runner.served_model import is_other_model

# Beside a call that takes seconds this delay is nothing.
CLAIM_POLL_S = 0.1
# A shorter wait is over before a note of it is read.
LONG_WAIT_S = 5.0


@dataclass(slots=True)
class LlmClient:
    """Answers prompts of one model.

    ``endpoint`` is the identity that enters the keys. A call that is under way is shared by all
    who ask for the same key, and goes on when they are cancelled, so that what is paid for is
    kept; ``drain`` waits for it. ``budget`` is None for a model that costs nothing. ``first`` is
    the run's first call to the endpoint, which goes alone. ``sealed`` says that nothing may be
    asked anew; ``strict`` that an answer of another model stops the sweep. ``model`` is its name in
    the registry where ``name`` also tells its parameters. ``batches`` are those in which it may be
    asked, or where its calls may wait already.
    """

    name: str
    entry: ModelEntry
    endpoint: str
    cache: CachePort
    transport: Transport
    limiter: RateLimitPort
    budget: BudgetPort | None = None
    sealed: bool = False
    strict: bool = False
    model: str = ""
    first: FirstCall = field(default_factory=partial(FirstCall, passed=True))
    batches: Batches | None = None
    meter: Meter = field(default_factory=Meter)
    _calls: dict[str, Call] = field(default_factory=dict)
    _stopping: bool = False

    async def ask(self, prompt: str, slot: Slot, *, order: int = 0) -> ChatReply:
        """The model's reply for a slot; lower ``order`` is served first.

        Raises CallFailed, TrialSuspended or SweepStopped.
        """
        request = self._request(prompt, slot)
        if recorded := self._recorded(request):
            reply = self._read(recorded)
        elif call := self._calls.get(request.key):
            with call.asked_by_one():
                reply = await asyncio.shield(call.task)
            # The attempts are counted once, for whoever asked first.
            reply = replace(reply, earlier=len(reply.attempts))
        else:
            # Shielded: the call may be paid for already when its trial is cancelled.
            call = self._start(request, order)
            with call.asked_by_one():
                reply = await asyncio.shield(call.task)
        other_model = self._other_model(reply)
        self.meter.count_reply(reply, other_model)
        if self.strict and other_model is not None:
            raise ModelSwapped(
                f"{self.driver}: {other_model} answered where {self.entry.id} was asked for, at "
                f"{slot_text(slot)}; --strict-model stops the sweep. The reply is kept. To go on "
                "with it, leave --strict-model out, or name it in `aliases` in "
                "experiments/models.toml"
            )
        return reply

    async def drain(self) -> None:
        """Let attempts in flight end and be saved, and give up calls that wait for one."""
        self._stopping = True
        for call in self._calls.values():
            call.stop()
        tasks = [call.task for call in self._calls.values()]
        await asyncio.gather(*tasks, return_exceptions=True)

    def leave(self, order: int) -> None:
        """The trial of this order has ended, and needs no more money."""
        self._money.leave(order)

    @property
    def in_flight_calls(self) -> int:
        """How many calls are in flight or being saved."""
        return sum(call.wait is None for call in self._calls.values())

    @property
    def waits(self) -> list[Wait]:
        """What the other calls wait for."""
        return [call.wait for call in self._calls.values() if call.wait is not None]

    @property
    def idle_askers(self) -> int:
        """How many wait for calls that wait, themselves, for another's answer."""
        calls = self._calls.values()
        return sum(call.asking for call in calls if call.wait is not None and call.wait.idle)

    @property
    def _format(self) -> WireFormat:
        return FORMATS[self.entry.format]

    @property
    def driver(self) -> str:
        """Its name, with the endpoint where that is not the provider's own."""
        return self._consequences.driver

    def _recorded(self, request: ChatRequest) -> CachedCall | None:
        """The recorded call, None for a damaged one; in a replay that raises CallFailed."""
        try:
            return self.cache.get(request.key)
        except RecordingError as exc:
            if self.sealed:
                raise CallFailed(f"{self.name}: call {request.key}: {exc}", request) from exc
            return None

    def _other_model(self, reply: ChatReply) -> str | None:
        """Who answered, where it is another model than was asked for."""
        served = reply.attempts[-1].model_served
        return served if is_other_model(self.entry.id, served, self.entry.aliases) else None

    def _request(self, prompt: str, slot: Slot) -> ChatRequest:
        wire = self._format.request(self.entry, prompt)
        return make_request(
            provider=self.entry.provider,
            endpoint=self.endpoint,
            model=self.entry.id,
            path=wire.path,
            headers=wire.headers,
            body=wire.body,
            slot=slot,
        )

    def _start(self, request: ChatRequest, order: int) -> Call:
        worst = self._worst_case(request)
        worst_usd = cost_usd(self.entry, worst) or 0.0
        asked = Asked(self.driver, slot_text(request.slot), worst_usd, self.model or self.name)
        call = Call(request, order, asked, worst, self._stopping)
        call.task = asyncio.create_task(self._in_turn(call))
        self._calls[request.key] = call

        def forget(done: asyncio.Task[ChatReply]) -> None:
            del self._calls[request.key]
            if not done.cancelled():
                done.exception()  # retrieved, since all who asked may be gone by now

        call.task.add_done_callback(forget)
        return call

    async def _in_turn(self, call: Call) -> ChatReply:
        """Make a call when there is money for its trial, and the first call has been answered."""
        # Both before the claim: else another worker would wait for a call that waits here.
        opened = self.batches is not None and self.batches.takes_up(call)
        with call.waiting("for trials before it to end, under --max-cost", idle=True):
            await self._money.admit(call.order)
        if self.sealed:
            return await self._make(call)
        # Nobody waits for an answer that may take hours.
        alone, stopped = not opened and await self._goes_alone(call), False
        try:
            return await self._claimed(call)
        except SweepStopped:
            stopped = True  # the next call would only be refused in the same way
            raise
        finally:
            if alone and not stopped:
                self.first.give_turn()

    async def _goes_alone(self, call: Call) -> bool:
        """Wait for the first answer of the run; True if this call is to bring it."""
        if self.first.passed:
            return False
        with call.waiting(f"for the first answer of {self.driver}"):
            return await self.first.turn()

    async def _claimed(self, call: Call) -> ChatReply:
        """Claim a call, and make it unless it is recorded by now."""
        key = call.request.key
        while (known := await self.cache.claim(key)) is None:
            with call.waiting("for the same call, which is being made already", idle=True):
                await asyncio.sleep(CLAIM_POLL_S)
        try:
            for name in known.damaged:
                self.meter.damaged.append(name)
                self.meter.notes.append(
                    f"{self.driver}: {call.asked.slot}: what is recorded is damaged; it is set "
                    f"aside in the cache as 'damaged {name}', and asked again"
                )
            call.attempts = list(known.attempts)
            if self.batches is not None:
                call.open = self.batches.rounds.open_line(key, known.attempts)
            if call.open is not None:  # the attempt that has begun there is the one that goes on
                call.attempts = [each for each in call.attempts if each.number < call.open.attempt]
            call.earlier = len(call.attempts)
            # Whoever held the claim before may have made the call.
            return self._read(known.entry) if known.entry else await self._make(call)
        finally:
            self.cache.release(key)

    async def _make(self, call: Call) -> ChatReply:
        """Make attempts until one brings an answer, which is kept together with all of them."""
        call.began_s = asyncio.get_running_loop().time()
        deadline = Deadline(self.entry.deadline_s)

        async def sleep(seconds: float) -> None:
            until = datetime.now(UTC) + timedelta(seconds=seconds)
            with call.waiting(f"after {call.last_failure}", until) as wait:
                if seconds >= LONG_WAIT_S:
                    line = f"{wait.who} waits until {until:%H:%M:%S} UTC {wait.what}"
                    self.meter.notes.append(line)
                await asyncio.sleep(seconds)

        try:
            async for attempt in retries(deadline, sleep=sleep):
                with attempt:
                    return await self._attempt(call, deadline)
        except (OutOfTime, RequestFailed) as exc:
            why, made = f"{exc} ({call.last_failure})", len(call.own_attempts)
            if isinstance(exc, OutOfTime) and not self.first.passed:
                raise ProviderDown(
                    f"{self.driver}: {exc} to the first call of this run ({call.last_failure}), "
                    f"{made} attempts: nothing else is asked. When the service answers again, run "
                    "the same command"
                ) from exc
            raise call.failed(f"{self.name}: {why}, {made} attempts") from exc
        raise AssertionError("unreachable: the loop returns or raises")

    async def _attempt(self, call: Call, deadline: Deadline) -> ChatReply:
        """Make one attempt; returns its answer, which is kept, or raises what follows from it."""
        if self.batches is not None and (call.open or self._goes_in_batch(call)):
            return await self._attempt_in_batch(call, self.batches)
        async with self._permitted(call) as (paid, settle):
            await paid.begin(call.attempts)
            with deadline.attempt() as seconds_left:
                outcome, raw = await self._send(call, settle, seconds_left)
            return await self._concluded(call, paid, outcome, raw)

    async def _concluded(
        self, call: Call, paid: AttemptPort, outcome: AttemptOutcome, raw: RawReply | None
    ) -> ChatReply:
        """Keep what an attempt brought: its answer, or why there is none, which is raised."""
        self._tell_overrun(call, paid.aside_usd)
        error = self._consequences.error(call, outcome, raw)
        if error is None:
            kept = await paid.keep(CachedCall(call.request, tuple(call.attempts)))
            return self._answer(call, kept, outcome)
        self._pause(call, outcome)
        await paid.settle(call.attempts)  # before the error, which may end the whole run
        raise error

    def _goes_in_batch(self, call: Call) -> bool:
        """Whether the next attempt at a call goes with the next round."""
        return self.batches is not None and self.batches.rounds.submits and not call.singly

    async def _attempt_in_batch(self, call: Call, batches: Batches) -> ChatReply:
        """Make one attempt as a line of a batch; see ``_attempt``."""
        opened, call.open = call.open, None
        async with batches.attempt(call, opened) as (paid, line):
            with call.waiting(f"for batches of {batches.model}", idle=True):
                end = await batches.rounds.ask(line)
            record, outcome = self._line_record(call, end, batches.price_factor)
            record = replace(record, started_at=batches.rounds.submitted_at(line))
            call.attempts.append(record)
            call.singly = True
            self.meter.count_attempt(record)
            if end.error is None:
                return await self._concluded(call, paid, outcome, end.raw)
            await paid.settle(call.attempts)
            raise end.error

    def _line_record(
        self, call: Call, end: LineEnd, price_factor: float
    ) -> tuple[Attempt, AttemptOutcome]:
        """What came of a line: the attempt as it is recorded, and what it means."""
        number = len(call.attempts) + 1
        if end.raw is None:
            free = self.entry.price == "free" or not end.unclear
            outcome = AttemptOutcome("retry", end.outcome, end.message)
            record = Attempt(number, end.outcome, error=end.message, cost_usd=0.0 if free else None)
        else:
            # No limit of single calls is meant, and no call waits for one.
            outcome = replace(judge(end.raw, self._format), pause=False, delay_s=None)
            record = self._record(number, end.raw, outcome, call.worst)
            usd = record.cost_usd
            if end.raw.status != 200 and record.usage == Usage():
                usd = 0.0  # no line that failed is charged
            record = replace(record, cost_usd=None if usd is None else usd * price_factor)
        return replace(record, batch_id=end.batch_id), outcome

    @asynccontextmanager
    async def _permitted(self, call: Call) -> AsyncIterator[tuple[AttemptPort, Settle]]:
        """What an attempt needs before it is sent: its money, then its turn."""
        # A turn must be used as soon as it is given, or the limits do not hold.
        async with AsyncExitStack() as stack:
            with call.waiting("for calls in flight to be paid, under --max-cost", idle=True):
                paid = await stack.enter_async_context(
                    self._money.attempt(call.order, call.request.key, call.asked)
                )
            with call.waiting("for a turn under the rate limits"):
                settle = await self.limiter.acquire(_estimated_tokens(call.worst), order=call.order)
            yield paid, settle

    async def _send(
        self, call: Call, settle: Settle, seconds_left: float
    ) -> tuple[AttemptOutcome, RawReply | None]:
        """Send the request once, and add what came of it to the call's attempts."""
        number = len(call.attempts) + 1
        started_at, started = datetime.now(UTC), time.perf_counter()
        raw: RawReply | None = None
        try:
            raw = await self.transport.send(
                call.request, attempt=number, timeout_s=min(self.entry.timeout_s, seconds_left)
            )
            outcome = judge(raw, self._format)
            record = self._record(number, raw, outcome, call.worst)
            if record.usage.output_tokens is not None:
                settle((record.usage.input_tokens or 0) + record.usage.output_tokens)
        except TransportFailure as exc:
            outcome = AttemptOutcome(exc.action, exc.outcome, str(exc))
            free = self.entry.price == "free" or not exc.sent
            cost_usd = 0.0 if free else None
            record = Attempt(number, exc.outcome, error=str(exc), cost_usd=cost_usd)
        record = _timed(record, started_at, time.perf_counter() - started)
        call.attempts.append(record)
        self.meter.count_attempt(record)
        return outcome, raw

    def _pause(self, call: Call, outcome: AttemptOutcome) -> None:
        """Let all calls with the same API key wait, where the server asks for it."""
        pause_s = self._consequences.pause_s(call, outcome)
        if pause_s is None:
            return
        self.limiter.pause(pause_s)
        until = datetime.now(UTC) + timedelta(seconds=pause_s)
        self.meter.notes.append(
            f"{self.driver}: all its calls wait {pause_s:.1f} s, until {until:%H:%M:%S} UTC: "
            f"{outcome.message or outcome.name}"
        )

    def _tell_overrun(self, call: Call, aside_usd: float) -> None:
        spent_usd = call.attempts[-1].cost_usd or 0.0
        released = aside_usd == 0  # by a user, while a batch was waited for
        if released or spent_usd <= aside_usd + TOLERANCE_USD:
            return
        self.meter.notes.append(
            f"{self.driver}: {call.asked.slot}: the reply cost {spent_usd:.4f} USD, and "
            f"{aside_usd:.4f} were set aside for it: the server does not keep to the cap of "
            f"{self.entry.max_output_tokens} output tokens. More is set aside from now on"
        )

    @property
    def _money(self) -> BudgetPort:
        return self.budget or Unpaid(self.cache)

    @property
    def _consequences(self) -> Consequences:
        return Consequences(self.name, self.entry, self.endpoint, self.first)

    def _record(self, number: int, raw: RawReply, outcome: AttemptOutcome, worst: Usage) -> Attempt:
        usage = outcome.reading.usage
        return Attempt(
            number=number,
            outcome=outcome.name,
            http_status=raw.status,
            model_served=outcome.reading.model_served,
            finish_reason=outcome.reading.finish_reason,
            usage=usage,
            reply=raw.body,
            error=outcome.message,
            cost_usd=self._cost_usd(raw, usage, worst),
            scripted=SCRIPTED_HEADER in raw.headers or says_scripted(raw.body),
        )

    def _cost_usd(self, raw: RawReply, usage: Usage, worst: Usage) -> float | None:
        """What a reply cost, by its usage, which an error may have too; None if nobody knows.

        Output beyond the cap is charged even where the server does not say what was read.
        """
        if self.entry.price == "free":
            return 0.0
        if usage.input_tokens and usage.output_tokens is not None:
            return cost_usd(self.entry, usage)
        if (usage.output_tokens or 0) > (worst.output_tokens or 0):
            dearer = Usage(input_tokens=worst.input_tokens, output_tokens=usage.output_tokens)
            return cost_usd(self.entry, dearer)
        stray = raw.status == 200 and is_web_page(raw) and not self.first.known
        return (
            0.0
            if stray or not may_be_charged(raw, self._format, self._consequences.own_host)
            else None
        )

    def _worst_case(self, request: ChatRequest) -> Usage:
        """An upper bound on an attempt's tokens: no tokeniser makes more tokens than bytes."""
        return Usage(
            input_tokens=len(request.body.encode()), output_tokens=self.entry.max_output_tokens
        )

    def _answer(self, call: Call, kept: CachedCall, outcome: AttemptOutcome) -> ChatReply:
        if kept.attempts[-1] != call.attempts[-1]:  # an import was first
            return self._read(kept, call.earlier)
        text = outcome.reading.text
        return ChatReply(text, outcome.name, kept.request, kept.attempts, call.earlier)

    def _read(self, entry: CachedCall, earlier: int | None = None) -> ChatReply:
        """A recorded reply; without ``earlier`` all its attempts were made by earlier runs."""
        last = entry.attempts[-1]
        payload = reply_object(last.reply or "{}") if last.http_status == 200 else {}
        return ChatReply(
            text=self._format.read(payload).text,
            outcome=last.outcome,
            request=entry.request,
            attempts=entry.attempts,
            earlier=len(entry.attempts) if earlier is None else earlier,
        )


def _estimated_tokens(worst: Usage) -> int:
    """What a provider counts when it admits a request: its text, and the whole output cap."""
    # About four bytes of English make a token.
    return (worst.input_tokens or 0) // 4 + (worst.output_tokens or 0)


def _timed(attempt: Attempt, started_at: datetime, latency_s: float) -> Attempt:
    return replace(
        attempt,
        started_at=started_at.isoformat(timespec="milliseconds"),
        latency_s=round(latency_s, 4),
    )
