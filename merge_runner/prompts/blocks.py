"""The prompt as named text blocks, C0 to C5 (arXiv 2604.09609, Table II), and its variants.

The paper's own wording is not public: this is a reconstruction from its description. A variant is
the baseline without some blocks and with some others, so that it changes nothing else.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import dropwhile
from string import Formatter

from merge_runner.config import ScenarioConfig
from merge_runner.errors import UsageError
from merge_runner.prompts.fields import FIELDS, Situation
from merge_runner.prompts.state_lines import NOT_SEEN
from merge_runner.records import Observation, Road
from merge_runner.registry import Catalogue, Registry, in_use, require

OUTPUT_FORMAT = "C5"
LAST = "the end"
TO_MERGE = "distance_to_merge"
_UNIT_OF_NOTHING = re.compile(rf"({NOT_SEEN}) (?:m/s\^2|m/s|km/h|mph|m|s)(?![\w/^])")


@dataclass(frozen=True, slots=True)
class Block:
    """One paragraph of the prompt.

    ``meaning`` says in a few words what it is for. ``merge`` and ``straight`` are its templates
    before and after the merge point, None where it is left out. Those of the paper have no
    ``before``: they are in the prompt of every variant that does not remove them, as they are
    registered. Any other stands before the block ``before`` in those variants that add it. Raises
    UsageError where a template names what there is not.
    """

    meaning: str
    merge: str | None
    straight: str | None
    before: str | None = OUTPUT_FORMAT

    def __post_init__(self) -> None:
        for road, template in (("merge", self.merge), ("straight", self.straight)):
            fields = {n: f for n, f in FIELDS.items() if (road, n) != ("straight", TO_MERGE)}
            for name in named(template or ""):
                require(fields, f"field on the road {road} of the block {self.meaning!r}:", name)

    @property
    def digest(self) -> str:
        """SHA-256 of both templates, and of where it stands unless that is its place in the paper.

        Its meaning is for readers alone.
        """
        place = "" if self.before is None else f"\0{self.before}"
        return hashlib.sha256(f"{self.merge}\0{self.straight}{place}".encode()).hexdigest()


@dataclass(frozen=True, slots=True)
class Variant:
    """The baseline without the blocks that it ``removes``, and with those that it ``adds``.

    Tables and figures show its ``title``, or its name where that is empty. One that a study makes
    holds all its ``blocks`` in order.
    """

    removes: frozenset[str] = frozenset()
    adds: frozenset[str] = frozenset()
    title: str = ""
    blocks: tuple[tuple[str, Block], ...] = ()


def named(template: str) -> list[str]:
    """What a template names in braces; raises UsageError."""
    try:
        parts = [part for part in Formatter().parse(template) if part[1] is not None]
        # Fields are texts already; a width could be so large that it fills the memory.
        if any(spec or conversion for _, _, spec, conversion in parts):
            raise ValueError("a field stands alone in its braces")
    except ValueError as exc:
        raise UsageError(f"a prompt block cannot be read, {exc}: {template!r}") from exc
    return [name for _, name, _, _ in parts if name is not None]


_APPROACHING = """\
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
- Your distance to the merge point: {distance_to_merge} m"""

_MERGED = """\
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
behind): {relative_distance} m"""


def _tabled(situation: str) -> str:
    """The same with its list as a table."""
    introduction, *items = situation.split("\n- ")
    rows = (re.sub(r"(.*): (\S+) ?(.*)", r"| \1 | \2 | \3 |", item) for item in items)
    return "\n".join([introduction, "| quantity | value | unit |", "|---|---|---|", *rows])


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
_TACTICAL = (
    "Tactical decision: before you plan your accelerations, decide whether you merge "
    "first (M) or yield to the other car (Y)."
)

_SCHEMA = """\
Output format:
1. If a tactical decision is asked for above, write its letter alone on the first line.
2. Explain in two or three sentences what you do and why.
3. Give your acceleration plan for the next {horizon_s} s as a list of exactly {plan_actions} \
numbers, one for every {step_s} s. Each number lies between -1 and 1, where 1 stands for an \
acceleration of {max_acceleration} m/s^2 and -1 for a deceleration of {max_acceleration} m/s^2. \
Write the list in a Python code block that holds nothing but the list."""

_HEADWAY = """\
Projected headway (which car is ahead when the first of you reaches the merge point at present \
speeds): {projected_headway}"""
_TIMES = """\
Time to the merge point at present speeds:
- You: {own_time_to_merge}
- The other car: {other_time_to_merge}"""
_GAP = "Time gap (how long the car behind takes to where the car ahead is now): {time_gap}"
_FASTER = "Relative speed: {relative_speed_in_words}"
_KMH = "In km/h: your speed is {own_speed_kmh}, the speed of the other car {other_speed_kmh}"
_MPH = "In mph: your speed is {own_speed_mph}, the speed of the other car {other_speed_mph}"

_PAPER = (
    ("C0", "situation", _APPROACHING, _MERGED),
    ("C1", "history", _HISTORY, _HISTORY),
    ("C2", "previous plan", _PREVIOUS_PLAN, _PREVIOUS_PLAN),
    ("C3.safety", "avoid a collision", _SAFETY, _SAFETY),
    ("C3.human", "drive like a human", _HUMAN, _HUMAN),
    ("C3.distance", "keep a distance", _DISTANCE, _DISTANCE),
    ("C3.reassess", "reassess", _REASSESS, _REASSESS),
    ("C4", "tactical decision", _TACTICAL, None),
    (OUTPUT_FORMAT, "output format", _SCHEMA, _SCHEMA),
)
_TABLES = _tabled(_APPROACHING), _tabled(_MERGED)
_READY = (
    ("state.projected_headway", "projected headway", _HEADWAY, None),
    ("state.time_to_merge", "times to the merge point", _TIMES, None),
    ("state.time_gap", "time gap", _GAP, _GAP),
    ("state.relative_speed", "relative speed in words", _FASTER, _FASTER),
    ("state.kmh", "speeds in km/h", _KMH, _KMH),
    ("state.mph", "speeds in mph", _MPH, _MPH),
    ("state.table", "situation as a table, in place of C0", *_TABLES),
)
BLOCKS = Registry[Block]("prompt block")
for _before, _blocks in ((None, _PAPER), ("C1", _READY)):
    for _name, _meaning, _merge, _straight in _blocks:
        BLOCKS.register(_name, Block(_meaning, _merge, _straight, _before))

VARIANTS = Registry[Variant]("variant")
VARIANTS.register("baseline", Variant(title="Baseline"))
VARIANTS.register("A1", Variant(frozenset({"C1"}), title="A1 (-History)"))
VARIANTS.register("A2", Variant(frozenset({"C2"}), title="A2 (-Prev. acc. plan)"))
VARIANTS.register("A3", Variant(frozenset({"C3.safety"}), title="A3 (-Safety)"))
VARIANTS.register("A4", Variant(frozenset({"C3.human"}), title="A4 (-Human)"))
VARIANTS.register("A5", Variant(frozenset({"C3.distance"}), title="A5 (-Distance)"))
VARIANTS.register("A6", Variant(frozenset({"C3.reassess"}), title="A6 (-Reassess)"))
VARIANTS.register("A7", Variant(frozenset({"C4"}), title="A7 (-Tactical plan)"))


def title_of(variant: str) -> str:
    """How tables and figures name a variant, which need not be registered here any more."""
    known = VARIANTS.get(variant)
    return (known and known.title) or variant


def blocks_of(variant: str) -> dict[str, Block]:
    """The blocks of a variant by name, in the order of its prompt; raises UsageError."""
    chosen = VARIANTS.require(variant)
    if chosen.blocks:
        return dict(chosen.blocks)
    for name in sorted(chosen.removes | chosen.adds):
        BLOCKS.require(name, f"the variant {variant} names it")
    paper = {name: block for name, block in BLOCKS.items() if block.before is None}
    blocks = {name: block for name, block in paper.items() if name not in chosen.removes}
    # In the order of names, which is that of no import.
    for name in sorted(chosen.adds - blocks.keys()):
        blocks = with_block(blocks, name, BLOCKS[name])
    return {name: BLOCKS[name] for name in blocks}


def with_block(
    blocks: Mapping[str, Block],
    name: str,
    block: Block,
    anchor: str | None = None,
    *,
    after: bool = False,
) -> dict[str, Block]:
    """The blocks of a prompt and one more, before or ``after`` its anchor.

    Without an anchor it stands where it says itself, or before the first block of the paper that
    follows there; else at the end. Raises UsageError for a place that there is not.
    """
    if anchor is None and block.before is not None:
        paper = {each: known for each, known in BLOCKS.items() if known.before is None}
        require(paper, f"place of the prompt block {name}, before", block.before)
        later = dropwhile(lambda each: each != block.before, paper)
        anchor = next((each for each in later if each in blocks), None)
    names = list(blocks)
    place = len(names) if anchor is None else names.index(anchor) + after
    # Where it stands is a part of its hash.
    added = replace(block, before=[*names, LAST][place])
    names.insert(place, name)
    return {each: blocks.get(each, added) for each in names}


def block_digests(variant: str) -> dict[str, str]:
    """Block name to digest, for the blocks of a variant."""
    return {name: block.digest for name, block in blocks_of(variant).items()}


def render_prompt(
    observation: Observation,
    remaining_plan: Sequence[float] | None,
    *,
    variant: str,
    scenario: ScenarioConfig,
) -> str:
    """The prompt of a variant.

    ``remaining_plan`` is the unexecuted rest of the last valid plan (normalised accelerations),
    None before the first.
    """
    template, names = _template(variant, observation.road, in_use())
    now = Situation(observation, scenario, remaining_plan)
    prompt = template.format_map({name: FIELDS[name](now) for name in names})
    return prompt if observation.other_seen else _UNIT_OF_NOTHING.sub(r"\1", prompt)


@lru_cache
def _template(variant: str, road: Road, _: Catalogue) -> tuple[str, frozenset[str]]:
    """The blocks of a variant that a road has, one below the other; and the fields they name."""
    blocks = blocks_of(variant).values()
    templates = (block.merge if road == "merge" else block.straight for block in blocks)
    whole = "\n\n".join(template for template in templates if template is not None) + "\n"
    return whole, frozenset(named(whole))
