"""The spec of a trial, for tests that need one."""

from dataclasses import replace

from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner.trial_records import TrialSpec


def spec_of(condition: str = "L_4_0", **changes: object) -> TrialSpec:
    """The first trial of a condition, for which two drivers are named m."""
    named = (f"m/baseline/{condition}/rep01", "h", "driver", "m", "m", "baseline", condition)
    kinematics = CONDITIONS[condition]
    return replace(TrialSpec(*named, 1, 0, 0, kinematics=kinematics), **changes)
