"""Sweeps in the metadata of recordings; nothing here verifies them."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Collection, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, JsonValue, field_validator

from merge_runner.records import DAMAGED, canonical_json
from merge_runner.results.recording import opened

SWEEPS_KEY = "sweeps"
"""Metadata key of the rows of several sweeps; one sweep has a key for each column instead."""


class RecordedSweep(BaseModel):
    """Sweep in a recording, read from the configuration of any version of the program.

    ``repetitions`` are by prompt variant, for each condition. ``arms`` has the labels of the arms
    of a study; recordings of plain sweeps may have none.
    """

    model_config = ConfigDict(frozen=True, extra="ignore")

    name: str
    model: str
    repetitions: Counter[str]
    conditions: tuple[str, ...]
    sample_set: int
    arms: frozenset[str] = frozenset()
    models: dict[str, JsonValue] = {}

    @field_validator("arms", mode="before")
    @classmethod
    def _labels(cls, stored: object) -> object:
        if not isinstance(stored, list):
            return stored
        return [arm.get("label") if isinstance(arm, dict) else arm for arm in stored]


def provenance_of(sweeps: list[dict[str, Any]]) -> dict[str, str]:
    """Return the metadata of the sweeps of a recording.

    The command line is left out: its paths may name people and machines.
    """
    rows = [
        {name: str(value) for name, value in row.items() if value is not None} for row in sweeps
    ]
    for row in rows:
        with suppress(*DAMAGED):
            config = dict(json.loads(row["config"]))
            row["config"] = canonical_json({k: v for k, v in config.items() if k != "typed"})
    return rows[0] if len(rows) == 1 else {SWEEPS_KEY: canonical_json(rows)}


def carried_plugins(provenance: dict[str, str]) -> list[str]:
    """Return the names of the plug-ins in a recording's metadata, not verified."""
    names = set[str]()
    for row in sweep_rows(provenance):
        with suppress(*DAMAGED):
            names.update(map(str, json.loads(row["config"])["study"]["plugins"]))
    return sorted(names)


def described_sweeps(provenance: dict[str, str]) -> list[RecordedSweep]:
    """Return the sweeps in a recording's metadata, without those with invalid configurations."""
    sweeps = []
    for row in sweep_rows(provenance):
        with suppress(*DAMAGED):
            sweeps.append(RecordedSweep(**{**json.loads(row["config"]), "name": row["name"]}))
    return sweeps


def sweep_rows(provenance: dict[str, str]) -> list[Any]:
    """Return the rows of sweeps in a recording's metadata, not verified."""
    with suppress(*DAMAGED):
        return [row for row in json.loads(provenance[SWEEPS_KEY]) if isinstance(row, dict)]
    return [provenance]


def recorded_part(
    files: Iterable[Path], names: Collection[str], model: str, sample_set: int
) -> RecordedSweep | None:
    """Return the recorded part of a sweep, merged over recordings and runs; None without any.

    The sweep may have several ``names``. Repetitions and conditions without a recorded call are
    left out. Raises RecordingError.
    """
    part = None
    for file in files:
        with opened(file) as (connection, provenance):
            counts = "SELECT condition, max(repetition) FROM recording GROUP BY ALL"
            repetitions_of = dict(connection.execute(counts).fetchall())
        for sweep in described_sweeps(provenance):
            if sweep.name not in names or (sweep.model, sweep.sample_set) != (model, sample_set):
                continue
            most = max((repetitions_of.get(name, 0) for name in sweep.conditions), default=0)
            repetitions = Counter({name: min(n, most) for name, n in sweep.repetitions.items()})
            conditions = tuple(name for name in sweep.conditions if name in repetitions_of)
            if part is not None:
                repetitions |= part.repetitions  # the larger number of each
                conditions = tuple(dict.fromkeys([*part.conditions, *conditions]))
            changes = {"repetitions": repetitions, "conditions": conditions}
            arms = sweep.arms | (part.arms if part else frozenset())
            part = sweep.model_copy(update={**changes, "arms": arms})
    return part
