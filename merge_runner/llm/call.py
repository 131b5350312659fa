"""A call under way, what it waits for, and the calls of a run."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field
from datetime import datetime
from typing import TYPE_CHECKING, NamedTuple

from merge_runner.llm.ledger import CallLabel
from merge_runner.records import Attempt, CallFailed, ChatReply, ChatRequest, Usage

if TYPE_CHECKING:
    from merge_runner.llm.batch.lifecycle import Batch

LONG_WAIT_S = 5.0  # a shorter wait is over before a note of it is read


class Wait(NamedTuple):
    """A wait of a call, ``until`` a moment (UTC) or until something happens.

    ``blocked``: only the end of another call can end it. ``charged``: the reply may be billed
    already.
    """

    what: str
    until: datetime | None = None
    blocked: bool = False
    charged: bool = False


@dataclass(slots=True, eq=False)
class Call:
    """A call under way, shared by all who ask for its key.

    ``label`` names it and bounds the cost of an attempt, ``worst`` bounds its tokens. ``left_s``
    remains for its attempts and the waits between them; waits for the rate limiter do not count.
    ``attempts`` has all attempts, the first ``earlier_attempts`` by earlier runs. ``wait`` is None
    while it waits only for a reply or for the disk. ``task`` makes the call. ``trials`` has the
    orders of the trials that wait for it, ``order`` is the lowest of them. While ``is_probe``,
    other calls wait for it. ``bypass_batch`` is set after a batch without a result for it;
    ``pending_batch`` is the batch of an earlier run in which it waits. ``damaged``: the cache has a
    reply to it, or earlier attempts, that cannot be used.
    """

    request: ChatRequest
    order: int
    label: CallLabel
    worst: Usage
    left_s: float
    damaged: bool = False
    attempts: list[Attempt] = field(default_factory=list)
    earlier_attempts: int = 0
    wait: Wait | None = None
    trials: list[int] = field(default_factory=list)
    is_probe: bool = False
    bypass_batch: bool = False
    pending_batch: Batch | None = None
    given_up: bool = False
    task: asyncio.Task[ChatReply] = field(init=False)

    def give_up(self) -> None:
        """Cancel the call: who asks for its key from now on begins another one."""
        self.given_up = True
        self.task.cancel()

    @property
    def own_attempts(self) -> list[Attempt]:
        """Attempts of this run."""
        return self.attempts[self.earlier_attempts :]

    @property
    def empty(self) -> int:
        """Number of empty answers in this run."""
        return sum(attempt.outcome == "empty" for attempt in self.own_attempts)

    @property
    def last_failure(self) -> str:
        """Why the last attempt brought no answer."""
        return self.attempts[-1].error or self.attempts[-1].outcome


@dataclass(slots=True)
class Calls:
    """The calls of a run, shared by its clients: two names of one model may ask the same.

    ``under_way`` has the calls that are not answered yet by key, ``answered`` the keys of those
    that were answered. Once it is ``stopping``, no further attempt begins.
    """

    under_way: dict[str, Call] = field(default_factory=dict)
    answered: set[str] = field(default_factory=set)
    stopping: bool = False

    @property
    def waits(self) -> list[Wait]:
        """Waits of the calls that are not in flight."""
        return [call.wait for call in self.under_way.values() if call.wait is not None]

    @property
    def calls_in_flight(self) -> int:
        """Number of calls in flight or being saved."""
        return sum(call.wait is None for call in self.under_way.values())

    @property
    def blocked_askers(self) -> int:
        """Number of questions that wait for calls that are blocked on another call."""
        calls = self.under_way.values()
        return sum(len(call.trials) for call in calls if call.wait and call.wait.blocked)

    def wait(self, call: Call, wait: Wait) -> None:
        """Let a call wait, so that it can be cancelled; raise CallFailed if it is given up.

        It is in flight again when its ``wait`` is None. This is for waits outside attempts. The
        client checks the call before each attempt; within it ``wait`` is set directly.
        """
        if self.stopping or not call.trials:
            raise self.given_up(call)
        call.wait = wait

    def given_up(self, call: Call) -> CallFailed:
        """Return the error of a call that no running trial needs, or that a stopped run drops."""
        why = "the sweep was stopped" if self.stopping else "its trial has ended"
        return CallFailed(why, call.request)

    async def drain(self) -> None:
        """Let attempts in flight end and be saved, and cancel calls that wait."""
        self.stopping = True
        calls = [*self.under_way.values()]
        for call in calls:
            # An attempt in flight may be billed whether or not anybody waits for it.
            if call.wait is not None:
                call.give_up()
        await asyncio.gather(*(call.task for call in calls), return_exceptions=True)
