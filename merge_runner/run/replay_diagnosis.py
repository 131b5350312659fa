"""Why a replay found no reply: how the request differs from the nearest recorded one."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import zip_longest

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
        request, place = miss.request, _place(miss.request.slot)
        others = same_slot.get(request.slot) or [
            same_place.get(place) or next(iter(same_place.values()), request)
        ]
        nearest = min((list(_differences(other, request)) for other in others), key=len)
        text = f"the nearest recorded request differs in {'; '.join(nearest)}"
        text = text if nearest else "nothing is recorded at all"
        alike.setdefault(_NUMBER.sub("0", text), []).append((miss, text))
    lines = []
    for group in alike.values():
        first, text = group[0]
        slot, trials = first.request.slot, {miss.trial_id for miss, _ in group}
        line = f"{first.trial_id}, {slot.side}, decision {slot.decision}: {text}"
        more = f"; {len(group)} calls of {len(trials)} trials differ like this"
        lines.append(line + more * (len(group) > 1))
    return lines


def _place(slot: Slot) -> tuple[str, str, int]:
    return slot.condition, slot.side, slot.decision


def _fields(request: ChatRequest) -> dict[str, object]:
    return {
        "endpoint": request.endpoint,
        "path": request.path,
        "headers": request.headers,
        **request.slot.as_dict(),
        **dict(_leaves("body", json.loads(request.body))),
    }


def _differences(recorded: ChatRequest, wanted: ChatRequest) -> Iterator[str]:
    """Yield the fields that differ, each with both values; of texts the first lines that differ."""
    old, new = _fields(recorded), _fields(wanted)
    for name in sorted(old.keys() | new.keys()):
        before, after = old.get(name), new.get(name)
        if before == after:
            continue
        if isinstance(before, str) and isinstance(after, str):
            lines = zip_longest(before.split("\n"), after.split("\n"))
            before, after = next((a, b) for a, b in lines if a != b)
        yield f"{name} (recorded {_short(before)}, wanted {_short(after)})"


def _leaves(name: str, value: object) -> Iterator[tuple[str, object]]:
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _leaves(f"{name}.{key}", inner)
    elif isinstance(value, list):
        for index, inner in enumerate(value):
            yield from _leaves(f"{name}[{index}]", inner)
    else:
        yield name, value


def _short(value: object) -> str:
    text = "nothing" if value is None else repr(value)
    return text if len(text) <= SHOWN else text[:SHOWN] + "..."
