"""Stable names for plug-ins: those that docs/extend.md uses, imported from where they are defined.

Metrics are registered by ``merge_runner_analysis.metrics``.
"""

from merge_runner.drivers.base import Driver, DriverContext
from merge_runner.drivers.registry import PROGRAMS, Program
from merge_runner.errors import UsageError
from merge_runner.llm.formats import (
    FORMATS,
    Reading,
    ServerError,
    WireFormat,
    WireRequest,
    as_count,
    as_text,
    outcome_of,
)
from merge_runner.prompts.blocks import BLOCKS, VARIANTS, Block, Variant
from merge_runner.providers import PROVIDERS, ModelEntry, Provider
from merge_runner.records import Decision, Observation, Usage
from merge_runner.scenarios.merge.conditions import CONDITIONS, Condition

__all__ = [
    "BLOCKS",
    "CONDITIONS",
    "FORMATS",
    "PROGRAMS",
    "PROVIDERS",
    "VARIANTS",
    "Block",
    "Condition",
    "Decision",
    "Driver",
    "DriverContext",
    "ModelEntry",
    "Observation",
    "Program",
    "Provider",
    "Reading",
    "ServerError",
    "Usage",
    "UsageError",
    "Variant",
    "WireFormat",
    "WireRequest",
    "as_count",
    "as_text",
    "outcome_of",
]
