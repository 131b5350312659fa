"""What carries a request: HTTP, or nothing at all in a sealed replay."""

from __future__ import annotations

from typing import Protocol

from merge_runner.errors import MergeRunnerError, ReplayMiss
from merge_runner.llm.http_outcome import Action, RawReply
from merge_runner.records import ChatRequest


class TransportFailure(MergeRunnerError):
    """An attempt brought no reply; ``outcome`` names the failure in the calls table.

    ``sent`` is False where the request was certainly never sent, so that nobody can charge for it.
    ``action`` is that of an AttemptOutcome.
    """

    def __init__(
        self, outcome: str, message: str, *, sent: bool = True, action: Action = "retry"
    ) -> None:
        super().__init__(message)
        self.outcome = outcome
        self.sent = sent
        self.action = action


class ErrorReply(MergeRunnerError):
    """The server replied with an error in place of what it was asked for."""

    def __init__(self, raw: RawReply) -> None:
        super().__init__(f"HTTP {raw.status}: {raw.error.message}")
        self.raw = raw


class Transport(Protocol):
    """Sends one attempt."""

    async def send(self, request: ChatRequest, *, attempt: int, timeout_s: float) -> RawReply:
        """The raw reply; raises TransportFailure."""
        ...


class SealedTransport:
    """Refuses every request, so that a replay stays offline."""

    async def send(self, request: ChatRequest, *, attempt: int, timeout_s: float) -> RawReply:
        """Raise ReplayMiss."""
        raise ReplayMiss("no recorded reply", request)
