"""A replay of no more than its recordings hold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from merge_runner.results.recorded_study import recorded_part
from merge_runner.run.plan import Plan


def as_recorded(plan: Plan, recordings: Sequence[Path]) -> tuple[Plan, str]:
    """The part of a plan that recordings of the same sweep hold, and a line that says so.

    The line is empty, and the plan as it was, where they hold all of it, or say nothing of it.
    """
    held = recorded_part(recordings, plan.name, plan.model, plan.sample_set)
    if held is None:
        return plan, ""
    arms = tuple(
        replace(arm, repetitions=min(arm.repetitions, held.repetitions[arm.variant]))
        for arm in plan.arms
        if held.repetitions.get(arm.variant)
    )
    conditions = tuple(one for one in plan.conditions if one in held.conditions)
    if not arms or not conditions:
        return plan, ""
    part = replace(plan, arms=arms, conditions=conditions)
    if part.trials == plan.trials:
        return plan, ""
    variants = ", ".join(f"{wanted} x {variant}" for variant, wanted in part.repetitions.items())
    return part, (
        f"note: what the recording holds is played: {variants} in {len(conditions)} conditions, "
        f"{part.trials} trials; the sweep {plan.name} has {plan.trials}"
    )
