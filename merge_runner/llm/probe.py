"""Probe request: the first normal call of a run to a model is made alone."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta

from merge_runner.errors import SweepStopped
from merge_runner.llm.attempts import Meter
from merge_runner.llm.call import LONG_WAIT_S, Call, Calls, Wait
from merge_runner.llm.endpoint_state import EndpointState


@dataclass(slots=True)
class Probe:
    """Lock that serialises the calls to a model until its first accepted reply.

    So a wrong key, URL or parameter costs one call.
    """

    endpoint: EndpointState
    calls: Calls
    meter: Meter
    _alone: asyncio.Lock = field(default_factory=asyncio.Lock)

    @asynccontextmanager
    async def turn(self, call: Call) -> AsyncIterator[None]:
        """Wait until no other call probes. If the probe stops the run, no further call probes."""
        self.calls.wait(call, Wait(f"for the first reply of {self.endpoint.driver}"))
        await self._alone.acquire()
        call.wait = None
        if self.endpoint.verified:
            self._alone.release()
            yield
            return
        call.is_probe = True
        note = asyncio.get_running_loop().call_later(LONG_WAIT_S, self._note_wait, call)
        is_released = True
        try:
            yield
        except SweepStopped:
            is_released = False  # the next call would only be refused in the same way
            raise
        finally:
            note.cancel()
            if is_released:
                self._alone.release()

    def _note_wait(self, call: Call) -> None:
        driver, entry = self.endpoint.driver, self.endpoint.entry
        left = timedelta(seconds=entry.deadline_s - LONG_WAIT_S)
        last = f"after {call.last_failure}" if call.own_attempts else "nothing has come yet"
        self.meter.notes.append(
            f"{driver}: {call.label.slot}: the first call of this run waits for its reply "
            f"until {datetime.now(UTC) + left:%H:%M:%S} UTC, {last}"
        )
