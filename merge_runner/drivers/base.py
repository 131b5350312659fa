"""What every driver is to a trial."""

from __future__ import annotations

from typing import Protocol

from merge_runner.records import Decision, Observation


class Driver(Protocol):
    """One vehicle's driver for one trial."""

    async def decide(self, observation: Observation, number: int) -> Decision:
        """Decide at the ``number``-th decision instant (from 0); raises CallFailed."""
        ...


def held(action: float, plan_actions: int, executed_actions: int) -> Decision:
    """A program's decision to hold one normalised acceleration over the whole horizon."""
    return Decision(plan=(action,) * plan_actions, applied=(action,) * executed_actions)
