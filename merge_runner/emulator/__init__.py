"""The emulator: a mock model in the place of a provider, with a scripted driver behind it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from merge_runner.chance import draw


@dataclass(frozen=True, kw_only=True)
class Behaviour:
    """How the emulator answers, and how often it fails.

    ``rates`` are the probabilities of errors per attempt: ``rate_limit``, ``server_error``,
    ``overloaded``, and ``malformed`` for prose without a plan. Every answer takes ``latency_s``. A
    rate limit asks to wait ``delay_s``. An answer has about ``output_tokens`` with its
    reasoning, or a few hundred.
    """

    rates: Mapping[str, float] = field(default_factory=dict)
    latency_s: float = 0.0
    delay_s: float = 0.05
    output_tokens: int | None = None
    seed: int = 0

    def fault(self, where: str, attempt: int) -> str | None:
        """Return what goes wrong with an attempt; ``where`` names the request."""
        chance = draw("fault", self.seed, where, attempt)
        for fault, rate in self.rates.items():
            chance -= rate
            if chance < 0:
                return fault
        return None
