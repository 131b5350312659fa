"""Which study recordings hold: their sweeps, as they say themselves, and what is there of these."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from contextlib import suppress
from itertools import chain
from pathlib import Path

from pydantic import (
    BaseModel,
    ConfigDict,
    JsonValue,
    TypeAdapter,
    ValidationError,
    field_validator,
)

from merge_runner.llm.cache import CachedCall
from merge_runner.results.recording import SWEEPS, opened
from merge_runner.text_safety import one_line

ROWS = TypeAdapter(list[dict[str, str]])


class RecordedSweep(BaseModel):
    """A sweep in a recording; ``repetitions`` of each prompt variant, in each condition.

    It is read from the configuration of any version that wrote a recording. ``arms`` has the
    labels of the arms of a study; recordings of plain sweeps may have none.
    """

    model_config = ConfigDict(frozen=True, extra="ignore")

    name: str
    model: str
    repetitions: dict[str, int]
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

    def __str__(self) -> str:
        """As a part of a sentence."""
        variants = ", ".join(f"{n} x {variant}" for variant, n in self.repetitions.items())
        return one_line(
            f"{self.name} with {self.model}: {variants} in {len(self.conditions)} conditions "
            f"({', '.join(self.conditions)}), sample set {self.sample_set}"
        )


def described_sweeps(provenance: dict[str, str]) -> list[RecordedSweep]:
    """Return the sweeps as a recording says itself, without those whose configuration is odd."""
    rows, sweeps = [provenance], []
    with suppress(KeyError, ValidationError):
        rows = ROWS.validate_json(provenance[SWEEPS])
    for row in rows:
        with suppress(KeyError, TypeError, ValueError, RecursionError):
            told = {**json.loads(row["config"]), "name": row.get("name", "")}
            sweeps.append(RecordedSweep(**told))
    return sweeps


def recorded_sweeps(files: Iterable[Path]) -> list[RecordedSweep]:
    """The sweeps in recordings, less the repetitions and conditions of which no call is there.

    A recording that does not say of what sweep it is has none. Raises RecordingError.
    """
    sweeps = []
    for file in files:
        with opened(file) as (connection, provenance):
            counts = "SELECT condition, max(repetition) FROM recording GROUP BY ALL"
            recorded = dict(connection.execute(counts).fetchall())
        for sweep in described_sweeps(provenance):
            conditions = tuple(name for name in sweep.conditions if name in recorded)
            most = max((recorded[name] for name in conditions), default=0)
            repetitions = {name: min(n, most) for name, n in sweep.repetitions.items()}
            changes = {"conditions": conditions, "repetitions": repetitions}
            sweeps.append(sweep.model_copy(update=changes))
    return sweeps


def recorded_part(
    files: Iterable[Path], names: Collection[str], model: str, sample_set: int
) -> RecordedSweep | None:
    """What recordings hold of one sweep: all that several of them, or several runs, hold of it.

    It may have several ``names``.
    """
    parts = [
        sweep
        for sweep in recorded_sweeps(files)
        if sweep.name in names and (sweep.model, sweep.sample_set) == (model, sample_set)
    ]
    if not parts:
        return None
    repetitions: Counter[str] = Counter()
    for part in parts:
        repetitions |= Counter(part.repetitions)  # the larger number of each
    conditions = tuple(dict.fromkeys(chain.from_iterable(part.conditions for part in parts)))
    arms = frozenset(chain.from_iterable(part.arms for part in parts))
    changes = {"repetitions": dict(repetitions), "conditions": conditions, "arms": arms}
    return parts[0].model_copy(update=changes)


def described(files: Sequence[Path], entries: Iterable[CachedCall]) -> str:
    """What recordings hold; without files, what a cache holds.

    ``entries`` are all their calls, which are counted where no recording says its sweep.
    """
    named = ", ".join(map(str, files)) or "the cache"
    if sweeps := recorded_sweeps(files):
        return f"{named} holds {'; '.join(map(str, sweeps))}"
    models = Counter(entry.request.model for entry in entries)
    counts = ", ".join(f"{calls} calls of {model}" for model, calls in sorted(models.items()))
    return one_line(f"{named} holds {counts or 'no call at all'}")
