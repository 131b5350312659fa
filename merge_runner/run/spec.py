"""The id of a trial, and the spec that its hash covers."""

from __future__ import annotations

from typing import TYPE_CHECKING

from merge_runner.prompts.blocks import decomposed
from merge_runner.records import SIDES, Side, canonical_json
from merge_runner.scenarios.merge.conditions import MEAN_SPEED_MPS
from merge_runner.study.arms import FOCAL, OPPONENT, PROMPT, Arm
from merge_runner.text_safety import in_a_name
from merge_runner.trial_records import SPEC_VERSION

if TYPE_CHECKING:
    from merge_runner.run.plan import Plan


def trial_id(plan: Plan, arm: Arm, condition: str, repetition: int) -> str:
    """Return the id of a trial of an arm."""
    begin = "seat/" if plan.first else ""
    set_ = f"/set{plan.sample_set}" if plan.sample_set else ""
    # The prompt and the opponent are in it already.
    levels = "".join(
        f"/{name}={in_a_name(level)}"
        for name, level in sorted(arm.factors.items())
        if name not in (PROMPT, OPPONENT)
    )
    prompt, _ = decomposed(arm.variant)
    focal = f"/{FOCAL}={arm.focal}" if arm.focal else ""
    return f"{begin}{arm.model}/{prompt}/{condition}/rep{repetition:02d}{set_}{levels}{focal}"


def spec_text(plan: Plan, arm: Arm, condition: str) -> str:
    """Return the canonical JSON of what determines a trial of an arm.

    It leaves out the condition's headway and relative velocity. These are columns of the trial's
    row, where a change of them is refused; the mean speed is no column, and so part of the spec.
    """
    mean_speed_mps = plan.parts.conditions[condition].mean_speed_mps
    spec: dict[str, object] = {
        "spec_version": SPEC_VERSION,
        "scenario": arm.scenario.model_dump(),
        "prompt_blocks": _prompt_blocks(plan, arm),
        "left": _driver(plan, arm, "left"),
        "right": _driver(plan, arm, "right"),
        "sample_set": plan.sample_set,
    }
    if mean_speed_mps != MEAN_SPEED_MPS:
        spec["mean_speed_mps"] = mean_speed_mps
    return canonical_json(spec)


def _prompt_blocks(plan: Plan, arm: Arm) -> dict[str, str]:
    """Return the digests of the prompt's blocks; a block of one driver alone names its side."""
    digests = {side: plan.parts.prompts[name].digests for side, name in arm.read_prompts.items()}
    if len(digests) < len(SIDES):
        return next(iter(digests.values()), {})
    both = digests["left"].items() & digests["right"].items()
    return dict(both) | {
        f"{name}@{side}": digest
        for side, blocks in digests.items()
        for name, digest in blocks.items() - both
    }


def _driver(plan: Plan, arm: Arm, side: Side) -> dict[str, object]:
    name = arm.full_names[side]
    entry = arm.entries.get(name)
    if entry is None:
        return plan.parts.programs[name].in_spec(name)
    sent = plan.parts.formats[entry.format].request(entry, "")
    return {
        "endpoint": plan.endpoints[name],
        "path": sent.path,
        "headers": sent.headers,
        "body": sent.body,
    }
