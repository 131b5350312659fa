"""Recorded replies of one model: a replay has no others, and a live run looks them up first."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Protocol

from merge_runner.drivers.language_model import Question
from merge_runner.errors import RecordingError
from merge_runner.llm.attempts import Meter
from merge_runner.llm.formats.wire import WireFormat, read_reply
from merge_runner.llm.store import CachedCall
from merge_runner.providers import ModelEntry
from merge_runner.records import (
    ANSWERS,
    CallFailed,
    ChatReply,
    ChatRequest,
    Decision,
    ReplayMiss,
    Slot,
    is_scripted,
    make_request,
    reply_object,
)


class RecordedCalls(Protocol):
    """Recorded calls by key."""

    def get(self, key: str, request: ChatRequest) -> CachedCall | None:
        """Return the call with the key of a request.

        Raises RecordingError for a damaged one, and CallFailed for one that has failed.
        """
        ...

    def in_recording(self, key: str) -> bool:
        """Return whether a recording that the user named holds the call with this key."""
        ...


@dataclass(slots=True)
class RecordedReplies:
    """Replies of a plan's model ``name`` at an endpoint, recorded in ``calls``.

    The ``meter`` counts the replies that a trial uses.
    """

    name: str
    entry: ModelEntry
    endpoint: str
    wire: WireFormat
    calls: RecordedCalls
    meter: Meter = field(default_factory=Meter)
    own_names: frozenset[str | None] = field(init=False)

    def __post_init__(self) -> None:
        self.own_names = frozenset({None, self.entry.id, *self.entry.aliases})

    def answer(self, question: Question) -> Decision:
        """Return the decision of the recorded reply; raise ReplayMiss or CallFailed."""
        prompt, request = self.request_of(question)
        try:
            stored = self.calls.get(request.key, request)
        except RecordingError as exc:
            raise CallFailed(f"{self.name}: call {request.key}: {exc}", request) from exc
        if stored is None:
            raise ReplayMiss("no recorded reply", request)
        reply = self.read(stored)
        self.count_reply(reply)
        return question.decision(prompt, reply)

    def request_of(self, question: Question) -> tuple[str, ChatRequest]:
        """Return the prompt of a question, or its older wording if only that is recorded.

        The second result is the request with this prompt.
        """
        prompt, older = question.prompt, question.older
        request = self.request(prompt, question.slot)
        if older is not None and not self._is_recorded(request):
            older_request = self.request(older, question.slot)
            if self._is_recorded(older_request):
                return older, older_request
        return prompt, request

    def _is_recorded(self, request: ChatRequest) -> bool:
        """Return whether a reply is recorded, also a damaged or invalid one."""
        try:
            return self.calls.get(request.key, request) is not None
        except (RecordingError, CallFailed):
            return True

    def request(self, prompt: str, slot: Slot) -> ChatRequest:
        """Return the request for a slot."""
        sent = self.wire.request(self.entry, prompt)
        return make_request(
            provider=self.entry.provider,
            endpoint=self.endpoint,
            model=self.entry.id,
            path=sent.path,
            headers=sent.headers,
            body=sent.body,
            slot=slot,
        )

    def read(self, stored: CachedCall) -> ChatReply:
        """Read a recorded reply by the present rules, not by its run's, as an audit does."""
        attempts, last = stored.attempts, stored.attempts[-1]
        payload = reply_object(last.reply or "{}") if last.http_status == 200 else {}
        reading = read_reply(self.wire, payload)
        differs = (reading.outcome, reading.usage) != (last.outcome, last.usage)
        if payload and reading.outcome in ANSWERS and differs:
            last = replace(last, outcome=reading.outcome, usage=reading.usage)
            attempts = (*attempts[:-1], last)
        return ChatReply(reading.text, last.outcome, stored.request, attempts, len(attempts))

    def count_reply(self, reply: ChatReply, *, shared: bool = False) -> None:
        """Count a reply that a trial uses, and its model where another one was asked for.

        ``shared``: this run has sent its call for another trial.
        """
        last, meter = reply.attempts[-1], self.meter
        cached = reply.cached_attempts == len(reply.attempts)
        meter.calls_cached += cached
        meter.calls_live += not cached
        meter.calls_shared += cached and shared
        known = cached and not shared
        meter.calls_recorded += known and self.calls.in_recording(reply.request.key)
        if last.model_served not in self.own_names:
            meter.mismatches[f"{self.entry.id} -> {last.model_served}"] += 1
        if self.entry.provider != "emulator":
            meter.mock_replies += is_scripted(reply.request, last)
