"""Why a replay found no reply: how the request differs from the nearest recorded one."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from merge_runner.llm.cache import CachedCall
from merge_runner.records import ChatRequest, Slot

SHOWN = 70
# Misses that differ in numbers alone have one cause.
_NUMBER = re.compile(r"-?\d+(\.\d+)?")


@dataclass(frozen=True, slots=True)
class Miss:
    """A call that a replay lacked, and the trial that needed it."""

    trial_id: str
    request: ChatRequest


def explain(misses: list[Miss], recorded: Iterable[CachedCall]) -> list[str]:
    """How each miss differs from the nearest request: one text for all that differ in the same way.

    The text names the first trial, side and decision, and how many more there are. The nearest
    request is one of the same slot, else one of the same place in another repetition, else any;
    among several of one slot, the one with the fewest differences.
    """
    wanted = {miss.request.slot for miss in misses}
    same_slot: dict[Slot, list[ChatRequest]] = {}
    same_place: dict[tuple[str, str, int], ChatRequest] = {}
    for entry in recorded:
        request = entry.request
        if request.slot in wanted:
            same_slot.setdefault(request.slot, []).append(request)
        same_place.setdefault(_place(request.slot), request)
    alike: dict[str, list[tuple[Miss, str]]] = {}
    for miss in misses:
        text = _explained(miss, same_slot, same_place)
        alike.setdefault(_NUMBER.sub("0", text), []).append((miss, text))
    return [_as_line(group) for group in alike.values()]


def _as_line(group: list[tuple[Miss, str]]) -> str:
    """The first of the misses that differ in the same way, and their number, as a line of text."""
    (first, text), *others = group
    slot = first.request.slot
    line = f"{first.trial_id}, {slot.side}, decision {slot.decision}: {text}"
    if not others:
        return line
    trials = len({miss.trial_id for miss, _ in group})
    return f"{line}; {len(group)} calls of {trials} trials differ like this"


def _explained(
    miss: Miss,
    same_slot: dict[Slot, list[ChatRequest]],
    same_place: dict[tuple[str, str, int], ChatRequest],
) -> str:
    request, slot = miss.request, miss.request.slot
    others = same_slot.get(slot) or [
        same_place.get(_place(slot)) or next(iter(same_place.values()), request)
    ]
    nearest = min((list(_differences(other, request)) for other in others), key=len)
    if not nearest:
        return "nothing is recorded at all"
    return f"the nearest recorded request differs in {'; '.join(nearest)}"


def _place(slot: Slot) -> tuple[str, str, int]:
    return slot.condition, slot.side, slot.decision


def _fields(request: ChatRequest) -> dict[str, object]:
    return {
        "endpoint": request.endpoint,
        "path": request.path,
        "headers": request.headers,
        **request.slot.as_dict(),
    }


def _differences(recorded: ChatRequest, wanted: ChatRequest) -> Iterator[str]:
    old = {**_fields(recorded), **dict(_leaves("body", json.loads(recorded.body)))}
    new = {**_fields(wanted), **dict(_leaves("body", json.loads(wanted.body)))}
    for name in sorted(old.keys() | new.keys()):
        if old.get(name) == new.get(name):
            continue
        before, after = _first_difference(old.get(name), new.get(name))
        yield f"{name} (recorded {before}, wanted {after})"


def _leaves(name: str, value: object) -> Iterator[tuple[str, object]]:
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _leaves(f"{name}.{key}", inner)
    elif isinstance(value, list):
        for index, inner in enumerate(value):
            yield from _leaves(f"{name}[{index}]", inner)
    else:
        yield name, value


def _first_difference(old: object, new: object) -> tuple[str, str]:
    """Both values; for two texts, the first line that differs."""
    if isinstance(old, str) and isinstance(new, str):
        before, after = old.split("\n"), new.split("\n")
        for line, other in zip(before, after, strict=False):
            if line != other:
                return _short(line), _short(other)
        if len(before) != len(after):
            return f"{len(before)} lines", f"{len(after)} lines"
    return ("nothing" if old is None else _short(old)), ("nothing" if new is None else _short(new))


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= SHOWN else text[:SHOWN] + "..."
