"""The program ``constant``, the floor: against itself it collides in every condition."""

from __future__ import annotations

from dataclasses import dataclass

from merge_runner.drivers.base import DriverContext
from merge_runner.drivers.registry import PROGRAMS, Program
from merge_runner.records import Decision, Observation


@dataclass(frozen=True, slots=True)
class ConstantDriver:
    """Driver that never accelerates: without resistance it keeps its speed."""

    context: DriverContext

    async def decide(self, observation: Observation, number: int) -> Decision:
        """Hold an action of 0."""
        return self.context.held(0.0)


PROGRAMS.register("constant", Program(ConstantDriver, "keeps its speed"))
