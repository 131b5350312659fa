"""Planted effects of the emulator, to rehearse an analysis on a known truth."""

from __future__ import annotations

import math
from typing import Annotated, Self

from pydantic import BaseModel, ConfigDict, Field, JsonValue

PREFIX = "x_"

# The bounds keep every logit finite.
Number = Annotated[float, Field(strict=True, ge=-1e6, le=1e6)]
NotNegative = Annotated[float, Field(strict=True, ge=0, le=1e6)]
Exponent = Annotated[float, Field(strict=True, ge=-10, le=10)]
Temperature = Annotated[float, Field(strict=True, ge=0, le=10)]
# Left out if 0, so that random draws of older effects do not change.
OfOneDriver = Annotated[Number, Field(exclude_if=lambda value: value == 0.0)]


class Persona(BaseModel):
    """Changes for prompts that contain the ``text``; each number is added to its namesake."""

    model_config = ConfigDict(frozen=True, extra="forbid", defer_build=True)

    text: Annotated[str, Field(min_length=1)]
    x_left_first: Number = 0.0
    x_headway: Number = 0.0
    x_relative_speed: Number = 0.0
    x_gap_m: Number = 0.0


class PlantedEffect(BaseModel):
    """Merge-order model of the emulator.

    logit P(left first) = k (x_left_first + x_headway h + x_relative_speed dv), where h is
    the projected headway in m, dv the relative speed in m/s, both left minus right, and
    k = exp(-x_temperature (T - 1)) at the request's ``temperature`` T. Defaults are the humans'
    (arXiv 2604.09609, Table III). ``x_noise`` is the standard deviation of the noise on the logit
    of each trial; it attenuates the coefficients of a regression. ``x_gap_m`` is added to the gap
    that both drivers aim at. ``x_own_first`` is added to the log-odds that the prompted driver goes
    first, ``x_other_first`` to its opponent's log-odds.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", defer_build=True)

    x_left_first: Number = -0.30
    x_headway: Number = 1.11
    x_relative_speed: Number = -3.30
    x_temperature: Exponent = 0.0
    x_noise: NotNegative = 0.0
    x_gap_m: Number = 0.0
    x_own_first: OfOneDriver = 0.0
    x_other_first: OfOneDriver = 0.0
    x_persona: Persona | None = None
    temperature: Temperature = 1.0

    def before(self, prompt: str, sign: int = 1) -> Self:
        """Return the effect on the reader of a prompt as one of the left driver, personas applied.

        ``sign`` is 1 if the reader is on the left and -1 on the right.
        """
        persona, added = self.x_persona, {}
        if persona is not None and persona.text in prompt:
            added = persona.model_dump(exclude={"text"})
        changed = {name: getattr(self, name) + more for name, more in added.items()}
        own_first = sign * self.lead
        update = {**changed, "x_persona": None, "x_own_first": own_first, "x_other_first": 0.0}
        return self.model_copy(update=update)

    @property
    def lead(self) -> float:
        """Change of the log-odds that the prompted driver goes first."""
        return self.x_own_first - self.x_other_first

    @property
    def coefficients(self) -> tuple[float, float, float]:
        """Coefficients of the left driver's logit without noise: intercept, h, dv."""
        k = math.exp(-self.x_temperature * (self.temperature - 1))
        return k * (self.x_left_first + self.lead), k * self.x_headway, k * self.x_relative_speed


PARAMETERS = frozenset(name for name in PlantedEffect.model_fields if name.startswith(PREFIX))
"""The parameters of a request that plant an effect."""


def planted_fields(parameters: dict[str, JsonValue]) -> dict[str, JsonValue]:
    """Return the parameters of a request that plant an effect; empty without one."""
    planted = {name: value for name, value in parameters.items() if name.startswith(PREFIX)}
    if planted and "temperature" in parameters:
        planted["temperature"] = parameters["temperature"]
    return planted
