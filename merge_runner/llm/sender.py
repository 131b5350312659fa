"""Senders of attempts; the direct one sends each as a normal (synchronous) request."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, NamedTuple

from merge_runner.errors import MergeRunnerError
from merge_runner.llm.budget import Reservation
from merge_runner.llm.call import Call, Wait
from merge_runner.llm.delays import backoff_s
from merge_runner.llm.formats.wire import WireFormat
from merge_runner.llm.http_outcome import AttemptOutcome, TransportFailure, judge
from merge_runner.llm.limiter import Limiter
from merge_runner.llm.prices import BYTES_A_TOKEN
from merge_runner.providers import ModelEntry

if TYPE_CHECKING:
    from merge_runner.llm.http import HttpTransport


class Sent(NamedTuple):
    """Outcome of an attempt; in a batch it has no ``took_s``, and an ``error`` ends the run."""

    outcome: AttemptOutcome
    began: datetime
    took_s: float | None = None
    batch_id: str | None = None
    error: MergeRunnerError | None = None


@dataclass(slots=True)
class DirectSender:
    """Sender of normal (synchronous) requests to one model, under its rate limits."""

    entry: ModelEntry
    wire: WireFormat
    transport: HttpTransport
    limiter: Limiter
    price_factor: float = 1.0

    async def send(self, call: Call, number: int, reservation: Reservation) -> Sent:
        """Wait for a turn, begin the reservation, send attempt ``number``, and judge its reply.

        Raises TrialSuspended where the money cannot be reserved.
        """
        # The wait comes first: a turn must be used at once, or the limits do not hold.
        call.wait = Wait("for a turn under the rate limits")
        # Providers count a request when they admit it, with the whole cap. In the worst case a byte
        # is a token.
        input_tokens = (call.worst.input_tokens or 0) // BYTES_A_TOKEN
        estimate = input_tokens + self.entry.max_output_tokens
        correct = await self.limiter.acquire(estimate, order=call.order)
        call.wait = None
        await reservation.begin(number)
        began, clock_s = datetime.now(UTC), asyncio.get_running_loop().time
        began_s, timeout_s = clock_s(), min(self.entry.timeout_s, call.left_s)
        try:
            raw = await self.transport.send(call.request, attempt=number, timeout_s=timeout_s)
            outcome = judge(raw, self.wire)
        except TransportFailure as exc:
            outcome = exc.outcome
        took_s = clock_s() - began_s
        call.left_s -= took_s
        usage = outcome.reading.usage
        if correct is not None and usage.output_tokens is not None:
            correct((usage.input_tokens or 0) + usage.output_tokens)
        if outcome.pause:
            self.limiter.pause(outcome.delay_s or backoff_s(len(call.own_attempts) + 1))
        return Sent(outcome, began, took_s)
