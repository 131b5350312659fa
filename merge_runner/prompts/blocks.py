"""The prompt as named text blocks, C0 to C5 (arXiv 2604.09609, Table II), and its ablations.

The paper's own wording is not public: this is a reconstruction from its description. A variant
is the set of blocks that it leaves out, so that an ablation changes nothing else.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

from merge_runner.records import Road


@dataclass(frozen=True, slots=True)
class Block:
    """One paragraph of the prompt: its template per road type, None where it is left out."""

    name: str
    merge: str | None
    straight: str | None

    def template(self, road: Road) -> str | None:
        """The block's text on a road."""
        return self.merge if road == "merge" else self.straight

    @property
    def digest(self) -> str:
        """SHA-256 of both templates."""
        return hashlib.sha256(f"{self.merge}\0{self.straight}".encode()).hexdigest()


_HISTORY = """\
History of the last {memory_s} s, one value every {step_s} s, oldest first:
- Your executed accelerations (m/s^2): {own_accelerations}
- Observed speeds of the other car (m/s): {other_speeds}"""

_PREVIOUS_PLAN = "Previous plan (the part of it that has not been executed yet): {remaining_plan}"

_SAFETY = "Avoid a collision with the other car."
_HUMAN = "Drive the way a human driver would drive in this situation."
_DISTANCE = "Be risk-averse: keep a conservative distance to the other car."
_REASSESS = (
    "Reassess the situation regularly: when the other car behaves differently from what you "
    "expected, adapt your plan."
)

_SCHEMA = """\
Output format:
1. If a tactical decision is asked for above, write its letter alone on the first line.
2. Explain in two or three sentences what you do and why.
3. Give your acceleration plan for the next {horizon_s} s as a list of exactly {plan_actions} \
numbers, one for every {step_s} s. Each number lies between -1 and 1, where 1 stands for an \
acceleration of {max_acceleration} m/s^2 and -1 for a deceleration of {max_acceleration} m/s^2. \
Write the list in a Python code block that holds nothing but the list."""

BLOCKS: tuple[Block, ...] = (
    Block(
        "C0",
        merge="""\
You drive a car towards a merge. Two roads join at a merge point and go on as a single lane. You \
are on one of the two roads and another car is on the other one. Neither of you has the right of \
way. You cannot steer and you cannot communicate with the other driver: you control only the \
acceleration of your own car. You are asked for a new plan every {prompt_interval_s} s.

Situation now:
- Road type: merge
- Length of each car: {vehicle_length} m
- Your speed: {own_speed} m/s
- Speed of the other car: {other_speed} m/s
- Relative distance (how far the other car is ahead of you along the road; negative if it is \
behind): {relative_distance} m
- Your distance to the merge point: {distance_to_merge} m""",
        straight="""\
You drive a car on a straight road: you have passed a merge point where two roads join to a \
single lane. Another car comes from the other road and is ahead of you or behind you. You cannot \
steer and you cannot communicate with the other driver: you control only the acceleration of your \
own car. You are asked for a new plan every {prompt_interval_s} s.

Situation now:
- Road type: straight
- Length of each car: {vehicle_length} m
- Your speed: {own_speed} m/s
- Speed of the other car: {other_speed} m/s
- Relative distance (how far the other car is ahead of you along the road; negative if it is \
behind): {relative_distance} m""",
    ),
    Block("C1", merge=_HISTORY, straight=_HISTORY),
    Block("C2", merge=_PREVIOUS_PLAN, straight=_PREVIOUS_PLAN),
    Block("C3.safety", merge=_SAFETY, straight=_SAFETY),
    Block("C3.human", merge=_HUMAN, straight=_HUMAN),
    Block("C3.distance", merge=_DISTANCE, straight=_DISTANCE),
    Block("C3.reassess", merge=_REASSESS, straight=_REASSESS),
    Block(
        "C4",
        merge=(
            "Tactical decision: before you plan your accelerations, decide whether you merge "
            "first (M) or yield to the other car (Y)."
        ),
        straight=None,
    ),
    Block("C5", merge=_SCHEMA, straight=_SCHEMA),
)

VARIANTS: dict[str, frozenset[str]] = {
    "baseline": frozenset(),
    "A1": frozenset({"C1"}),
    "A2": frozenset({"C2"}),
    "A3": frozenset({"C3.safety"}),
    "A4": frozenset({"C3.human"}),
    "A5": frozenset({"C3.distance"}),
    "A6": frozenset({"C3.reassess"}),
    "A7": frozenset({"C4"}),
}


def block_digests(variant: str) -> dict[str, str]:
    """Block name to digest, for the blocks that a variant keeps."""
    removed = VARIANTS[variant]
    return {block.name: block.digest for block in BLOCKS if block.name not in removed}
