"""Records of attempts at calls, and their counts for the display."""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING

from merge_runner.llm.ledger import TOLERANCE_USD
from merge_runner.records import SCRIPTED_HEADER, Attempt, says_scripted

if TYPE_CHECKING:
    from merge_runner.llm.budget import Reservation
    from merge_runner.llm.call import Call
    from merge_runner.llm.endpoint_state import EndpointState
    from merge_runner.llm.sender import Sent


@dataclass(slots=True)
class Meter:
    """Counts of calls, attempts and cost.

    ``calls_cached`` were answered without a request: ``calls_shared`` by a call of this run for
    another trial, ``calls_recorded`` by a recording that the user named, others by the cache.
    ``mock_replies`` counts replies that a mock model gave for this one, ``underpriced`` replies
    that cost more than the registry knows, by service tier. ``damaged`` are the keys of recorded
    replies in quarantine, ``notes`` lines for the user.
    """

    calls_live: int = 0
    calls_cached: int = 0
    calls_shared: int = 0
    calls_recorded: int = 0
    cost_usd: float = 0.0
    cost_unknown: int = 0
    outcomes: Counter[str] = field(default_factory=Counter)
    mismatches: Counter[str] = field(default_factory=Counter)
    mock_replies: int = 0
    underpriced: Counter[str] = field(default_factory=Counter)
    notes: deque[str] = field(default_factory=deque)
    damaged: list[str] = field(default_factory=list)

    @property
    def answered(self) -> tuple[int, int, int, int]:
        """Calls: live, cached, and of these shared and recorded."""
        return self.calls_live, self.calls_cached, self.calls_shared, self.calls_recorded

    def add(self, other: Meter) -> None:
        """Add the counts of another meter."""
        for name in (counted.name for counted in fields(self)):
            setattr(self, name, getattr(self, name) + getattr(other, name))


def record(
    call: Call,
    number: int,
    sent: Sent,
    usd: float | None,
    reservation: Reservation,
    endpoint: EndpointState,
    meter: Meter,
) -> Attempt:
    """Record and count attempt ``number`` of a call, which has just ended."""
    outcome = sent.outcome
    raw, reading = outcome.raw, outcome.reading
    attempt = Attempt(
        number=number,
        outcome=outcome.name,
        http_status=raw.status if raw else None,
        model_served=reading.model_served,
        finish_reason=reading.finish_reason,
        usage=reading.usage,
        reply=raw.body if raw else None,
        error=outcome.message,
        started_at=sent.began.isoformat(timespec="milliseconds"),
        latency_s=sent.took_s and round(sent.took_s, 4),
        cost_usd=usd,
        scripted=raw is not None and (SCRIPTED_HEADER in raw.headers or says_scripted(raw.body)),
        batch_id=sent.batch_id,
    )
    call.attempts.append(attempt)
    meter.outcomes[attempt.outcome] += 1
    meter.cost_usd += usd or 0.0
    meter.cost_unknown += usd is None
    if reading.service_tier in endpoint.underpriced_tiers:
        meter.underpriced[reading.service_tier] += 1
    # The reservation is 0 where a user has released it meanwhile.
    if reservation.usd and (usd or 0.0) > reservation.usd + TOLERANCE_USD:
        meter.notes.append(
            f"{endpoint.driver}: {call.label.slot}: the reply cost {usd:.4f} USD, and "
            f"{reservation.usd:.4f} were reserved for it: the server does not keep to the cap of "
            f"{endpoint.entry.max_output_tokens} output tokens. More is reserved from now on"
        )
    return attempt
