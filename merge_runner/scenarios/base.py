"""What a scenario is: a driving task, and how a trial of it is played."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from inspect import isclass, isfunction
from typing import Protocol

from merge_runner.config import CollisionRule, ScenarioConfig
from merge_runner.errors import UsageError
from merge_runner.records import Observation, Side, StateRow, Status
from merge_runner.scenarios.merge.conditions import Condition
from merge_runner.scenarios.merge.geometry import Track
from merge_runner.source import source_digest


class World(Protocol):
    """One trial's vehicles, from the start of control to the end of the trial.

    ``status`` is None while the trial runs; ``step`` counts the steps since the start of control.
    """

    step: int
    status: Status | None

    @property
    def time_s(self) -> float:
        """The time since the start of control."""
        ...

    def in_control(self, side: Side) -> bool:
        """Whether the driver of this side is asked; until then the vehicle cruises by itself."""
        ...

    def observe(self, side: Side) -> Observation:
        """What the driver of this side sees now."""
        ...

    def advance(self, actions: dict[Side, float | None]) -> None:
        """Drive one step with normalised actions in [-1, 1]; None lets a vehicle cruise."""
        ...

    def merged_first(self) -> Side | None:
        """Who reached the merge point first; None after a collision or if nobody did."""
        ...

    def states(self) -> tuple[StateRow, ...]:
        """The trace, one row per vehicle and sample."""
        ...


MakeWorld = Callable[[ScenarioConfig, Condition, Track], World]
"""Raises UsageError for a condition that the track is too short for."""


@dataclass(frozen=True)
class Scenario:
    """A driving task.

    ``conditions`` are those that a sweep plays which names none. ``track`` is what worlds are made
    on, pictures are drawn on and measures are computed with. ``collision_rules`` are those that its
    worlds know. Raises UsageError where the source of ``make_world`` could not be told.
    """

    track: Track
    conditions: tuple[str, ...]
    collision_rules: tuple[CollisionRule, ...]
    make_world: MakeWorld

    def __post_init__(self) -> None:
        if not (isclass(self.make_world) or isfunction(self.make_world)):
            raise UsageError(
                f"{self.make_world!r} is no class or function: its source is not known"
            )

    @property
    def source(self) -> str | None:
        """The hash of the source of its worlds; None for the program's own.

        Their rules are covered by the version of the spec.
        """
        own = self.make_world.__module__.startswith(f"{__name__.partition('.')[0]}.")
        return None if own else source_digest(self.make_world)
