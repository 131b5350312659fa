"""What goes wrong on purpose, each fault a function of the seed, the slot and the attempt."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from merge_runner.chance import draw

# A sweep with these ends like one without; answers that are ``empty`` or ``malformed`` are kept.
TRANSIENT = (
    "rate_limit",
    "request_timeout",
    "conflict",
    "server_error",
    "bad_gateway",
    "overloaded",
    "hang",
    "reset",
    "truncated_body",
    "truncated_json",
)


@dataclass(frozen=True, kw_only=True)
class BatchPlan:
    """What becomes of batches; rates are probabilities per line, ``lost`` per creation.

    A line has its result within ``delay_s``; a batch ends with its last line, but not before its
    state was asked for ``polls`` times. A share ``failed`` of the lines ends with a 429, 500 or
    503 and ``expired`` without being asked. Of a share ``lost`` of the creations the answer is
    lost. While more than ``enqueued_tokens`` would wait, a batch is refused. Whoever asks for a
    file of results is told ``late_results`` times that there is none, and then gets half of it
    ``short_results`` times. Lists have the newest batch first, or with ``oldest_first`` the oldest.
    """

    delay_s: float = 0.0
    polls: int = 0
    failed: float = 0.0
    expired: float = 0.0
    lost: float = 0.0
    enqueued_tokens: int | None = None
    late_results: int = 0
    short_results: int = 0
    oldest_first: bool = False


@dataclass(frozen=True, kw_only=True)
class FaultPlan:
    """Rates of faults per attempt; a hang is silent for ``hang_s``, and then closes.

    Every answer takes ``latency_s``. A rate limit asks to wait ``delay_s``.
    """

    rates: Mapping[str, float] = field(default_factory=dict)
    latency_s: float = 0.0
    delay_s: float = 0.05
    seed: int = 0
    hang_s: float = 30.0
    batch: BatchPlan = field(default_factory=BatchPlan)

    def fault(self, where: str, attempt: int) -> str | None:
        """What goes wrong with an attempt; ``where`` names the request."""
        chance = draw("fault", self.seed, where, attempt)
        for fault, rate in self.rates.items():
            chance -= rate
            if chance < 0:
                return fault
        return None


def transient_faults(rate: float, seed: int) -> FaultPlan:
    """Every transient fault equally often, ``rate`` in all."""
    return FaultPlan(seed=seed, rates=dict.fromkeys(TRANSIENT, rate / len(TRANSIENT)))
