"""What the coordinator tells a worker: a batch of trials, and what is known of a call."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import merge_runner
from merge_runner.llm.cache import Entry
from merge_runner.records import Attempt, TrialSpec
from merge_runner.registry import plugin_sources
from merge_runner.run.clients import EndpointPlan
from merge_runner.run.plan import Plan


@dataclass(frozen=True, slots=True)
class Batch:
    """Whole trials to play, at most ``in_flight`` at once, and how.

    ``folder`` names the worker's own cache, that of one main cache alone. ``limited`` are the
    models whose calls need a turn from the coordinator, ``pauses_s`` how long the calls of each
    other one have to wait at first.
    """

    specs: tuple[TrialSpec, ...]
    in_flight: int
    plan: Plan
    endpoint_plan: EndpointPlan
    folder: str
    limited: frozenset[str]
    pauses_s: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class KnownCall:
    """What the main cache holds of a call: its entry, or earlier attempts.

    ``damaged`` names what was found damaged and set aside.
    """

    entry: Entry | None
    attempts: tuple[Attempt, ...]
    damaged: tuple[str, ...] = ()


@cache
def fingerprint() -> str:
    """The version and a hash of all source, plug-ins too: who differs might play other trials."""
    code = hashlib.sha256()
    for source in (Path(merge_runner.__file__).parent, *plugin_sources()):
        for path in sorted(source.rglob("*.py")) if source.is_dir() else [source]:
            code.update(f"{source.name}/{path.relative_to(source)}\0".encode() + path.read_bytes())
    return f"{merge_runner.__version__} ({code.hexdigest()[:12]})"
