"""Why a replay found no reply: how the request differs from the nearest recorded one."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from merge_runner.llm.cache import Entry
from merge_runner.records import ChatRequest, TrialRecord

SHOWN = 70


@dataclass(frozen=True, slots=True)
class Miss:
    """A call that a replay lacked, and the trial that needed it."""

    trial_id: str
    request: ChatRequest


def misses_of(record: TrialRecord) -> Iterator[Miss]:
    """The calls that a trial lacked."""
    for failed in record.failed_calls:
        yield Miss(record.spec.trial_id, failed.request)


def explain(misses: list[Miss], recorded: Iterable[Entry]) -> list[str]:
    """One text per miss: trial, side, decision, and what differs from the nearest request."""
    nearest: dict[str, tuple[tuple[int, int], ChatRequest]] = {}
    for entry in recorded:
        for miss in misses:
            distance = _distance(miss.request, entry.request)
            best = nearest.get(miss.request.key)
            if best is None or distance < best[0]:
                nearest[miss.request.key] = (distance, entry.request)
    lines = []
    for miss in misses:
        slot = miss.request.slot
        where = f"{miss.trial_id}, {slot.side}, decision {slot.decision}"
        found = nearest.get(miss.request.key)
        if found is None:
            lines.append(f"{where}: nothing is recorded at all")
            continue
        differences = "; ".join(_differences(found[1], miss.request))
        lines.append(f"{where}: the nearest recorded request differs in {differences}")
    return lines


def _distance(wanted: ChatRequest, recorded: ChatRequest) -> tuple[int, int]:
    """How many fields differ outside the body, then how much of the body does."""
    fields = _fields(wanted)
    apart = sum(fields[name] != value for name, value in _fields(recorded).items())
    return apart, abs(len(wanted.body) - len(recorded.body)) + (wanted.body != recorded.body)


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
    """Both values, or of two texts the first line that differs."""
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
