"""The trials of a plan, and what their players call."""

from __future__ import annotations

from collections.abc import Awaitable, Callable

from merge_runner.drivers.base import MakeDriver
from merge_runner.drivers.language_model import LanguageModel
from merge_runner.errors import TrialSuspended
from merge_runner.records import SIDES
from merge_runner.run.plan import Plan
from merge_runner.trial import Trial
from merge_runner.trial_records import TrialRecord, TrialSpec

# Called with each trial that ends, or is suspended for lack of money.
Ended = Callable[[TrialSpec, TrialRecord | TrialSuspended], None]
# Awaited before a trial begins: returns once there is memory to hold the trial until it is stored.
Capacity = Callable[[], Awaitable[None]]


class TrialMaker:
    """Factory of the trials of a plan."""

    def __init__(self, plan: Plan) -> None:
        self.arms = plan.by_label()
        models = {name: LanguageModel(name, plan.parts.prompts) for name in plan.entries}
        self._drivers: dict[str, MakeDriver | LanguageModel] = {**plan.parts.programs, **models}

    def make(self, spec: TrialSpec) -> Trial:
        """Return a trial before its first decision."""
        arm = self.arms[spec.arm]
        drivers = {
            side: self._drivers[arm.full_names[side]].make(arm.scenario, spec, side)
            for side in SIDES
        }
        return Trial(spec, arm.scenario, drivers)
