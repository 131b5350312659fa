"""Conditions, prompts and times in words."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any
from urllib.parse import urlsplit

from merge_runner.prompts.blocks import BLOCKS
from merge_runner.providers import LOOPBACK
from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS

UNKNOWN = "no meaning is known here"
# Stored names in the words of a page; other names are shown as they are.
PLAIN = {
    "collided": "crashed",
    "timeout": "timed out",
    "fallbacks": "some without a valid plan",
    "no decision": "nobody decided",
    "mocks": "mock models",
    "human": "people",
    "humans": "people",
    "decision: missing": "no decision in the reply",
    "no_array": "no plan in the reply",
    "several_arrays": "several plans in the reply",
    "out_of_range": "plan out of range",
    "wrong_length": "plan of a wrong length",
    "not_finite": "infinite numbers in the plan",
    "not_a_number": "no numbers in the plan",
    "truncated": "reply cut off (token limit)",
    "refusal": "refused to answer",
    "empty": "empty reply",
    "no_decision": "no decision in the reply",
    "M": "merge first",
    "Y": "yield",
}


def called(study: str, config: Mapping[str, Any]) -> str:
    """Return a run's title: the name that its user gave it, and its study's."""
    run_name = config.get("run_name")
    return f"{run_name} ({study})" if run_name else study


def condition_text(headway: float, velocity: float) -> str:
    """Describe a condition by its projected headway in m and its relative velocity in m/s."""
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
    """Return conditions in their usual order, those without human data last."""
    places = {name: place for place, name in enumerate(HUMAN_CONDITIONS)}
    return sorted(names, key=lambda name: (places.get(name, len(places)), name))


def block_meaning(name: str) -> str:
    """Return the purpose of a block of a prompt."""
    block = BLOCKS.get(name)
    if block is None and "=" in name:
        return "words of the study"
    return UNKNOWN if block is None else block.meaning


def plain(value: str) -> str:
    """Return a stored name in the words of a page; for a cause its kind and reason."""
    kind, _, name = value.partition(": ")
    if kind == "plan":
        return PLAIN.get(name, name)
    if kind == "attempt":
        return f"request: {name.replace('_', ' ')}"
    return f"wrong {value}" if kind == "model" and name else PLAIN.get(value, value)


def causes_text(causes: Iterable[tuple[str, int]]) -> str:
    """Return causes of errors with counts: ``2 replies without a valid plan: ...; ...``."""
    plans, texts = dict[str, int](), []
    for value, times in causes:
        if value.startswith("plan: "):
            plans[plain(value)] = times
        else:
            texts.append(plain(value) if times == 1 else f"{plain(value)}, {times} times")
    if plans:
        count = sum(plans.values())
        replies = "reply" if count == 1 else "replies"
        texts.insert(0, f"{count} {replies} without a valid plan: {', '.join(plans)}")
    return "; ".join(texts)


def local_server(url: str | None) -> str:
    """Return the label of replies that came from this machine; empty for any other server.

    >>> local_server("http://127.0.0.1:8977/v1")
    'local server, http://127.0.0.1:8977/v1'
    """
    return f"local server, {url}" if urlsplit(url or "").hostname in LOOPBACK else ""


def clock(time_s: float) -> str:
    """Return a time in seconds, to a tenth or, where that is not exact, a hundredth."""
    return f"{time_s:.1f}" if abs(time_s - round(time_s, 1)) < 1e-6 else f"{time_s:.2f}"


def duration(seconds: float) -> str:
    """Return a time span in s, min or h."""
    if seconds < 5_400:
        return f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"
