"""Prompt as named text blocks, C0 to C5 (arXiv 2604.09609, Table II), and its variants.

The paper's own wording is not public: this is a reconstruction from its description. A variant is
the baseline without some blocks and with others, and changes nothing else.

The levels of a study's text factors add, replace and remove blocks of any variant. The variant then
has a composed name: ``A1 hurry=yes``.

Numbers have two decimals, in m, s, m/s and m/s^2, or in the unit of their name; lists have Python's
syntax. A value of an unseen car is "not seen", without the unit after it in a template.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import dropwhile
from statistics import fmean
from string import Formatter
from typing import NamedTuple

from merge_runner.config import ScenarioConfig
from merge_runner.errors import UsageError
from merge_runner.prompts.state_lines import LINES, NOT_SEEN
from merge_runner.prompts.texts import ABLATIONS, FURTHER, OUTPUT_FORMAT, PAPER, TACTICAL
from merge_runner.records import ROADS, Observation, Road
from merge_runner.registry import Registry, require

BASELINE = "baseline"
LAST = "the end"
_UNIT_OF_NOTHING = re.compile(rf"({NOT_SEEN}) (?:m/s\^2|m/s|km/h|mph|m|s)(?![\w/^])")
KMH_OF_MPS = 3.6
MPH_OF_MPS = 3600 / 1609.344  # the international mile of 1959


class Situation(NamedTuple):
    """Situation of a prompt; ``plan`` is the rest of the last valid plan, None before the first.

    ``first`` is true at the driver's first decision.
    """

    seen: Observation
    task: ScenarioConfig
    plan: Sequence[float] | None
    first: bool

    def of_other(self, value: float) -> str:
        """Return a value of the other car as text, or "not seen"."""
        return decimal(value) if self.seen.other_seen else NOT_SEEN


def _own_accelerations(now: Situation) -> str:
    """Return the mean acceleration over each action; the last action ends now."""
    values, every = now.seen.own_accelerations_mps2, now.task.action_steps
    starts = range(len(values) % every, len(values), every)
    return listing(values if every == 1 else [fmean(values[i : i + every]) for i in starts])


def _other_speeds(now: Situation) -> str:
    """Return one observed speed for each action; the last is from one action before now."""
    if not now.seen.other_seen:
        return NOT_SEEN
    values, every = now.seen.other_speeds_mps, now.task.action_steps
    return listing(values[len(values) % every :: every])


def _remaining_plan(now: Situation) -> str:
    if now.plan is None:
        return "none, this is your first decision" if now.first else "none"
    return f"{listing(now.plan)}, one value every {now.task.action_s:g} s, next first"


def _line(line: Callable[[Observation], str], now: Situation) -> str:
    return line(now.seen)


def _constant(constant: Callable[[ScenarioConfig], str], now: Situation) -> str:
    return constant(now.task)


# Variables with one value in all prompts of a scenario.
CONSTANTS: Mapping[str, Callable[[ScenarioConfig], str]] = {
    "vehicle_length": lambda task: f"{task.vehicle_length_m:g}",
    "memory_s": lambda task: f"{task.memory_s:g}",
    "horizon_s": lambda task: f"{task.horizon_s:g}",
    "step_s": lambda task: f"{task.action_s:g}",
    "prompt_interval_s": lambda task: f"{1 / task.prompt_rate_hz:g}",
    "plan_actions": lambda task: str(task.plan_actions),
    "max_acceleration": lambda task: f"{task.max_acceleration_mps2:g}",
}
FIELDS: Mapping[str, Callable[[Situation], str]] = {
    "own_speed": lambda now: decimal(now.seen.own_speed_mps),
    "other_speed": lambda now: now.of_other(now.seen.other_speed_mps),
    "own_speed_kmh": lambda now: decimal(now.seen.own_speed_mps * KMH_OF_MPS),
    "other_speed_kmh": lambda now: now.of_other(now.seen.other_speed_mps * KMH_OF_MPS),
    "own_speed_mph": lambda now: decimal(now.seen.own_speed_mps * MPH_OF_MPS),
    "other_speed_mph": lambda now: now.of_other(now.seen.other_speed_mps * MPH_OF_MPS),
    # Own minus other's.
    "relative_speed": lambda now: now.of_other(now.seen.own_speed_mps - now.seen.other_speed_mps),
    # Distance to the other car, negative if it is behind.
    "relative_distance": lambda now: now.of_other(now.seen.relative_distance_m),
    # Only before the merge point.
    "distance_to_merge": lambda now: decimal(now.seen.distance_to_merge_m or 0.0),
    "own_accelerations": _own_accelerations,
    "other_speeds": _other_speeds,
    "remaining_plan": _remaining_plan,
    **{name: partial(_constant, constant) for name, constant in CONSTANTS.items()},
    **{name: partial(_line, line) for name, line in LINES.items()},
}


def decimal(value: float) -> str:
    """Return a number with two decimals, without a negative zero."""
    return f"{value:.2f}".replace("-0.00", "0.00")


def listing(values: Sequence[float]) -> str:
    """Return values as a Python list with two decimals."""
    template = ", ".join(["%.2f"] * len(values))  # at once, which takes half the time
    return f"[{template % tuple(values)}]".replace("-0.00", "0.00")


@dataclass(frozen=True, slots=True)
class Block:
    """One paragraph of the prompt.

    ``meaning`` is its purpose in a few words. ``merge`` and ``straight`` are its templates before
    and after the merge point, None: no paragraph there. The paper's blocks have no ``before``: they
    are in every variant that does not remove them, in the order of registration. Any other block
    comes before the block ``before`` in the variants that add it. Raises UsageError for an unknown
    template variable.
    """

    meaning: str
    merge: str | None
    straight: str | None
    before: str | None = OUTPUT_FORMAT

    def __post_init__(self) -> None:
        for road, template in (("merge", self.merge), ("straight", self.straight)):
            absent = "distance_to_merge" if road == "straight" else ""
            fields = {name: field for name, field in FIELDS.items() if name != absent}
            for name in named(template or ""):
                require(fields, f"field on the road {road} of the block {self.meaning!r}:", name)

    @property
    def digest(self) -> str:
        """Hash of the templates and the position, without the meaning (``digest_of``)."""
        return digest_of(self.merge, self.straight, self.before)


def digest_of(merge: str | None, straight: str | None, before: str | None) -> str:
    """Return the SHA-256 of a block's templates, and of its position unless it is the paper's."""
    place = "" if before is None else f"\0{before}"
    return hashlib.sha256(f"{merge}\0{straight}{place}".encode()).hexdigest()


@dataclass(frozen=True, slots=True)
class Variant:
    """Prompt variant: the baseline without the blocks ``removes``, with the blocks ``adds``.

    Tables and figures show its ``title``, by default its name. A variant of a study has all its
    ``blocks`` in order.
    """

    removes: frozenset[str] = frozenset()
    adds: frozenset[str] = frozenset()
    title: str = ""
    blocks: tuple[tuple[str, Block], ...] = ()


def named(template: str) -> list[str]:
    """Return the template variables (names in braces); raises UsageError."""
    try:
        parts = [part for part in Formatter().parse(template) if part[1] is not None]
        # Fields are texts; a large width could fill the memory.
        if any(spec or conversion for _, _, spec, conversion in parts):
            raise ValueError("a field stands alone in its braces")
    except ValueError as exc:
        raise UsageError(f"a prompt block cannot be read, {exc}: {template!r}") from exc
    return [name for _, name, _, _ in parts if name is not None]


BLOCKS = Registry[Block]("prompt block")
for _before, _blocks in ((None, PAPER), ("C1", FURTHER)):
    for _name, _meaning, *_texts in _blocks:
        BLOCKS.register(_name, Block(_meaning, _texts[0], _texts[-1], _before))

VARIANTS = Registry[Variant]("variant")
for _name, _removed, _title in ((BASELINE, (), "Baseline"), *ABLATIONS):
    VARIANTS.register(_name, Variant(frozenset(_removed), title=_title))


Rewording = Callable[[Mapping[str, Block]], dict[str, Block]]
WORDS = Registry[Mapping[str, Rewording]]("factor of words")
"""Changes of a prompt's blocks by text factor and level; a level without a text has none."""


def composed(variant: str, words: Iterable[str]) -> str:
    """Return the name of a variant with these text levels: ``A1 hurry=yes``."""
    names = [name for name in (variant, *words) if name != BASELINE]
    return " ".join(names) or BASELINE


def decomposed(variant: str) -> tuple[str, list[str]]:
    """Return the base variant of a composed one, and its text levels in order."""
    names = variant.split(" ")
    words = [name for name in names if "=" in name]
    return (BASELINE if len(words) == len(names) else names[0]), words


def title_of(variant: str) -> str:
    """Return the name of a variant in tables and figures; it need not be registered."""
    known = VARIANTS.get(variant)
    return (known and known.title) or variant


def blocks_of(variant: str) -> dict[str, Block]:
    """Return the blocks of a variant by name, in the prompt's order; raises UsageError."""
    prompt, words = decomposed(variant)
    blocks = _variant_blocks(prompt)
    for word in words:
        factor, _, level = word.partition("=")
        blocks = require(WORDS.require(factor), f"level of {factor}", level)(blocks)
    if not words:
        return blocks
    # The hash of an added block covers the block after it, also one that was added later.
    following = [*list(blocks)[1:], LAST]
    return {
        name: block if block.before is None else replace(block, before=after)
        for (name, block), after in zip(blocks.items(), following, strict=True)
    }


def _variant_blocks(variant: str) -> dict[str, Block]:
    chosen, known = VARIANTS.require(variant), dict(BLOCKS.items())
    if chosen.blocks:
        return dict(chosen.blocks)
    for name in sorted(chosen.removes | chosen.adds):
        require(known, BLOCKS.kind, name, f"the variant {variant} names it")
    paper = {name: block for name, block in known.items() if block.before is None}
    blocks = {name: block for name, block in paper.items() if name not in chosen.removes}
    # In the order of names, independent of imports.
    for name in sorted(chosen.adds - blocks.keys()):
        blocks = with_block(blocks, name, known[name])
    return {name: known[name] for name in blocks}


def with_block(
    blocks: Mapping[str, Block],
    name: str,
    block: Block,
    anchor: str | None = None,
    *,
    after: bool = False,
    earlier: Collection[str] = (),
) -> dict[str, Block]:
    """Return the blocks of a prompt with a further block, before or ``after`` its anchor.

    After an anchor it follows the blocks that text levels, or ``earlier`` prompts, added there.
    Without an anchor it precedes its ``before``, or the next block of the paper that is present;
    else it is last. Raises UsageError for an unknown position.
    """
    if anchor is None and block.before is not None:
        paper = {key: known for key, known in BLOCKS.items() if known.before is None}
        require(paper, f"place of the prompt block {name}, before", block.before)
        later = dropwhile(lambda key: key != block.before, paper)
        anchor = next((key for key in later if key in blocks), None)
    names = list(blocks)
    index = len(names) if anchor is None else names.index(anchor) + after
    added_before = {*earlier, *(key for key in names if "=" in key)}  # as ``hurry=yes.1``
    while after and index < len(names) and names[index] in added_before:
        index += 1
    # The position is a part of the hash.
    added = replace(block, before=[*names, LAST][index])
    names.insert(index, name)
    return {key: blocks.get(key, added) for key in names}


class Prompt:
    """Blocks of a prompt by name, in order, with their template for each road."""

    def __init__(self, blocks: Mapping[str, Block]) -> None:
        self.blocks = dict(blocks)
        self.templates = {road: _template(blocks.values(), road) for road in ROADS}

    @property
    def digests(self) -> dict[str, str]:
        """Digests by block name."""
        return {name: block.digest for name, block in self.blocks.items()}

    def asks_tactical(self, road: Road) -> bool:
        """Return whether the prompt asks for a tactical decision on a road."""
        block = self.blocks.get(TACTICAL)
        return (
            block is not None and (block.merge if road == "merge" else block.straight) is not None
        )


def prompt_of(variant: str) -> Prompt:
    """Return the prompt of a variant; raises UsageError."""
    return Prompt(blocks_of(variant))


def render_prompt(
    observation: Observation,
    remaining_plan: Sequence[float] | None,
    *,
    prompt: Prompt,
    scenario: ScenarioConfig,
    first: bool = True,
) -> str:
    """Return the text of a prompt.

    ``remaining_plan`` is the unexecuted rest of the last valid plan (normalised accelerations),
    None before the first. ``first`` is true at the driver's first decision; it has an effect only
    without a plan.
    """
    now = Situation(observation, scenario, remaining_plan, first)
    parts = _of_scenario(prompt, observation.road, scenario)
    text = "".join([text + field(now) if field else text for text, field in parts])
    return text if observation.other_seen else _UNIT_OF_NOTHING.sub(r"\1", text)


@lru_cache(maxsize=1_024)
def _of_scenario(
    prompt: Prompt, road: Road, scenario: ScenarioConfig
) -> list[tuple[str, Callable[[Situation], str] | None]]:
    """Return the template for a road with the scenario's constants, and functions as variables."""
    parts, before = list[tuple[str, Callable[[Situation], str] | None]](), ""
    for text, name in prompt.templates[road]:
        before += text
        if name and name in CONSTANTS:
            before += CONSTANTS[name](scenario)
        else:
            parts.append((before, FIELDS[name] if name else None))
            before = ""
    return [*parts, (before, None)]


def _template(blocks: Iterable[Block], road: Road) -> list[tuple[str, str | None]]:
    """Return the joined template of the blocks for a road: its texts, each before a variable."""
    templates = (block.merge if road == "merge" else block.straight for block in blocks)
    whole = "\n\n".join(template for template in templates if template is not None) + "\n"
    return [(text, name) for text, name, *_ in Formatter().parse(whole)]
