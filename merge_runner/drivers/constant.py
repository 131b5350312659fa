"""The sanity floor: keeps its speed, and so collides with its like in every condition."""

from __future__ import annotations

from dataclasses import dataclass

from merge_runner.drivers.base import Seat
from merge_runner.drivers.registry import PROGRAMS, Program
from merge_runner.records import Decision, Observation


@dataclass(frozen=True, slots=True)
class ConstantDriver:
    """Keeps its speed where there is no resistance."""

    seat: Seat

    async def decide(self, observation: Observation, number: int) -> Decision:
        """Accelerate by nothing."""
        return self.seat.held(0.0)


PROGRAMS.register("constant", Program(ConstantDriver, "keeps its speed"))
