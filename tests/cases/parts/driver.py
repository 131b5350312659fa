"""Two impulsive drivers: undecided before the merge point, and steady from 20 m before it on."""

from dataclasses import dataclass, field
from random import Random

from merge_runner.plugin import PROGRAMS, Decision, DriverContext, Observation, Program


@dataclass
class ImpulsiveDriver:
    """Holds a random acceleration until its next decision."""

    context: DriverContext
    chance: Random = field(init=False)

    def __post_init__(self) -> None:
        self.chance = Random(self.context.seed)

    async def decide(self, observation: Observation, number: int) -> Decision:
        """Draw an acceleration, or keep the speed."""
        distance_m = observation.distance_to_merge_m
        if distance_m is None or distance_m < self.context.number("steady_from_m"):
            return self.context.held(0.0)
        strength = self.context.number("strength")
        return self.context.held(self.chance.uniform(-strength, strength))


for name, rate_hz in (("impulsive", 20.0), ("hesitant", 5.0)):
    PROGRAMS.register(
        name,
        Program(
            ImpulsiveDriver,
            "accelerates at random until it is close to the merge point",
            {"steady_from_m": 20.0, "strength": 0.5},
            rate_hz,
            settable=True,
            chance=True,
        ),
    )
