"""The client of one model: cache, then retry, then limiter, then transport."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from functools import partial
from typing import Any

from merge_runner.config import ModelEntry, driver_name
from merge_runner.errors import (
    CallFailed,
    EndpointRefused,
    MergeRunnerError,
    ModelSwapped,
    ProviderDown,
    QuotaExhausted,
    RecordingError,
    SweepStopped,
)
from merge_runner.llm.cache import Entry, ResponseCache
from merge_runner.llm.first_call import NOBODY_S, FirstCall, refusal, set_base_url, set_key
from merge_runner.llm.formats import FORMATS
from merge_runner.llm.formats.base import Reading
from merge_runner.llm.http_outcome import RawReply, Verdict, is_web_page, judge, may_be_charged
from merge_runner.llm.keys import make_request
from merge_runner.llm.ledger import TOLERANCE_USD, Asked
from merge_runner.llm.meter import Meter, Wait
from merge_runner.llm.prices import Pricing
from merge_runner.llm.retry import (
    OutOfTime,
    RequestFailed,
    TryAgain,
    backoff_s,
    call_with_retries,
)
from merge_runner.llm.shared_services import Claiming, Purse, Turn, Turns
from merge_runner.llm.transport import Transport, TransportFailure
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

EMPTY_RETRIES = 2
CLAIM_POLL_S = 0.1
MODELS = "`merge-runner models`"


@dataclass(slots=True)
class _Call:
    """A call under way: its attempts so far, of which the first ``earlier`` by earlier runs.

    ``worst`` bounds its tokens, ``worst_usd`` its cost where the server keeps to the output cap;
    ``aside_usd`` is set aside for the attempt, and ``spent_usd`` what the answer cost.
    ``began`` is when the call did, on the event loop's clock.
    """

    request: ChatRequest
    order: int
    attempts: list[Attempt]
    earlier: int
    worst: Usage
    worst_usd: float
    began: float
    aside_usd: float = 0.0
    spent_usd: float | None = None


@dataclass(slots=True)
class LlmClient:
    """Answers prompts of one model.

    ``endpoint`` is the identity that enters the keys. A call that is under way is shared by all
    who ask for the same key, and goes on when they are cancelled, so that what is paid for is
    kept; ``drain`` waits for it. ``claims`` keep other processes from making the same call.
    ``budget`` is that of a model which costs money. ``first`` is the run's first call to the
    endpoint, which goes alone. ``sealed`` says that nothing may be asked
    anew; ``strict`` that an answer of another model stops the sweep.
    """

    name: str
    entry: ModelEntry
    endpoint: str
    cache: ResponseCache
    transport: Transport
    limiter: Turns
    pricing: Pricing
    budget: Purse | None = None
    claims: Claiming | None = None
    sealed: bool = False
    strict: bool = False
    first: FirstCall = field(default_factory=partial(FirstCall, passed=True))
    meter: Meter = field(default_factory=Meter)
    _calls: dict[str, asyncio.Task[tuple[Entry, int]]] = field(default_factory=dict)
    _stopping: bool = False

    async def ask(self, prompt: str, slot: Slot, *, order: int = 0) -> ChatReply:
        """The model's reply for a slot; lower ``order`` is served first.

        Raises CallFailed, TrialSuspended or SweepStopped.
        """
        request = self._request(prompt, slot)
        if recorded := self._recorded(request):
            entry, earlier = recorded, len(recorded.attempts)
        elif call := self._calls.get(request.key):
            entry, _ = await asyncio.shield(call)
            earlier = len(entry.attempts)  # who asked first tells of them
        else:
            entry, earlier = await asyncio.shield(self._start(request, order))
        reply = self._reply(entry, earlier)
        other_model = self._other_model(reply)
        self.meter.count_reply(reply, other_model)
        if self.strict and other_model is not None:
            raise ModelSwapped(
                f"{self.driver}: {other_model} answered where {self.entry.id} was asked for, at "
                f"{_who(slot)}; --strict-model stops the sweep. The reply is kept. To go on with "
                "it, leave --strict-model out, or name it in `aliases` in experiments/models.toml"
            )
        return reply

    async def drain(self) -> None:
        """Let attempts in flight end and be saved, and give up calls that wait for one."""
        self._stopping = True
        for key in list(self.meter.waits):
            self._calls[key].cancel()
        await asyncio.gather(*self._calls.values(), return_exceptions=True)

    def leave(self, order: int) -> None:
        """The trial of this order has ended, and needs no more money."""
        if self.budget is not None:
            self.budget.leave(order)

    @property
    def flying(self) -> int:
        """How many calls are in flight or being saved."""
        return len(self._calls) - len(self.meter.waits)

    @property
    def driver(self) -> str:
        """Its name, with the endpoint where that is not the provider's own."""
        return driver_name(self.name, self.endpoint)

    def _recorded(self, request: ChatRequest) -> Entry | None:
        """The recorded call, None for a damaged one; in a replay that raises CallFailed."""
        try:
            return self.cache.get(request.key)
        except RecordingError as exc:
            if self.sealed:
                raise CallFailed(f"{self.name}: call {request.key}: {exc}", request) from exc
            return None

    def _known(self, request: ChatRequest) -> tuple[Entry | None, tuple[Attempt, ...]]:
        """The recorded call, else the attempts of earlier runs; only who has claimed it may ask.

        What is damaged is moved out of the way, and told.
        """
        key = request.key
        try:
            return self.cache.get(key), self.cache.unanswered(key)
        except RecordingError:
            for name in self.cache.set_damage_aside(key):
                self.meter.damaged.append(name)
                self.meter.notes.append(
                    f"{self.driver}: {_who(request.slot)}: what is recorded is damaged; it is set "
                    f"aside in the cache as 'damaged {name}', and asked again"
                )
            return self.cache.get(key), self.cache.unanswered(key)

    def _other_model(self, reply: ChatReply) -> str | None:
        """Who answered, where it is another model than was asked for."""
        served = reply.attempts[-1].model_served
        return served if is_other_model(self.entry.id, served, self.entry.aliases) else None

    def _request(self, prompt: str, slot: Slot) -> ChatRequest:
        wire = FORMATS[self.entry.format].request(self.entry, prompt)
        return make_request(
            provider=self.entry.provider,
            endpoint=self.endpoint,
            model=self.entry.id,
            path=wire.path,
            headers=wire.headers,
            body=wire.body,
            slot=slot,
        )

    def _start(self, request: ChatRequest, order: int) -> asyncio.Task[tuple[Entry, int]]:
        call = asyncio.create_task(self._claimed(request, order))
        self._calls[request.key] = call

        def forget(done: asyncio.Task[tuple[Entry, int]]) -> None:
            del self._calls[request.key]
            if not done.cancelled():
                done.exception()  # all who asked may be gone by now

        call.add_done_callback(forget)
        return call

    async def _claimed(self, request: ChatRequest, order: int) -> tuple[Entry, int]:
        """Make a call when its turn has come; returns the entry and its earlier attempts."""
        if self.budget is not None:
            # Before the claim: nobody waits for money with a call that another process needs.
            with self._giving_way(request, "for trials before it to end, under --max-cost"):
                await self.budget.admit(order)
        if self.sealed:
            return await self._make(request, order, ())
        alone, stopped = await self._goes_alone(request), False
        try:
            return await self._unless_made(request, order)
        except SweepStopped:
            stopped = True  # nobody else is to try the same
            raise
        finally:
            if alone and not stopped:
                self.first.give_turn()

    async def _goes_alone(self, request: ChatRequest) -> bool:
        """Wait for the first answer of the run; True: it is for this call to bring it."""
        if self.first.passed:
            return False
        with self._giving_way(request, f"for the first answer of {self.driver}"):
            return await self.first.turn()

    async def _unless_made(self, request: ChatRequest, order: int) -> tuple[Entry, int]:
        """Make a call unless another process does."""
        while self.claims is not None and not await self.claims.claim(request.key):
            with self._giving_way(request, "for another merge-runner that makes the same call"):
                await asyncio.sleep(CLAIM_POLL_S)
        try:
            made, earlier = self._known(request)  # maybe just now
            return (made, len(made.attempts)) if made else await self._make(request, order, earlier)
        finally:
            if self.claims is not None:
                self.claims.release(request.key)

    async def _make(
        self, request: ChatRequest, order: int, earlier: tuple[Attempt, ...]
    ) -> tuple[Entry, int]:
        """Make attempts until there is an answer, and save it with all of them."""
        worst = self._worst_case(request)
        worst_usd = self.pricing.cost_usd(worst) or 0.0
        began = asyncio.get_running_loop().time()
        call = _Call(request, order, list(earlier), len(earlier), worst, worst_usd, began)

        async def take_turn() -> Turn:
            return await self._take_turn(call)

        async def attempt(permit: Turn, number: int, seconds_left: float) -> None:
            await self._attempt(call, permit, call.earlier + number, seconds_left)

        async def sleep(seconds: float) -> None:
            until = datetime.now(UTC) + timedelta(seconds=seconds)
            with self._giving_way(request, f"after {_last_failure(call)}", until):
                await asyncio.sleep(seconds)

        answered = False
        try:
            await call_with_retries(
                take_turn, attempt, deadline_s=self.entry.deadline_s, sleep=sleep
            )
            answered = True
        except (OutOfTime, RequestFailed) as exc:
            made = len(call.attempts) - call.earlier
            if isinstance(exc, OutOfTime) and not self.first.passed:
                raise ProviderDown(
                    f"{self.driver}: {exc} to the first call of this run ({_last_failure(call)}), "
                    f"{made} attempts: nothing else is asked. When the service answers again, run "
                    "the same command"
                ) from exc
            raise CallFailed(
                f"{self.name}: {exc} ({_last_failure(call)}), {made} attempts",
                request,
                tuple(call.attempts),
                call.earlier,
            ) from exc
        finally:
            if not answered:
                await self._keep_unanswered(call)
        return await self._keep(call), call.earlier

    async def _keep(self, call: _Call) -> Entry:
        entry = Entry(call.request, tuple(call.attempts))
        if self.budget is None:
            return await self.cache.put(entry)
        try:
            return await self.budget.ledger.keep(entry, call.aside_usd, call.spent_usd)
        finally:
            self.budget.settled(call.order)

    async def _keep_unanswered(self, call: _Call) -> None:
        """Keep the attempts for a later run; the ledger of a paid model did so already."""
        kept = tuple(call.attempts)
        if self.budget is None and len(kept) > call.earlier:
            await self.cache.put_unanswered(call.request.key, kept)

    async def _take_turn(self, call: _Call) -> Turn:
        """Money first: a permit must be used when it is given, or the limits do not hold."""
        if self.budget is not None:
            with self._giving_way(call.request, "for calls in flight to be paid, under --max-cost"):
                call.aside_usd = await self.budget.reserve(call.order, call.worst_usd, self.driver)
        permit: Turn | None = None
        try:
            with self._giving_way(call.request, "for a turn under the rate limits"):
                permit = await self.limiter.acquire(_estimated_tokens(call.worst), order=call.order)
        finally:
            if permit is None and self.budget is not None:
                self.budget.give_back(call.order, call.aside_usd)
        return permit

    @contextmanager
    def _giving_way(
        self, request: ChatRequest, what: str, until: datetime | None = None
    ) -> Iterator[None]:
        """Within this, nothing of the call is in flight, so that a drain gives it up."""
        if self._stopping:
            raise CallFailed("the sweep was stopped", request)
        wait = Wait(f"{self.driver}: {_who(request.slot)}", what, until)
        self.meter.begin_wait(request.key, wait)
        try:
            yield
        finally:
            del self.meter.waits[request.key]

    async def _attempt(self, call: _Call, permit: Turn, number: int, seconds_left: float) -> None:
        """One attempt, appended to the call's; returns if it is the answer."""
        await self._begin(call)
        started_at, started = datetime.now(UTC), time.perf_counter()
        spent: float | None = None
        raw: RawReply | None = None
        try:
            raw = await self.transport.send(
                call.request, attempt=number, timeout_s=min(self.entry.timeout_s, seconds_left)
            )
            verdict = judge(raw, FORMATS[self.entry.format])
            record = self._record(number, raw, verdict, call.worst)
            spent = record.cost_usd
            self._settle_tokens(permit, record.usage)
        except TransportFailure as exc:
            verdict = Verdict(exc.action, exc.outcome, Reading("error"), str(exc))
            free = self.entry.price == "free" or not exc.sent
            spent = 0.0 if free else None
            record = Attempt(number, exc.outcome, error=str(exc), cost_usd=spent)
        record = _timed(record, started_at, time.perf_counter() - started)
        call.attempts.append(record)
        self.meter.count_attempt(record)
        self._tell_overrun(call, spent)
        try:
            if raw is None:
                self._give_up_on_nobody(call)
            else:
                self._check_endpoint(raw, verdict)
            self._act_on(verdict, call)
        except MergeRunnerError:
            await self._settle_failed(call, spent)
            raise
        call.spent_usd = spent

    async def _begin(self, call: _Call) -> None:
        """Note durably that an attempt is made, where it may cost something."""
        if self.budget is None:
            return
        try:
            asked = Asked(self.driver, _who(call.request.slot), call.worst_usd)
            await self.budget.begin(call.request.key, call.attempts, call.aside_usd, asked)
        except MergeRunnerError:
            self.budget.give_back(call.order, call.aside_usd)
            raise

    async def _settle_failed(self, call: _Call, spent_usd: float | None) -> None:
        if self.budget is not None:
            await self.budget.ledger.settle(
                call.request.key, call.attempts, call.aside_usd, spent_usd
            )
            self.budget.settled(call.order, call.aside_usd if spent_usd == 0 else 0.0)

    def _tell_overrun(self, call: _Call, spent_usd: float | None) -> None:
        if self.budget is None or (spent_usd or 0.0) <= call.aside_usd + TOLERANCE_USD:
            return
        self.meter.notes.append(
            f"{self.driver}: {_who(call.request.slot)}: the reply cost {spent_usd:.4f} USD, and "
            f"{call.aside_usd:.4f} were set aside for it: the server does not keep to the cap of "
            f"{self.entry.max_output_tokens} output tokens. More is set aside from now on"
        )

    def _give_up_on_nobody(self, call: _Call) -> None:
        """Where nothing was ever answered and nobody listens, waiting helps for seconds at most."""
        waited_s = asyncio.get_running_loop().time() - call.began
        if (
            not self.first.passed
            and call.attempts[-1].outcome == "no_connection"
            and waited_s >= NOBODY_S
        ):
            raise EndpointRefused(
                f"{self.driver}: nobody answers there ({_last_failure(call)}): check the network, "
                f"or {set_base_url(self.name, self.entry)}"
            )

    def _check_endpoint(self, raw: RawReply, verdict: Verdict) -> None:
        """End the run at its first call where no other one would fare better."""
        if not self.first.passed:
            why = refusal(self.name, self.entry, raw, verdict)
            if why is not None and self.first.is_final(verdict):
                raise EndpointRefused(f"{self.driver}: {why}")
        if verdict.action == "accept":
            self.first.answered()

    def _act_on(self, verdict: Verdict, call: _Call) -> None:
        attempts = call.attempts[call.earlier :]
        message = verdict.message or verdict.outcome
        delay_s = verdict.delay_s or 0.0
        if verdict.pause and delay_s > self.entry.deadline_s:
            raise QuotaExhausted(
                f"{self.driver}: the provider asks to wait {delay_s:.0f} s, longer than a "
                f"call's deadline of {self.entry.deadline_s:.0f} s ({message}). Every reply so far "
                "is saved; run the same command again later to go on."
            )
        if verdict.pause:
            pause_s = verdict.delay_s or backoff_s(len(attempts))
            self.limiter.pause(pause_s)
            until = datetime.now(UTC) + timedelta(seconds=pause_s)
            self.meter.notes.append(
                f"{self.driver}: all its calls wait {pause_s:.1f} s, until {until:%H:%M:%S} UTC: "
                f"{message}"
            )
        if verdict.action == "retry":
            raise TryAgain(message, verdict.delay_s)
        if verdict.action == "fail":
            which = "reply" if verdict.outcome == "reply_refused" else "request"
            raise RequestFailed(f"the {which} was rejected")
        if verdict.action == "quota":
            raise QuotaExhausted(
                f"{self.driver}: the account's quota is exhausted ({message}). Every reply so far "
                "is saved; when there is credit again, run the same command to go on."
            )
        if verdict.action == "refused":
            raise EndpointRefused(f"{self.driver}: {self._refusal_advice(verdict)} ({message})")
        empty_again = verdict.outcome == "empty" and FORMATS[self.entry.format].retries_empty
        if empty_again and sum(a.outcome == "empty" for a in attempts) <= EMPTY_RETRIES:
            raise TryAgain("empty answer")

    def _refusal_advice(self, verdict: Verdict) -> str:
        if verdict.outcome == "not_allowed":
            return f"the endpoint does not accept the key; {set_key(self.name, self.entry)}"
        if verdict.outcome == "bad_certificate":
            return (
                "the endpoint's certificate cannot be trusted, and nothing was sent; check the "
                "base URL, or set SSL_CERT_FILE to the certificates of who signed it"
            )
        shutdown = self.entry.shutdown
        retired = f", which was announced to shut down on {shutdown}" if shutdown else ""
        other = "" if self._own_host else f", or {set_base_url(self.name, self.entry)}"
        return f"the endpoint has no model {self.entry.id!r}{retired}; see {MODELS}{other}"

    @property
    def _own_host(self) -> str | None:
        """The provider whose own host is asked; None: another server in its format."""
        return self.entry.provider if self.endpoint == self.entry.provider else None

    def _record(self, number: int, raw: RawReply, verdict: Verdict, worst: Usage) -> Attempt:
        usage = verdict.reading.usage
        return Attempt(
            number=number,
            outcome=verdict.outcome,
            http_status=raw.status,
            model_served=verdict.reading.model_served,
            finish_reason=verdict.reading.finish_reason,
            usage=usage,
            reply=raw.body,
            error=verdict.message,
            cost_usd=self._cost_usd(raw, usage, worst),
            scripted=SCRIPTED_HEADER in raw.headers or says_scripted(raw.body),
        )

    def _cost_usd(self, raw: RawReply, usage: Usage, worst: Usage) -> float | None:
        """What a reply cost: by its usage, also in an error; None where that is not known.

        More output than there can be is charged, whatever the server says of the input.
        """
        if self.entry.price == "free":
            return 0.0
        if usage.input_tokens and usage.output_tokens is not None:
            return self.pricing.cost_usd(usage)
        if (usage.output_tokens or 0) > (worst.output_tokens or 0):
            return self.pricing.cost_usd(
                Usage(input_tokens=worst.input_tokens, output_tokens=usage.output_tokens)
            )
        stray = raw.status == 200 and is_web_page(raw) and not self.first.known
        return 0.0 if stray or not may_be_charged(raw, self._own_host) else None

    def _worst_case(self, request: ChatRequest) -> Usage:
        """An upper bound on a request's tokens: no tokeniser makes more tokens than bytes."""
        return Usage(
            input_tokens=len(request.body.encode()), output_tokens=self.entry.max_output_tokens
        )

    def _settle_tokens(self, permit: Turn, usage: Usage) -> None:
        if usage.output_tokens is not None:
            permit.settle((usage.input_tokens or 0) + usage.output_tokens)

    def _reply(self, entry: Entry, earlier: int) -> ChatReply:
        last = entry.attempts[-1]
        payload: Any = json.loads(last.reply or "{}")
        text = FORMATS[self.entry.format].read(payload).text if last.http_status == 200 else ""
        return ChatReply(
            text=text,
            outcome=last.outcome,
            request=entry.request,
            attempts=entry.attempts,
            earlier=earlier,
        )


def _estimated_tokens(worst: Usage) -> int:
    """What the provider charges at admission: about four bytes a token, and the output cap."""
    return (worst.input_tokens or 0) // 4 + (worst.output_tokens or 0)


def _timed(attempt: Attempt, started_at: datetime, latency_s: float) -> Attempt:
    return replace(
        attempt,
        started_at=started_at.isoformat(timespec="milliseconds"),
        latency_s=round(latency_s, 4),
    )


def _who(slot: Slot) -> str:
    """A slot for a reader."""
    return f"{slot.condition} rep {slot.repetition} {slot.side}, decision {slot.decision}"


def _last_failure(call: _Call) -> str:
    last = call.attempts[-1]
    return last.error or last.outcome
