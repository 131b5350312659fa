"""Which study recordings hold: their sweeps, as they say themselves, and what is there of these."""

from __future__ import annotations

import json
import shlex
from collections.abc import Collection, Iterable, Sequence
from contextlib import suppress
from itertools import chain
from pathlib import Path

from pydantic import BaseModel, ConfigDict, JsonValue, field_validator

from merge_runner.llm.cache import CachedCall
from merge_runner.results.recording import opened, read_provenance, sweeps_of
from merge_runner.text_safety import one_line


class RecordedSweep(BaseModel):
    """A sweep in a recording; ``repetitions`` of each prompt variant, in each condition.

    It is read from the configuration of any version that wrote a recording. ``arms`` has the
    labels of the arms of a study; recordings of plain sweeps may have none. ``mirror`` says that
    two different drivers were played both ways round. ``seat`` is ``first`` where only the first
    situations were asked. It has ``ended`` where all its trials did, and ``begins_late`` where a
    driver may take control after the other.
    """

    model_config = ConfigDict(frozen=True, extra="ignore")

    name: str
    model: str
    repetitions: dict[str, int]
    conditions: tuple[str, ...]
    sample_set: int
    arms: frozenset[str] = frozenset()
    seat: str = ""
    mirror: bool = False
    models: dict[str, JsonValue] = {}
    ended: bool = False
    begins_late: bool = False

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

    def command(self, files: Sequence[Path]) -> str:
        """What replays it; its names may be anybody's, and are quoted for a shell."""
        words = ["merge-runner", "replay", self.name]
        if self.seat:
            study = self.name.removesuffix(f"-{self.seat}")
            words = ["merge-runner", "sweep", study, "--first", "--replay"]
            words += ["--conditions", ",".join(self.conditions)]
        words += [word for model in self.model.split(",") for word in ("--model", model)]
        words += ["--mirror"] * self.mirror
        words += ["--sample-set", str(self.sample_set)] * bool(self.sample_set)
        words += [word for file in files for word in ("--recording", str(file))]
        return one_line(shlex.join(words))

    def arms_of(self, repetition: int) -> int:
        """Return how many prompts may ask for a decision of a repetition."""
        variants = sum(repetition <= most for most in self.repetitions.values())
        return max(variants, len(self.arms))


def described_sweeps(provenance: dict[str, str]) -> list[RecordedSweep]:
    """Return the sweeps as a recording says itself, without those whose configuration is odd."""
    sweeps = []
    for row in sweeps_of(provenance):
        with suppress(KeyError, TypeError, ValueError, RecursionError):
            told = {
                "name": row.get("name", ""),
                "ended": "ended_at" in row and row.get("exit_code", "0") == "0",
                "begins_late": '"own_exit"' in row["config"],
            }
            sweeps.append(RecordedSweep(**{**json.loads(row["config"]), **told}))
    return sweeps


def recorded_sweeps(files: Iterable[Path]) -> list[RecordedSweep]:
    """The sweeps in recordings, less the repetitions and conditions of which no call is there.

    A recording that does not say of what sweep it is has none. Raises RecordingError.
    """
    found = []
    for file in files:
        there = _conditions_and_repetitions(file)
        for sweep in described_sweeps(read_provenance(file)):
            conditions = tuple(name for name in sweep.conditions if name in there)
            most = max((there[name] for name in conditions), default=0)
            repetitions = {v: min(n, most) for v, n in sweep.repetitions.items()}
            changes = {"conditions": conditions, "repetitions": repetitions}
            found.append(sweep.model_copy(update=changes))
    return found


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
    repetitions: dict[str, int] = {}
    for variant, most in chain.from_iterable(part.repetitions.items() for part in parts):
        repetitions[variant] = max(most, repetitions.get(variant, 0))
    conditions = dict.fromkeys(chain.from_iterable(part.conditions for part in parts))
    arms = frozenset(chain.from_iterable(part.arms for part in parts))
    changes = {"repetitions": repetitions, "conditions": tuple(conditions), "arms": arms}
    return parts[0].model_copy(update=changes)


def described(files: Sequence[Path], entries: Iterable[CachedCall]) -> str:
    """What recordings hold, and what to type to replay it; without files, what a cache holds.

    ``entries`` are all their calls, from which it is told what no recording says.
    """
    named = ", ".join(map(str, files))
    if sweeps := recorded_sweeps(files):
        said = "; ".join(map(str, sweeps))
        return f"{named} holds {said}. To replay it: {sweeps[0].command(files)}"
    models: dict[str, list[CachedCall]] = {}
    for entry in entries:
        models.setdefault(entry.request.model, []).append(entry)
    held = "; ".join(_counted(model, calls) for model, calls in sorted(models.items()))
    return f"{named or 'the cache'} holds {held or 'no call at all'}"


def _counted(model: str, calls: Sequence[CachedCall]) -> str:
    slots = [call.request.slot for call in calls]
    sets = sorted({slot.sample_set for slot in slots})
    conditions = list(dict.fromkeys(slot.condition for slot in slots))
    return one_line(
        f"{len(calls)} calls of {model}: up to {max(slot.repetition for slot in slots)} "
        f"repetitions in {len(conditions)} conditions ({', '.join(conditions)}), "
        f"sample set {', '.join(map(str, sets))}"
    )


def _conditions_and_repetitions(file: Path) -> dict[str, int]:
    """Each condition of which a call is recorded, and its highest repetition."""
    with opened(file) as (connection, _):
        return dict(
            connection.execute(
                "SELECT condition, max(repetition) FROM recording GROUP BY ALL"
            ).fetchall()
        )
