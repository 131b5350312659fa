"""The client of one model: it returns the recorded reply to a prompt, or asks for one."""

from __future__ import annotations

import asyncio
import math
from contextlib import closing, suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from functools import partial
from typing import TYPE_CHECKING

from merge_runner.config import ModelEntry, driver_name
from merge_runner.errors import (
    EndpointRefused,
    MergeRunnerError,
    ProviderDown,
    QuotaExhausted,
    RecordingError,
    SweepStopped,
)
from merge_runner.llm.budget import Budget, PaidAttempt
from merge_runner.llm.cache import Attempts, CachedCall, ResponseCache
from merge_runner.llm.call import Call, Meter, Wait
from merge_runner.llm.delays import TryAgain, backoff_s, next_wait_s, utc_after
from merge_runner.llm.formats import FORMATS
from merge_runner.llm.formats.wire import WireFormat, as_text
from merge_runner.llm.http_outcome import AttemptOutcome, TransportFailure, judge, may_be_charged
from merge_runner.llm.ledger import TOLERANCE_USD, Asked, Ledger
from merge_runner.llm.limiter import Limiter
from merge_runner.llm.prices import cost_usd, underpriced_tiers
from merge_runner.llm.recorded import RecordedReplies
from merge_runner.llm.refusals import UNSURE, if_nobody, reason_of, why_refused
from merge_runner.records import (
    SCRIPTED_HEADER,
    Attempt,
    CallFailed,
    ChatReply,
    ChatRequest,
    Slot,
    Usage,
    says_scripted,
)

if TYPE_CHECKING:
    from merge_runner.llm.batch.rounds import Rounds
    from merge_runner.llm.http import HttpTransport

# For how long connections may be refused at the first call of a run.
NOBODY_S = 5.0
# A shorter wait is over before a note of it is read.
NO_ROOM = "calls: the cap leaves money for few trials at a time"
LONG_WAIT_S = 5.0
# How often a format that knows empty answers as a fault is asked again after one; and how many
# refusals by an endpoint that has answered before mean the configuration.
EMPTY_RETRIES, SEVERAL = 2, 3
# How Gemini names a quota of a day, beside a delay that is none.
GEMINI_DAY = "PerDay"


@dataclass(slots=True)
class LlmClient:
    """Answers prompts of one model, called ``driver``; see ``driver_name``.

    ``endpoint`` is the identity that enters the keys. ``budget`` is None for a model that costs
    nothing. Until the endpoint has ``passed``, by an answer in its format, the calls of a run go
    alone: a wrong key, URL or parameter costs one call. It is ``known`` where it ever has answered,
    and ``_refused`` counts the requests that it has refused before. ``strict`` says that an answer
    of another model stops the sweep. In ``rounds``, which know it as ``model``, its name in the
    registry, it may be asked at ``batch_price`` as a share of the plain one, or its calls may wait
    already.

    ``under_way`` are the calls of all clients of a run by key, ``answered`` the keys of those that
    were answered. A call is shared by all who ask for its key. Where they are all cancelled, one
    that may be paid for goes on, so that its answer is kept, and ``drain`` waits for it; one that
    still waits for its turn is given up.
    """

    name: str
    entry: ModelEntry
    endpoint: str
    cache: ResponseCache
    transport: HttpTransport
    limiter: Limiter
    budget: Budget | None = None
    strict: bool = False
    passed: bool = True
    known: bool = False
    rounds: Rounds | None = None
    model: str = ""
    batch_price: float = 1.0
    under_way: dict[str, Call] = field(default_factory=dict)
    answered: set[str] = field(default_factory=set)
    driver: str = field(init=False)
    recorded: RecordedReplies = field(init=False)
    meter: Meter = field(init=False)
    _wire: WireFormat = field(init=False)
    money: Budget = field(init=False)
    _tier: str | None = field(init=False)
    _underpriced: set[str] = field(init=False)
    _refused: int = 0
    _alone: asyncio.Lock = field(default_factory=asyncio.Lock)
    _stopping: bool = False

    def __post_init__(self) -> None:
        """Derive what every call needs."""
        self.driver = driver_name(self.name, self.endpoint)
        self._wire = FORMATS[self.entry.format]
        self.recorded = RecordedReplies(
            self.name, self.entry, self.endpoint, self._wire, self.cache
        )
        self.meter = self.recorded.meter
        self._tier = as_text(self.entry.parameters.get("service_tier"))
        self._underpriced = underpriced_tiers(self.entry)
        # Without a name a ledger keeps nothing.
        self.money = self.budget or Budget(Ledger(self.cache, ""))

    async def ask(self, prompt: str, slot: Slot, *, order: int = 0) -> ChatReply:
        """Return the model's reply for a slot; lower ``order`` is served first.

        Raises CallFailed, TrialSuspended or SweepStopped.
        """
        request = self.recorded.request(prompt, slot)
        reply, attempts = None, None
        with suppress(RecordingError):  # it is damaged
            recorded, attempts = self.cache.look_up(request.key, request)
            if recorded:
                reply = self.recorded.read(recorded, len(recorded.attempts))
        if reply is None:
            # The attempts are counted once, for whoever asked first.
            call = self.under_way.get(request.key)
            shared = call is not None and not call.task.cancelling()
            if call is None or not shared:
                call = self._start(request, order, attempts)
            call.asking += 1
            try:
                # Shielded: the call may be paid for already when its trial is cancelled.
                reply = await asyncio.shield(call.task)
            finally:
                call.asking -= 1
                if not call.asking and call.wait is not None and not call.wait.paid:
                    call.task.cancel()  # or it would take money for a trial that is left
            if shared:
                reply = replace(reply, earlier=len(reply.attempts))
        self.recorded.count(reply, shared=request.key in self.answered)
        served = reply.attempts[-1].model_served
        if self.strict and served not in self.recorded.own_names:
            raise SweepStopped(
                f"{self.driver}: {served} answered where {self.entry.id} was asked for, at {slot}: "
                "leave --strict-model out, or name it in `aliases` of " + self.entry.place
            )
        return reply

    async def drain(self) -> None:
        """Let attempts in flight end and be saved, and give up calls that wait for one."""
        self._stopping = True
        calls = self._calls
        for call in calls:
            # What is in flight may be charged whether or not anybody takes the answer: it goes on.
            if call.wait is not None:
                call.task.cancel()
        await asyncio.gather(*(call.task for call in calls), return_exceptions=True)

    @property
    def in_flight_calls(self) -> int:
        """Number of calls in flight or being saved."""
        return sum(call.wait is None for call in self._calls)

    @property
    def waits(self) -> list[Wait]:
        """The waits of all other calls."""
        return [call.wait for call in self._calls if call.wait is not None]

    @property
    def idle_askers(self) -> int:
        """Number of trials that wait for calls that are blocked on another call."""
        return sum(call.asking for call in self._calls if call.wait and call.wait.idle)

    @property
    def _calls(self) -> list[Call]:
        """The calls of this client that are under way."""
        return [call for call in self.under_way.values() if call.asked.driver == self.driver]

    def _mark_waiting(self, call: Call, wait: Wait) -> None:
        """Mark a call as waiting, so that it can be given up: nothing of it is in flight.

        It is in flight again when its ``wait`` is None. Raises CallFailed where nobody wants it.
        """
        if self._stopping:
            raise CallFailed("the sweep was stopped", call.request)
        if not (call.asking or wait.paid):
            raise CallFailed("its trial was left", call.request)
        call.wait = wait

    def _start(self, request: ChatRequest, order: int, earlier: Attempts | None) -> Call:
        # An upper bound: no tokeniser makes more tokens than bytes.
        worst = Usage(
            input_tokens=len(request.body.encode()), output_tokens=self.entry.max_output_tokens
        )
        usd = cost_usd(self.entry, worst) or 0.0, cost_usd(self.entry, worst, self._tier) or 0.0
        asked = Asked(self.driver, str(request.slot), max(usd))
        call = Call(request, order, asked, worst, self.entry.deadline_s)
        call.attempts, call.earlier = [*(earlier or ())], len(earlier or ())
        call.damaged = earlier is None
        call.task = asyncio.create_task(self._call(call))
        self.under_way[request.key] = call

        def forget(done: asyncio.Task[ChatReply]) -> None:
            if self.under_way[request.key] is call:  # it is not asked anew meanwhile
                del self.under_way[request.key]
            if not done.cancelled():
                done.exception()  # retrieved, since all who asked may be gone by now

        call.task.add_done_callback(forget)
        return call

    async def _call(self, call: Call) -> ChatReply:
        """Make a call when there is money for its trial, and the first call has been answered."""
        if self.rounds is not None:
            call.open = self.rounds.waiting.get(call.request.key)
        if call.open:
            self.money.begin_anew(call.order)
        if call.order not in self.money.charged_usd:
            self._mark_waiting(call, Wait(NO_ROOM, idle=True))
            await self.money.admit(call.order)
            call.wait = None
        if call.damaged:
            await self._quarantine(call)
        if call.open:  # the attempt that has begun in a batch is the one that goes on
            end = call.open.note.lines[call.request.key]
            call.attempts = [each for each in call.attempts if each.number < end]
            call.earlier = len(call.attempts)
        elif not self.passed:  # nobody waits for an answer that may take hours
            return await self._first(call)
        return await self._answer(call)

    async def _first(self, call: Call) -> ChatReply:
        """Make a call alone, or with others where one has been answered meanwhile."""
        self._mark_waiting(call, Wait(f"for the first answer of {self.driver}"))
        await self._alone.acquire()
        call.wait = None
        alone, telling = not self.passed, None
        if alone:
            loop = asyncio.get_running_loop()
            telling = loop.call_later(LONG_WAIT_S, self._tell_first_wait, call)
        else:
            self._alone.release()
        try:
            return await self._answer(call)
        except SweepStopped:
            alone = False  # the next call would only be refused in the same way
            raise
        finally:
            if telling is not None:
                telling.cancel()
            if alone:
                self._alone.release()

    def _tell_first_wait(self, call: Call) -> None:
        """Note that the first call of a run has waited for LONG_WAIT_S."""
        left = timedelta(seconds=self.entry.deadline_s - LONG_WAIT_S)
        last = f"after {call.last_failure}" if call.own_attempts else "nothing has come yet"
        self.meter.notes.append(
            f"{self.driver}: {call.asked.slot}: the first call of this run waits for its answer "
            f"until {datetime.now(UTC) + left:%H:%M:%S} UTC, {last}"
        )

    async def _quarantine(self, call: Call) -> None:
        """Move what is damaged of a call to quarantine, and take what is left of its attempts."""
        key = call.request.key
        for name in await self.cache.write(partial(self.cache.set_damage_aside, key)):
            self.meter.damaged.append(name)
            self.meter.notes.append(
                f"{self.driver}: {call.asked.slot}: what is recorded is damaged; it is set aside "
                f"in the cache as 'damaged {name}', and asked again"
            )
        _, earlier = self.cache.look_up(key)
        call.attempts, call.earlier = [*earlier], len(earlier)

    async def _answer(self, call: Call) -> ChatReply:
        """Make attempts until one brings an answer."""
        try:
            return await self._attempt(call)
        except TryAgain as exc:
            failed = [exc]
        # Only here, since it costs time and memory that most calls need not spend.
        from tenacity import AsyncRetrying, retry_if_exception_type

        async def next_attempt() -> ChatReply:
            if failed:
                raise failed.pop()
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
            raise self._out_of_time(call, exc.delay_s or 0.0) from exc

    async def _sleep(self, call: Call, seconds: float) -> None:
        """Wait before the next attempt of a call."""
        call.left_s -= seconds
        until = datetime.now(UTC) + timedelta(seconds=seconds)
        why = f"after {call.last_failure}"
        self._mark_waiting(call, Wait(why, until))
        if seconds >= LONG_WAIT_S:
            line = f"{self.driver}: {call.asked.slot} waits until {until:%H:%M:%S} UTC {why}"
            self.meter.notes.append(line)
        await asyncio.sleep(seconds)
        call.wait = None

    def _out_of_time(self, call: Call, delay_s: float) -> MergeRunnerError:
        """Return the error of a call whose deadline would pass before the next attempt."""
        why = f"no answer within {self.entry.deadline_s:.0f} s"
        if delay_s >= self.entry.deadline_s:
            why = (
                f"the server asks to wait {delay_s:.0f} s, longer than a call's deadline of "
                f"{self.entry.deadline_s:.0f} s: run the same command again after that"
            )
        if self.passed:
            return self._failed(call, why)
        return ProviderDown(
            f"{self.driver}: the first call of this run: {why} ({call.last_failure}): run the same "
            "command when the service answers again"
        )

    def _failed(self, call: Call, why: str) -> CallFailed:
        why = f"{self.name}: {why} ({call.last_failure}), {len(call.own_attempts)} attempts"
        return CallFailed(why, call.request, tuple(call.attempts), call.earlier)

    async def _attempt(self, call: Call) -> ChatReply:
        """Make one attempt; return its answer, which is kept, or raise what follows from it."""
        rounds, asked = self.rounds, call.asked
        singly = rounds is None or (call.open is None and (call.singly or not rounds.submits))
        if not singly:
            asked = replace(asked, honest_usd=asked.honest_usd * self.batch_price)
        who = (call.order, call.request.key, asked)
        if call.open is None:
            self._mark_waiting(
                call, Wait("for calls in flight to be paid, under --max-cost", idle=True)
            )
            paid = await self.money.set_aside(*who)
            call.wait = None
        else:
            paid = self.money.going_on(*who)
        with closing(paid):
            if rounds is None or singly:
                outcome, record = await self._send(call, paid)
                return await self._concluded(call, paid, outcome, record)
            self._mark_waiting(call, Wait(f"for batches of {self.model}", idle=True, paid=True))
            outcome, batch = await rounds.ask(
                call.request, len(call.attempts) + 1, paid, self.model, call.open
            )
            call.wait, call.open, call.singly = None, None, True
            record, raw = self._record(call, outcome, batch.note.submitted_at), outcome.raw
            usd = record.cost_usd and record.cost_usd * self.batch_price
            if raw is not None and raw.status != 200 and record.usage == Usage():
                usd = 0.0  # no line that failed is charged
            record = replace(record, cost_usd=usd, batch_id=batch.note.batch_id or None)
            return await self._concluded(call, paid, outcome, record, batch.error)

    async def _send(self, call: Call, paid: PaidAttempt) -> tuple[AttemptOutcome, Attempt]:
        """Make one attempt as a request of its own."""
        # A turn must be used as soon as it is given, or the limits do not hold.
        self._mark_waiting(call, Wait("for a turn under the rate limits"))
        # As a provider counts when it admits a request: its text, of which about four bytes
        # make a token, and the whole output cap.
        estimate = (call.worst.input_tokens or 0) // 4 + self.entry.max_output_tokens
        settle = await self.limiter.acquire(estimate, order=call.order)
        if self.money.ledger.is_shared_out:
            self._mark_waiting(call, Wait("for the coordinator, which shares --max-cost out"))
            await paid.ask()
        call.wait = None
        number = len(call.attempts) + 1
        await paid.begin(number)
        began, clock_s = datetime.now(UTC), asyncio.get_running_loop().time
        began_s, timeout_s = clock_s(), min(self.entry.timeout_s, call.left_s)
        try:
            raw = await self.transport.send(call.request, attempt=number, timeout_s=timeout_s)
            outcome = judge(raw, self._wire)
        except TransportFailure as exc:
            outcome = AttemptOutcome(
                exc.action, exc.outcome, str(exc), charged=exc.sent, reason=exc.reason
            )
        took_s = clock_s() - began_s
        call.left_s -= took_s
        record = self._record(call, outcome, began, took_s)
        if settle is not None and record.usage.output_tokens is not None:
            settle((record.usage.input_tokens or 0) + record.usage.output_tokens)
        return outcome, record

    async def _concluded(
        self,
        call: Call,
        paid: PaidAttempt,
        outcome: AttemptOutcome,
        record: Attempt,
        error: MergeRunnerError | None = None,
    ) -> ChatReply:
        """Keep an attempt and return its answer, or raise why there is none."""
        call.attempts.append(record)
        self.meter.count_attempt(record)
        tier = outcome.reading.service_tier
        if tier in self._underpriced:
            self.meter.underpriced[tier] += 1
        aside_usd = paid.aside_usd or math.inf  # none: a user has released it meanwhile
        if (record.cost_usd or 0.0) > aside_usd + TOLERANCE_USD:
            self.meter.notes.append(
                f"{self.driver}: {call.asked.slot}: the reply cost {record.cost_usd:.4f} USD, and "
                f"{aside_usd:.4f} were set aside for it: the server does not keep to the cap of "
                f"{self.entry.max_output_tokens} output tokens. More is set aside from now on"
            )
        error = error or self._error(call, outcome)
        if error is None:
            attempts = tuple(call.attempts)
            answered = CachedCall(call.request, attempts)
            kept = await paid.settle(record, partial(self.cache.keep, answered))
            self.answered.add(call.request.key)
            if kept is not answered:  # an import was first
                return self.recorded.read(kept, call.earlier)
            text = outcome.reading.text
            return ChatReply(text, record.outcome, call.request, attempts, call.earlier)
        if outcome.pause:
            self.limiter.pause(outcome.delay_s or backoff_s(len(call.own_attempts)))
        # Before the error, which may end the whole run.
        attempts = tuple(call.attempts)
        await paid.settle(record, partial(self.cache.keep_attempts, call.request.key, attempts))
        raise error

    def _error(self, call: Call, outcome: AttemptOutcome) -> MergeRunnerError | None:
        """Return the error that follows from a call's last attempt, None if it is an answer."""
        driver, message = self.driver, outcome.message or outcome.name
        if outcome.action == "refused" or not self.passed:
            reason = reason_of(outcome, self.endpoint + call.request.path)
            self._refused += reason is not None
            # An endpoint that has answered before may mean this prompt alone.
            sure = not (self.known or reason in UNSURE) or self._refused >= SEVERAL
            if reason is not None and (sure or outcome.action == "refused"):
                why = why_refused(reason, self.entry, outcome)
                return EndpointRefused(f"{driver}: {why}")
        # A server that is just starting is waited for, but only for seconds.
        is_late = self.entry.deadline_s - call.left_s >= NOBODY_S
        if outcome.name == "no_connection" and not self.passed and is_late:
            return ProviderDown(f"{driver}: {message}: {if_nobody(self.entry)}")
        delay_s, closed = outcome.delay_s or 0.0, ""
        if outcome.action == "quota":
            closed = "the account's quota is exhausted"
        elif outcome.pause and delay_s > self.entry.deadline_s:
            closed = f"the provider asks to wait {delay_s:.0f} s, longer than a call's deadline"
        if closed:
            later = "run the same command later to go on"
            if outcome.delay_s is not None:
                later = f"it opens again at {utc_after(delay_s)}: run the same command then"
            elif outcome.raw and GEMINI_DAY in outcome.raw.body:
                later = "it opens again at midnight Pacific time: run the same command then"
            return QuotaExhausted(f"{driver}: {closed} ({message}): {later}")
        if outcome.action == "retry":
            return TryAgain(message, outcome.delay_s)
        if outcome.action == "fail":
            return self._failed(call, "nothing that is asked again would help")
        self.passed = self.known = True
        if outcome.name == "empty" and self._wire.retries_empty and call.empty <= EMPTY_RETRIES:
            return TryAgain("empty answer")
        return None

    def _record(
        self, call: Call, outcome: AttemptOutcome, began: datetime, took_s: float | None = None
    ) -> Attempt:
        """Return an attempt as it is recorded."""
        raw, reading = outcome.raw, outcome.reading
        scripted = raw is not None and (SCRIPTED_HEADER in raw.headers or says_scripted(raw.body))
        return Attempt(
            number=len(call.attempts) + 1,
            outcome=outcome.name,
            http_status=raw.status if raw else None,
            model_served=reading.model_served,
            finish_reason=reading.finish_reason,
            usage=reading.usage,
            reply=raw.body if raw else None,
            error=outcome.message,
            started_at=began.isoformat(timespec="milliseconds"),
            latency_s=took_s and round(took_s, 4),
            cost_usd=self._cost_usd(outcome, call.worst),
            scripted=scripted,
        )

    def _cost_usd(self, outcome: AttemptOutcome, worst: Usage) -> float | None:
        """Return the cost of an attempt by its usage, which an error may have too; None: unknown.

        Output beyond the cap is charged even where the server does not say what was read.
        """
        raw, usage = outcome.raw, outcome.reading.usage
        if self.entry.price == "free":
            return 0.0
        if raw is None:
            return None if outcome.charged else 0.0
        tier = outcome.reading.service_tier
        if usage.input_tokens and usage.output_tokens is not None:
            return cost_usd(self.entry, usage, tier)
        if (usage.output_tokens or 0) > self.entry.max_output_tokens:
            return cost_usd(self.entry, replace(worst, output_tokens=usage.output_tokens), tier)
        stray = raw.status == 200 and raw.is_web_page and not self.known
        return None if may_be_charged(raw, self.endpoint) and not stray else 0.0
