"""Why a replay found no reply: how the request differs from the nearest recorded one."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from itertools import zip_longest
from operator import attrgetter

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
    place = attrgetter("condition", "side", "decision")
    wanted = {miss.request.slot for miss in misses}
    same_slot: dict[Slot, list[ChatRequest]] = {}
    same_place: dict[tuple[str, str, int], ChatRequest] = {}
    for entry in recorded:
        if entry.request.slot in wanted:
            same_slot.setdefault(entry.request.slot, []).append(entry.request)
        same_place.setdefault(place(entry.request.slot), entry.request)
    alike: dict[str, list[tuple[Miss, str]]] = {}
    for miss in misses:
        request, any_place = miss.request, next(iter(same_place.values()), miss.request)
        near = same_place.get(place(request.slot), any_place)
        others = same_slot.get(request.slot, [near])
        nearest = min((_differences(other, request) for other in others), key=len)
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


def _differences(recorded: ChatRequest, wanted: ChatRequest) -> list[str]:
    """Return the fields that differ, each with both values; of texts the first lines that do."""
    old, new, texts = dict(_leaves(recorded)), dict(_leaves(wanted)), []
    for name in sorted(old.keys() | new.keys()):
        before, after = old.get(name), new.get(name)
        if isinstance(before, str) and isinstance(after, str):
            lines = zip_longest(before.split("\n"), after.split("\n"))
            before, after = next((pair for pair in lines if pair[0] != pair[1]), (None, None))
        if before != after:
            values = ("nothing" if value is None else repr(value) for value in (before, after))
            was, now = (v if len(v) <= SHOWN else v[:SHOWN] + "..." for v in values)
            texts.append(f"{name} (recorded {was}, wanted {now})")
    return texts


def _leaves(value: object, name: str = "") -> Iterator[tuple[str, object]]:
    """The fields of a request that its key covers, each by its path."""
    if isinstance(value, ChatRequest):
        yield from _leaves(asdict(value.slot))
        yield from _leaves({"endpoint": value.endpoint, "path": value.path})
        yield from _leaves({"headers": value.headers, "body": json.loads(value.body)})
    elif isinstance(value, dict):
        for key, inner in value.items():
            yield from _leaves(inner, f"{name}.{key}".lstrip("."))
    elif isinstance(value, list):
        for index, inner in enumerate(value):
            yield from _leaves(inner, f"{name}[{index}]")
    else:
        yield name, value
