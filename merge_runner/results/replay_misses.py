"""Calls that a replay lacks, and how they differ from the recorded ones."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict
from itertools import zip_longest
from operator import attrgetter
from pathlib import Path
from typing import NamedTuple

from merge_runner.llm.store import CachedCall
from merge_runner.records import ChatRequest
from merge_runner.text_safety import one_line

MOST_SHOWN = 70
# Misses that differ only in numbers have one cause.
_NUMBER = re.compile(r"-?\d+(\.\d+)?")


def described(files: Sequence[Path], entries: Iterable[CachedCall]) -> str:
    """Return in words how many calls of each model the recordings (or the cache) hold."""
    models = Counter(entry.request.model for entry in entries)
    counts = ", ".join(f"{calls} calls of {model}" for model, calls in sorted(models.items()))
    named = ", ".join(map(str, files)) or "the cache"
    return one_line(f"{named} holds {counts or 'no call at all'}")


class Miss(NamedTuple):
    """Call without a recorded reply, and the trial that needed it."""

    trial_id: str
    request: ChatRequest


def explain(misses: list[Miss], calls: Iterable[CachedCall]) -> list[str]:
    """Return how misses differ from the nearest recorded request, one text per kind of difference.

    The text names the first trial, side and decision, and the number of further ones. The nearest
    request has the same slot, else the same condition, side and decision, else it is any; among
    several of one slot, it is the one with the fewest differences.
    """
    place = attrgetter("condition", "side", "decision")
    slots = {miss.request.slot for miss in misses}
    known: dict[object, list[ChatRequest]] = {}  # by slot, the first by place, the first of all
    for request in (call.request for call in calls):
        if request.slot in slots:
            known.setdefault(request.slot, []).append(request)
        for key in (place(request.slot), None):
            known.setdefault(key, [request])
    alike: dict[str, list[tuple[Miss, str]]] = {}
    for miss in misses:
        keys = (miss.request.slot, place(miss.request.slot), None)
        near = next((known[key] for key in keys if key in known), [])
        fields = min((_differences(other, miss.request) for other in near), key=len, default=[])
        text = f"the nearest recorded request differs in {'; '.join(fields)}"
        text = text if fields else "nothing is recorded at all"
        alike.setdefault(_NUMBER.sub("0", text), []).append((miss, text))
    lines = []
    for group in alike.values():
        first, text = group[0]
        slot, trials = first.request.slot, {miss.trial_id for miss, _ in group}
        line = f"{first.trial_id}, {slot.side}, decision {slot.decision}: {text}"
        more = f"; {len(group)} calls of {len(trials)} trials differ like this"
        lines.append(line + more * (len(group) > 1))
    return lines


def _differences(nearest: ChatRequest, expected: ChatRequest) -> list[str]:
    """Return the differing fields with both values; for texts the first differing lines."""
    old, new, texts = _fields(nearest), _fields(expected), []
    for name in sorted(old.keys() | new.keys()):
        before, after = old.get(name), new.get(name)
        if isinstance(before, str) and isinstance(after, str):
            lines = zip_longest(before.split("\n"), after.split("\n"))
            before, after = next((pair for pair in lines if pair[0] != pair[1]), (None, None))
        if before != after:
            values = ("nothing" if value is None else repr(value) for value in (before, after))
            was, now = (v if len(v) <= MOST_SHOWN else v[:MOST_SHOWN] + "..." for v in values)
            texts.append(f"{name} (recorded {was}, wanted {now})")
    return texts


def _fields(request: ChatRequest) -> dict[str, object]:
    """Return the values that a request's key covers, by the path of each."""
    parts = {"endpoint": request.endpoint, "path": request.path, "headers": request.headers}
    body = json.loads(request.body)
    return dict(leaves({**asdict(request.slot), **parts, "body": body}))


def leaves(value: object, name: str = "") -> Iterator[tuple[str, object]]:
    """Yield (path, value) for each scalar within a JSON value."""
    if isinstance(value, dict | list):
        for key, inner in value.items() if isinstance(value, dict) else enumerate(value):
            yield from leaves(inner, f"{name}.{key}".lstrip("."))
    else:
        yield name, value
