"""The seat of a program: with its parameters, and with what both sides can draw alike."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from merge_runner.drivers.base import Seat
from merge_runner.records import Decision
from merge_runner.scenarios.merge.vehicle import net_acceleration

Parameter = float | str


@dataclass(frozen=True, slots=True)
class ProgramSeat(Seat):
    """What a program is given for one side of one trial.

    ``condition`` and ``repetition`` (from 1) are those of the trial. ``other_seed`` is the ``seed``
    of the other side: whatever both sides draw from both seeds, they agree on. ``parameters`` are
    those of the program, as a study may have set them.
    """

    condition: str
    repetition: int
    other_seed: int
    parameters: Mapping[str, Parameter]

    @property
    def interval_s(self) -> float:
        """The time between two decisions."""
        return self.pace.interval_steps * self.scenario.step_s

    def number(self, name: str) -> float:
        """A parameter that is a number."""
        value = self.parameters[name]
        assert not isinstance(value, str), f"{name} is a text"
        return value

    def accelerating(self, net_mps2: float, speed_mps: float) -> Decision:
        """The decision to hold what gives this net acceleration at this speed, as far as it can."""
        resisted = net_acceleration(0.0, speed_mps, self.scenario.resistance)
        action = (net_mps2 - resisted) / self.scenario.max_acceleration_mps2
        return self.held(min(1.0, max(-1.0, action)))
