"""What the coordinator gives a worker to play, provided that both run the same program."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import merge_runner
from merge_runner.records import TrialSpec
from merge_runner.registry import plugin_sources
from merge_runner.run.clients import EndpointPlan
from merge_runner.run.plan import Plan


@dataclass(frozen=True, slots=True)
class Batch:
    """Whole trials to play, at most ``in_flight`` at once, and how."""

    specs: tuple[TrialSpec, ...]
    in_flight: int
    plan: Plan
    endpoint_plan: EndpointPlan


@cache
def fingerprint() -> str:
    """The version and a hash of all source and plug-ins; a worker with another one is refused."""
    code = hashlib.sha256()
    for source in (Path(merge_runner.__file__).parent, *plugin_sources()):
        for path in sorted(source.rglob("*.py")) if source.is_dir() else [source]:
            code.update(f"{source.name}/{path.relative_to(source)}\0".encode() + path.read_bytes())
    return f"{merge_runner.__version__} ({code.hexdigest()[:12]})"
