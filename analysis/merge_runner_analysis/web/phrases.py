"""Conditions, prompts and times in words."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from merge_runner.prompts.blocks import BLOCKS, Variant
from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS

UNKNOWN = "no meaning is known here"


def condition_text(headway: float, velocity: float) -> str:
    """A condition in words, from its projected headway in m and its relative velocity in m/s."""
    if headway == 0:
        ahead = "both would reach the merge point together"
    else:
        leader = "left" if headway > 0 else "right"
        ahead = f"the {leader} vehicle would be {abs(headway):g} m ahead at the merge point"
    if velocity == 0:
        return f"{ahead}, at equal speeds"
    compared = "faster" if velocity > 0 else "slower"
    return f"{ahead}, and the left one is {abs(velocity):g} m/s {compared}"


def ordered(names: Iterable[str]) -> list[str]:
    """Conditions in their usual order, those that no human drove last."""
    places = {name: place for place, name in enumerate(HUMAN_CONDITIONS)}
    return sorted(names, key=lambda name: (places.get(name, len(places)), name))


def changes_text(variant: Variant, shown: Callable[[str], str]) -> str:
    """What a variant's prompt leaves out and adds, each block as it is to be shown."""
    return " and ".join(
        f"{word} {', '.join(shown(name) for name in sorted(names))}"
        for word, names in (("without", variant.removes), ("with", variant.adds))
        if names
    )


def block_meaning(name: str) -> str:
    """What a block of a prompt is for."""
    block = BLOCKS.get(name)
    return UNKNOWN if block is None else block.meaning


def clock(time_s: float) -> str:
    """A time in seconds, to a tenth or, where that is not exact, a hundredth."""
    return f"{time_s:.1f}" if abs(time_s - round(time_s, 1)) < 1e-6 else f"{time_s:.2f}"
