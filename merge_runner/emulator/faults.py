"""Deliberate faults, each a function of the seed, the slot and the attempt."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field, model_validator

from merge_runner.chance import draw, draw_between
from merge_runner.config import read_toml, validated
from merge_runner.errors import UsageError

Fault = Literal[
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
    "empty",
    "refused",
    "malformed",
]
FAULTS: tuple[Fault, ...] = get_args(Fault)
# These change what a trial records. All others are transient: a sweep with them, which asks again,
# ends like one without.
OUTCOMES: frozenset[Fault] = frozenset({"empty", "refused", "malformed"})
# The faults that are replies.
STATUS_FAULTS = {"request_timeout": 408, "conflict": 409, "server_error": 500, "overloaded": 503}
TRANSIENT: tuple[Fault, ...] = tuple(fault for fault in FAULTS if fault not in OUTCOMES)

Rate = Annotated[float, Field(ge=0, le=1)]
Seconds = Annotated[float, Field(ge=0)]


class BatchPlan(BaseModel):
    """What becomes of batches; rates are probabilities per line, ``lost`` per creation.

    A line has its result within ``delay_s``, and a share ``slow`` of them ``slow_factor`` times as
    late; a batch ends with its last line, but not before its state was asked for ``polls`` times.
    A share ``failed`` of the lines ends with a 429, 500 or 503 and ``expired`` without being asked.
    Of a share ``lost`` of the creations the answer is lost. While more than ``enqueued_tokens``
    would wait, a batch is refused. Whoever asks for a file of results is told ``late_results``
    times that there is none, and then gets half of it ``short_results`` times. Lists have the
    newest batch first, or with ``oldest_first`` the oldest.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    delay_s: Seconds = 0.0
    polls: Annotated[int, Field(ge=0)] = 0
    slow: Rate = 0.0
    slow_factor: Annotated[float, Field(ge=1)] = 10.0
    failed: Rate = 0.0
    expired: Rate = 0.0
    lost: Rate = 0.0
    enqueued_tokens: Annotated[int, Field(gt=0)] | None = None
    late_results: Annotated[int, Field(ge=0)] = 0
    short_results: Annotated[int, Field(ge=0)] = 0
    oldest_first: bool = False


class FaultPlan(BaseModel):
    """How often each fault occurs; ``rates`` are probabilities per attempt.

    ``latency_s`` delays every answer. ``delay_s`` is how long a rate limit asks to wait. A hang is
    silent for ``hang_s``, longer than a client's patience, and then closes. An answer has about
    ``output_tokens`` with its reasoning; a few hundred where it is not given. ``batch`` says what
    becomes of batches.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    seed: int = 0
    rates: dict[Fault, Rate] = {}
    latency_s: Seconds = 0.0
    delay_s: Seconds = 0.05
    hang_s: Seconds = 30.0
    output_tokens: Annotated[int, Field(gt=0)] | None = None
    batch: BatchPlan = BatchPlan()

    @model_validator(mode="after")
    def _at_most_one_fault(self) -> FaultPlan:
        if sum(self.rates.values()) > 1 + 1e-9:
            raise ValueError("the rates add up to more than 1")
        return self

    @property
    def identity(self) -> str:
        """What distinguishes the emulator's answers from those without faults: mostly nothing."""
        outcomes = {str(fault): self.rates[fault] for fault in sorted(OUTCOMES & self.rates.keys())}
        return f"#faults-{self.seed}-{outcomes}" if any(outcomes.values()) else ""

    def fault(self, where: str, attempt: int) -> Fault | None:
        """The fault of an attempt, None for none; ``where`` names the request."""
        chance = draw("fault", self.seed, where, attempt)
        for fault in FAULTS:
            chance -= self.rates.get(fault, 0.0)
            if chance < 0:
                return fault
        return None

    def wait_s(self, where: str, attempt: int) -> float:
        """The delay that a rate limit asks for."""
        return round(draw_between(0.5, 1.5, "delay", self.seed, where, attempt) * self.delay_s, 6)


def transient_faults(rate: float, seed: int) -> FaultPlan:
    """Every transient fault equally often, ``rate`` in all."""
    if not 0 <= rate <= 1:
        raise UsageError(f"--fault-rate {rate} is no probability between 0 and 1")
    return FaultPlan(seed=seed, rates=dict.fromkeys(TRANSIENT, rate / len(TRANSIENT)))


def load_faults(path: Path) -> FaultPlan:
    """A fault plan from a TOML file; raises UsageError."""
    return validated(FaultPlan, read_toml(path), str(path))
