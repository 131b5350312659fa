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
    repetitions = {
        variant: min(wanted, held.repetitions[variant])
        for variant, wanted in plan.repetitions.items()
        if held.repetitions.get(variant)
    }
    conditions = tuple(one for one in plan.conditions if one in held.conditions)
    part = replace(plan, repetitions=repetitions, conditions=conditions)
    if not part.trials or part.trials == plan.trials:
        return plan, ""
    variants = ", ".join(f"{wanted} x {variant}" for variant, wanted in repetitions.items())
    return part, (
        f"note: what the recording holds is played: {variants} in {len(conditions)} conditions, "
        f"{part.trials} trials; the sweep {plan.name} has {plan.trials}"
    )
