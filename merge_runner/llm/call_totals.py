"""What recorded calls cost and took, by model, endpoint and how the model was asked."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass

from merge_runner.llm.cache import CachedCall
from merge_runner.llm.content_hashes import manner, without_prompt
from merge_runner.records import is_scripted


@dataclass(slots=True)
class CallTotals:
    """Sums over the answers that state their tokens and are the model's own, no mock model's.

    ``measured`` is their number; ``untimed`` of them have no latency: a batch tells none.
    """

    measured: int = 0
    input_tokens: int = 0
    output_tokens: int = 0
    latency_s: float = 0.0
    untimed: int = 0

    @property
    def mean_latency_s(self) -> float | None:
        """The mean over the answers that have one; None: none has."""
        timed = self.measured - self.untimed
        return self.latency_s / timed if timed else None

    def add(self, entry: CachedCall) -> None:
        """Count an entry."""
        last = entry.attempts[-1]
        if entry.request.provider != "emulator" and is_scripted(entry.request, last):
            return
        if last.usage.input_tokens is not None and last.usage.output_tokens is not None:
            self.measured += 1
            self.untimed += last.latency_s is None
            self.input_tokens += last.usage.input_tokens
            self.output_tokens += last.usage.output_tokens
            self.latency_s += last.latency_s or 0.0


def call_totals(entries: Iterable[CachedCall]) -> dict[tuple[str, str, str], CallTotals]:
    """Return the totals by model, endpoint and request template (see content_hashes.manner)."""
    totals: defaultdict[tuple[str, str, str], CallTotals] = defaultdict(CallTotals)
    for entry in entries:
        request = entry.request
        asked = manner(request.path, without_prompt(request.body))
        totals[request.model, request.endpoint, asked].add(entry)
    return totals
