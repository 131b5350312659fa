"""The client of one model: what is known, what is sealed, and what is asked.

What an attempt means for its call is decided in http_outcome.py.
"""

from __future__ import annotations

import asyncio
import time
from contextlib import closing
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from functools import partial
from typing import TYPE_CHECKING

from merge_runner.config import ModelEntry, driver_name, is_own_host
from merge_runner.errors import (
    CallFailed,
    MergeRunnerError,
    ModelSwapped,
    ProviderDown,
    RecordingError,
    ReplayMiss,
    SweepStopped,
)
from merge_runner.llm.budget import Budget, PaidAttempt
from merge_runner.llm.cache import CachedCall, ResponseCache
from merge_runner.llm.call import Call, Wait, slot_text
from merge_runner.llm.content_hashes import make_request
from merge_runner.llm.formats import FORMATS
from merge_runner.llm.formats.base import WireFormat
from merge_runner.llm.http_outcome import (
    AttemptOutcome,
    Consequences,
    Deadline,
    FirstCall,
    OutOfTime,
    RawReply,
    RequestFailed,
    TransportFailure,
    TryAgain,
    is_web_page,
    judge,
    may_be_charged,
)
from merge_runner.llm.ledger import TOLERANCE_USD, Asked, Ledger
from merge_runner.llm.limiter import Limiter
from merge_runner.llm.meter import Meter
from merge_runner.llm.prices import cost_usd
from merge_runner.llm.verify import reply_object
from merge_runner.records import (
    SCRIPTED_HEADER,
    Attempt,
    ChatReply,
    ChatRequest,
    Slot,
    Usage,
    is_scripted,
    says_scripted,
)
from merge_runner.served_model import own_names

if TYPE_CHECKING:
    from merge_runner.llm.batch.rounds import Rounds
    from merge_runner.llm.http import HttpTransport

# A shorter wait is over before a note of it is read.
LONG_WAIT_S = 5.0


@dataclass(slots=True)
class LlmClient:
    """Answers prompts of one model.

    ``endpoint`` is the identity that enters the keys. ``budget`` is None for a model that costs
    nothing. ``first`` is the run's first call to the endpoint, which goes alone. ``sealed`` says
    that nothing may be asked anew, so that there is no ``transport``; ``strict`` that an answer of
    another model stops the sweep. ``model`` is its name in the registry where ``name`` also tells
    its parameters. In ``rounds`` it may be asked, at ``batch_price`` as a share of the plain one,
    or its calls may wait already. ``driver`` is its name, with the endpoint where that is not the
    provider's own.

    ``under_way`` are the calls of all clients of a run by key. A call is shared by all who ask for
    its key, and goes on when they are cancelled, so that what is paid for is kept; ``drain`` waits
    for it.
    """

    name: str
    entry: ModelEntry
    endpoint: str
    cache: ResponseCache
    transport: HttpTransport | None
    limiter: Limiter
    budget: Budget | None = None
    sealed: bool = False
    strict: bool = False
    model: str = ""
    first: FirstCall = field(default_factory=partial(FirstCall, passed=True))
    rounds: Rounds | None = None
    batch_price: float = 1.0
    under_way: dict[str, Call] = field(default_factory=dict)
    meter: Meter = field(default_factory=Meter)
    driver: str = field(init=False)
    _wire: WireFormat = field(init=False)
    _own_names: frozenset[str | None] = field(init=False)
    _money: Budget = field(init=False)
    _consequences: Consequences = field(init=False)
    _stopping: bool = False

    def __post_init__(self) -> None:
        """Derive what every call needs."""
        self.driver = driver_name(self.name, self.endpoint)
        self._wire = FORMATS[self.entry.format]
        self._own_names = own_names(self.entry.id, self.entry.aliases)
        self._money = self.budget or Budget(Ledger(self.cache, ""))  # a ledger that keeps nothing
        provider = self.entry.provider
        self._consequences = Consequences(
            self.name,
            self.entry,
            self.driver,
            # The provider whose own host is asked; None: another server in its format.
            provider if is_own_host(provider, self.endpoint) else None,
            self.first,
        )

    async def ask(self, prompt: str, slot: Slot, *, order: int = 0) -> ChatReply:
        """Return the model's reply for a slot; lower ``order`` is served first.

        Raises CallFailed, TrialSuspended or SweepStopped.
        """
        wire = self._wire.request(self.entry, prompt)
        request = make_request(
            provider=self.entry.provider,
            endpoint=self.endpoint,
            model=self.entry.id,
            path=wire.path,
            headers=wire.headers,
            body=wire.body,
            slot=slot,
        )
        reply = self._known(request)
        if reply is None and self.sealed:
            raise ReplayMiss("no recorded reply", request)
        if reply is None:
            # The attempts are counted once, for whoever asked first.
            shared = request.key in self.under_way
            call = self.under_way[request.key] if shared else self._start(request, order)
            call.asking += 1
            try:
                # Shielded: the call may be paid for already when its trial is cancelled.
                reply = await asyncio.shield(call.task)
            finally:
                call.asking -= 1
            if shared:
                reply = replace(reply, earlier=len(reply.attempts))
        self._count(reply)
        served = reply.attempts[-1].model_served
        if self.strict and served not in self._own_names:
            raise ModelSwapped(
                f"{self.driver}: {served} answered where {self.entry.id} was asked for, at "
                f"{slot_text(slot)}; --strict-model stops the sweep. The reply is kept. To go on "
                "with it, leave --strict-model out, or name it in `aliases` in "
                "experiments/models.toml"
            )
        return reply

    async def drain(self) -> None:
        """Let attempts in flight end and be saved, and give up calls that wait for one."""
        self._stopping = True
        calls = self._calls
        for call in calls:
            call.stop()
        tasks = [call.task for call in calls]
        await asyncio.gather(*tasks, return_exceptions=True)

    def leave(self, order: int) -> None:
        """Release the money of the trial of this order, which has ended."""
        self._money.leave(order)

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
        calls = self._calls
        return sum(call.asking for call in calls if call.wait is not None and call.wait.idle)

    @property
    def _calls(self) -> list[Call]:
        """The calls of this client that are under way."""
        return [call for call in self.under_way.values() if call.asked.driver == self.driver]

    def _known(self, request: ChatRequest) -> ChatReply | None:
        """Return the recorded reply; a damaged one is None, and in a replay raises CallFailed."""
        try:
            recorded = self.cache.get(request.key)
        except RecordingError as exc:
            if self.sealed:
                raise CallFailed(f"{self.name}: call {request.key}: {exc}", request) from exc
            return None
        return None if recorded is None else self._read(recorded, len(recorded.attempts))

    def _count(self, reply: ChatReply) -> None:
        """Count an answer that a trial uses, and who gave it where it is another model."""
        last, meter = reply.attempts[-1], self.meter
        meter.calls_cached += reply.cached
        meter.calls_live += not reply.cached
        if last.model_served not in self._own_names:
            meter.mismatches[f"{reply.request.model} -> {last.model_served}"] += 1
        if reply.request.provider != "emulator":
            meter.stand_ins += is_scripted(reply.request, last)

    def _read(self, recorded: CachedCall, earlier: int) -> ChatReply:
        last = recorded.attempts[-1]
        payload = reply_object(last.reply or "{}") if last.http_status == 200 else {}
        text = self._wire.read(payload).text
        return ChatReply(text, last.outcome, recorded.request, recorded.attempts, earlier)

    def _start(self, request: ChatRequest, order: int) -> Call:
        # An upper bound: no tokeniser makes more tokens than bytes.
        worst = Usage(
            input_tokens=len(request.body.encode()), output_tokens=self.entry.max_output_tokens
        )
        worst_usd = cost_usd(self.entry, worst) or 0.0
        asked = Asked(self.driver, slot_text(request.slot), worst_usd, self.model or self.name)
        call = Call(request, order, asked, worst, self._stopping)
        call.task = asyncio.create_task(self._call(call))
        self.under_way[request.key] = call

        def forget(done: asyncio.Task[ChatReply]) -> None:
            del self.under_way[request.key]
            if not done.cancelled():
                done.exception()  # retrieved, since all who asked may be gone by now

        call.task.add_done_callback(forget)
        return call

    async def _call(self, call: Call) -> ChatReply:
        """Make a call when there is money for its trial, and the first call has been answered."""
        opened = self.rounds is not None and self.rounds.open_batch(call.request.key) is not None
        if opened:
            self._money.begin_anew(call.order)
        with call.waiting("for trials before it to end, under --max-cost", idle=True):
            await self._money.admit(call.order)
        alone = False
        if not self.first.passed and not opened:  # nobody waits for an answer that may take hours
            with call.waiting(f"for the first answer of {self.driver}"):
                alone = await self.first.turn()
        try:
            self._resume(call)
            return await self._attempts(call)
        except SweepStopped:
            alone = False  # the next call would only be refused in the same way
            raise
        finally:
            if alone:
                self.first.give_turn()

    def _resume(self, call: Call) -> None:
        """Give a call the attempts of earlier runs; what is damaged goes to quarantine."""
        key = call.request.key
        for name in self.cache.set_damage_aside(key):
            self.meter.damaged.append(name)
            self.meter.notes.append(
                f"{self.driver}: {call.asked.slot}: what is recorded is damaged; it is set aside "
                f"in the cache as 'damaged {name}', and asked again"
            )
        earlier = self.cache.unanswered(key)
        if self.rounds is not None:
            call.open = self.rounds.open_batch(key)
        opened = call.open  # the attempt that has begun there is the one that goes on
        call.attempts = [
            each for each in earlier if not opened or each.number < opened.note.lines[key]
        ]
        call.earlier = len(call.attempts)

    async def _attempts(self, call: Call) -> ChatReply:
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
            return await deadline.keep(partial(self._attempt, call, deadline), sleep=sleep)
        except (OutOfTime, RequestFailed) as exc:
            why, made = f"{exc} ({call.last_failure})", len(call.own_attempts)
            if isinstance(exc, OutOfTime) and not self.first.passed:
                raise ProviderDown(
                    f"{self.driver}: {exc} to the first call of this run ({call.last_failure}), "
                    f"{made} attempts: nothing else is asked. When the service answers again, run "
                    "the same command"
                ) from exc
            raise call.failed(f"{self.name}: {why}, {made} attempts") from exc

    async def _attempt(self, call: Call, deadline: Deadline) -> ChatReply:
        """Make one attempt; return its answer, which is kept, or raise what follows from it."""
        rounds = self.rounds
        if rounds and (call.open or (rounds.submits and not call.singly)):
            return await self._attempt_in_batch(call, rounds)
        with call.waiting("for calls in flight to be paid, under --max-cost", idle=True):
            paid = await self._money.set_aside(call.order, call.request.key, call.asked)
        with closing(paid):
            # A turn must be used as soon as it is given, or the limits do not hold.
            with call.waiting("for a turn under the rate limits"):
                # As a provider counts when it admits a request: its text, of which about four bytes
                # make a token, and the whole output cap.
                estimate = (call.worst.input_tokens or 0) // 4 + self.entry.max_output_tokens
                settle = await self.limiter.acquire(estimate, order=call.order)
            await paid.begin(call.attempts)
            started_at, started = datetime.now(UTC), time.perf_counter()
            with deadline.attempt() as seconds_left:
                outcome = await self._send(call, seconds_left)
            record = replace(
                self._record(call, outcome),
                started_at=started_at.isoformat(timespec="milliseconds"),
                latency_s=round(time.perf_counter() - started, 4),
            )
            if record.usage.output_tokens is not None:
                settle((record.usage.input_tokens or 0) + record.usage.output_tokens)
            return await self._concluded(call, paid, outcome, record)

    async def _send(self, call: Call, seconds_left: float) -> AttemptOutcome:
        """Send the request once."""
        assert self.transport is not None, "a sealed client asks nothing"
        number, timeout_s = len(call.attempts) + 1, min(self.entry.timeout_s, seconds_left)
        try:
            raw = await self.transport.send(call.request, attempt=number, timeout_s=timeout_s)
        except TransportFailure as exc:
            return AttemptOutcome(exc.action, exc.outcome, str(exc), charged=exc.sent)
        return judge(raw, self._wire)

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
        self._tell_overrun(call, paid.aside_usd)
        error = error or self._consequences.error(call, outcome)
        if error is None:
            kept = await paid.keep(CachedCall(call.request, tuple(call.attempts)))
            if kept.attempts[-1] != record:  # an import was first
                return self._read(kept, call.earlier)
            text = outcome.reading.text
            return ChatReply(text, outcome.name, kept.request, kept.attempts, call.earlier)
        if isinstance(error, TryAgain) and error.pause_s is not None:
            self.limiter.pause(error.pause_s)
            until = datetime.now(UTC) + timedelta(seconds=error.pause_s)
            self.meter.notes.append(
                f"{self.driver}: all its calls wait {error.pause_s:.1f} s, until "
                f"{until:%H:%M:%S} UTC: {error}"
            )
        await paid.settle(call.attempts)  # before the error, which may end the whole run
        raise error

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

    def _record(self, call: Call, outcome: AttemptOutcome) -> Attempt:
        """Return an attempt as it is recorded."""
        number, raw = len(call.attempts) + 1, outcome.raw
        if raw is None:
            cost = None if outcome.charged and self.entry.price != "free" else 0.0
            return Attempt(number, outcome.name, error=outcome.message, cost_usd=cost)
        return Attempt(
            number=number,
            outcome=outcome.name,
            http_status=raw.status,
            model_served=outcome.reading.model_served,
            finish_reason=outcome.reading.finish_reason,
            usage=outcome.reading.usage,
            reply=raw.body,
            error=outcome.message,
            cost_usd=self._cost_usd(raw, outcome.reading.usage, call.worst),
            scripted=SCRIPTED_HEADER in raw.headers or says_scripted(raw.body),
        )

    def _cost_usd(self, raw: RawReply, usage: Usage, worst: Usage) -> float | None:
        """Return the cost of a reply by its usage, which an error may have too; None: unknown.

        Output beyond the cap is charged even where the server does not say what was read.
        """
        if self.entry.price == "free":
            return 0.0
        if usage.input_tokens and usage.output_tokens is not None:
            return cost_usd(self.entry, usage)
        if (usage.output_tokens or 0) > self.entry.max_output_tokens:
            return cost_usd(self.entry, replace(worst, output_tokens=usage.output_tokens))
        stray = raw.status == 200 and is_web_page(raw) and not self.first.known
        charged = may_be_charged(raw, self._consequences.own_host) and not stray
        return None if charged else 0.0

    async def _attempt_in_batch(self, call: Call, rounds: Rounds) -> ChatReply:
        """Make one attempt as a line of a batch; see ``_attempt``."""
        asked = replace(call.asked, honest_usd=call.asked.honest_usd * self.batch_price)
        who = (call.order, call.request.key, asked)
        if call.open is None:
            with call.waiting("for calls in flight to be paid, under --max-cost", idle=True):
                paid = await self._money.set_aside(*who)
        else:
            paid = self._money.going_on(*who, call.open.note.ledger)
        with closing(paid):
            with call.waiting(f"for batches of {asked.model}", idle=True):
                outcome, batch = await rounds.ask(call, paid)
            call.open, call.singly = None, True
            record, raw = self._record(call, outcome), outcome.raw
            usd = record.cost_usd
            if raw is not None and raw.status != 200 and record.usage == Usage():
                usd = 0.0  # no line that failed is charged
            record = replace(
                record,
                started_at=batch.note.submitted_at.isoformat(timespec="milliseconds"),
                cost_usd=None if usd is None else usd * self.batch_price,
                batch_id=batch.note.batch_id or None,
            )
            return await self._concluded(call, paid, outcome, record, batch.error)
