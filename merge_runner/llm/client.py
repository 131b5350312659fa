"""The client of one model: cache, then retry, then limiter, then transport."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from typing import Any

from merge_runner.config import ModelEntry
from merge_runner.errors import CallFailed, EndpointRefused, QuotaExhausted, RecordingError
from merge_runner.llm.budget import Budget
from merge_runner.llm.cache import Entry, ResponseCache
from merge_runner.llm.formats import FORMATS
from merge_runner.llm.keys import make_request
from merge_runner.llm.limiter import Limiter, Permit
from merge_runner.llm.meter import Meter
from merge_runner.llm.prices import Pricing
from merge_runner.llm.retry import (
    OutOfTime,
    RequestFailed,
    TryAgain,
    backoff_s,
    call_with_retries,
)
from merge_runner.llm.transport import Transport, TransportFailure
from merge_runner.llm.verdicts import RawReply, Verdict, judge
from merge_runner.records import Attempt, ChatReply, ChatRequest, Slot, Usage

EMPTY_RETRIES = 2
SHOWN_PAUSE_S = 1.0


@dataclass(frozen=True, slots=True)
class Turn:
    """Leave to make one attempt: a place under the limits, and the money set aside for it."""

    permit: Permit
    reserved_usd: float


@dataclass(slots=True)
class LlmClient:
    """Answers prompts of one model.

    ``endpoint`` is the identity that enters the keys. A call that is under way is shared by all
    who ask for the same key, and goes on when they are cancelled, so that what is paid for is
    kept; ``drain`` waits for it.
    """

    name: str
    entry: ModelEntry
    endpoint: str
    cache: ResponseCache
    transport: Transport
    limiter: Limiter
    pricing: Pricing
    budget: Budget = field(default_factory=Budget)
    meter: Meter = field(default_factory=Meter)
    _calls: dict[str, asyncio.Task[Entry]] = field(default_factory=dict)
    _waiting: set[str] = field(default_factory=set)
    _stopping: bool = False

    async def ask(self, prompt: str, slot: Slot, *, order: int = 0) -> ChatReply:
        """The model's reply for a slot; lower ``order`` is served first. Raises CallFailed."""
        request = self._request(prompt, slot)
        try:
            entry = self.cache.get(request.key)
        except RecordingError as exc:
            raise CallFailed(f"{self.name}: call {request.key}: {exc}", request) from exc
        cached = entry is not None
        if entry is None:
            call = self._calls.get(request.key)
            cached = call is not None
            entry = await asyncio.shield(call or self._start(request, order))
        reply = self._reply(entry, cached=cached)
        self.meter.count_reply(reply, frozenset({self.entry.id, *self.entry.aliases}))
        return reply

    async def drain(self) -> None:
        """Let attempts in flight end and be saved, and give up calls that wait for one."""
        self._stopping = True
        for key in self._waiting:
            self._calls[key].cancel()
        await asyncio.gather(*self._calls.values(), return_exceptions=True)

    @property
    def flying(self) -> int:
        """How many calls are in flight or being saved."""
        return len(self._calls) - len(self._waiting)

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

    def _start(self, request: ChatRequest, order: int) -> asyncio.Task[Entry]:
        call = asyncio.create_task(self._call(request, order))
        self._calls[request.key] = call

        def forget(done: asyncio.Task[Entry]) -> None:
            del self._calls[request.key]
            if not done.cancelled():
                done.exception()  # all who asked may be gone by now

        call.add_done_callback(forget)
        return call

    async def _call(self, request: ChatRequest, order: int) -> Entry:
        """Make attempts until there is an answer, and save it with all of them."""
        attempts: list[Attempt] = []
        worst = self._worst_case(request)

        async def take_turn() -> Turn:
            with self._giving_way(request):
                worst_usd = self.pricing.cost_usd(worst) or 0.0
                # Money first: a permit must be used when it is given, or the limits do not hold.
                await self.budget.reserve(worst_usd)
                turn: Turn | None = None
                try:
                    permit = await self.limiter.acquire(_estimated_tokens(worst), order=order)
                    turn = Turn(permit, worst_usd)
                finally:
                    if turn is None:
                        self.budget.settle(worst_usd, 0.0)
                return turn

        async def attempt(turn: Turn, number: int, seconds_left: float) -> None:
            await self._attempt(request, turn, number, seconds_left, attempts)

        async def sleep(seconds: float) -> None:
            with self._giving_way(request):
                await asyncio.sleep(seconds)

        try:
            await call_with_retries(
                take_turn, attempt, deadline_s=self.entry.deadline_s, sleep=sleep
            )
        except (OutOfTime, RequestFailed) as exc:
            reason = attempts[-1].error or attempts[-1].outcome
            raise CallFailed(
                f"{self.name}: {exc} ({reason}), {len(attempts)} attempts",
                request,
                tuple(attempts),
            ) from exc
        return await self.cache.put(Entry(request, tuple(attempts)))

    @contextmanager
    def _giving_way(self, request: ChatRequest) -> Iterator[None]:
        """Within this, nothing of the call is in flight, so that a drain gives it up."""
        if self._stopping:
            raise CallFailed("the sweep was stopped", request)
        self._waiting.add(request.key)
        try:
            yield
        finally:
            self._waiting.discard(request.key)

    async def _attempt(
        self,
        request: ChatRequest,
        turn: Turn,
        number: int,
        seconds_left: float,
        attempts: list[Attempt],
    ) -> None:
        """One attempt, appended to ``attempts``; returns if it is the answer."""
        started_at, started = datetime.now(UTC), time.perf_counter()
        spent: float | None = None
        try:
            raw = await self.transport.send(
                request, attempt=number, timeout_s=min(self.entry.timeout_s, seconds_left)
            )
            verdict = judge(raw, FORMATS[self.entry.format])
            record = self._record(number, raw, verdict)
            # A failed request is not charged; an answer without usage may be.
            spent = record.cost_usd if raw.status == 200 else 0.0
            self._settle_tokens(turn.permit, record.usage)
        except TransportFailure as exc:
            verdict = None
            record = Attempt(number, exc.outcome, error=str(exc))
        finally:
            self.budget.settle(turn.reserved_usd, spent)
        record = _timed(record, started_at, time.perf_counter() - started)
        attempts.append(record)
        self.meter.count_attempt(record)
        if verdict is None:
            raise TryAgain(record.error or record.outcome)
        self._act_on(verdict, attempts)

    def _act_on(self, verdict: Verdict, attempts: list[Attempt]) -> None:
        message = verdict.message or verdict.outcome
        if verdict.delay_s and verdict.delay_s > self.entry.deadline_s:
            raise QuotaExhausted(
                f"{self.name}: the provider asks to wait {verdict.delay_s:.0f} s, longer than a "
                f"call's deadline of {self.entry.deadline_s:.0f} s ({message}). Every reply so far "
                "is saved; run the same command again later to go on."
            )
        if verdict.pause:
            pause_s = verdict.delay_s or backoff_s(len(attempts))
            self.limiter.pause(pause_s)
            if pause_s >= SHOWN_PAUSE_S:
                self.meter.notes.append(
                    f"{self.name}: rate limit, all its calls wait {pause_s:.1f} s"
                )
        if verdict.action == "retry":
            raise TryAgain(message, verdict.delay_s)
        if verdict.action == "fail":
            raise RequestFailed("the request was rejected")
        if verdict.action == "quota":
            raise QuotaExhausted(
                f"{self.name}: the account's quota is exhausted ({message}). Every reply so far "
                "is saved; when there is credit again, run the same command to go on."
            )
        if verdict.action == "refused":
            raise EndpointRefused(f"{self.name}: {self._refusal_advice(verdict)} ({message})")
        empty_again = verdict.outcome == "empty" and FORMATS[self.entry.format].retries_empty
        if empty_again and sum(a.outcome == "empty" for a in attempts) <= EMPTY_RETRIES:
            raise TryAgain("empty answer")

    def _refusal_advice(self, verdict: Verdict) -> str:
        if verdict.outcome == "not_allowed":
            return "the endpoint does not accept the key; check it"
        shutdown = self.entry.shutdown
        retired = f", which was announced to shut down on {shutdown}" if shutdown else ""
        return f"the endpoint has no model {self.entry.id!r}{retired}; see `merge-runner models`"

    def _record(self, number: int, raw: RawReply, verdict: Verdict) -> Attempt:
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
            cost_usd=self.pricing.cost_usd(usage) if raw.status == 200 else 0.0,
        )

    def _worst_case(self, request: ChatRequest) -> Usage:
        """An upper bound on a request's tokens: no tokeniser makes more tokens than bytes."""
        return Usage(
            input_tokens=len(request.body.encode()), output_tokens=self.entry.max_output_tokens
        )

    def _settle_tokens(self, permit: Permit, usage: Usage) -> None:
        if usage.output_tokens is not None:
            permit.settle((usage.input_tokens or 0) + usage.output_tokens)

    def _reply(self, entry: Entry, *, cached: bool) -> ChatReply:
        last = entry.attempts[-1]
        payload: Any = json.loads(last.reply or "{}")
        text = FORMATS[self.entry.format].read(payload).text if last.http_status == 200 else ""
        return ChatReply(
            text=text,
            outcome=last.outcome,
            request=entry.request,
            attempts=entry.attempts,
            cached=cached,
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
