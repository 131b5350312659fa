"""Retries of a call, with backoff, until its deadline."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import partial

from merge_runner.llm.attempts import Meter
from merge_runner.llm.call import Call, Calls, Wait
from merge_runner.llm.delays import TryAgain, next_wait_s
from merge_runner.llm.endpoint_state import EndpointState
from merge_runner.llm.probe import LONG_WAIT_S
from merge_runner.records import ChatReply


@dataclass(slots=True)
class Retry:
    """Further attempts at a call, with backoff, until one brings an answer."""

    endpoint: EndpointState
    calls: Calls
    meter: Meter

    async def until_answered(
        self,
        call: Call,
        failures: list[TryAgain],
        attempt: Callable[[Call], Awaitable[ChatReply]],
    ) -> ChatReply:
        """Retry a call after the failure in ``failures``, which is removed; return the answer."""
        # Only here, since it costs time and memory that most calls need not spend.
        from tenacity import AsyncRetrying, retry_if_exception_type

        async def next_attempt() -> ChatReply:
            if failures:
                raise failures.pop()
            return await attempt(call)

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
        """Wait before the next attempt of a call."""
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
