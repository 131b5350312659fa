"""The resolved objects of a plan: conditions, prompts, programs and wire formats."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from merge_runner.drivers.registry import PROGRAMS, Program
from merge_runner.llm.formats import FORMATS, WireFormat
from merge_runner.prompts.blocks import Prompt, prompt_of
from merge_runner.registry import Catalogue, using
from merge_runner.results.database import read_database
from merge_runner.scenarios.merge.conditions import CONDITIONS, Condition
from merge_runner.study.arms import Arm

if TYPE_CHECKING:
    from duckdb import DuckDBPyConnection


@dataclass(frozen=True, eq=False)
class Parts:
    """The objects of a plan, by their names in it.

    They are resolved when the plan is made, and not looked up again: another study may give the
    same names to other things. ``prompts`` are by variant; ``programs``, and the wire ``formats``
    of models, serve its arms. The ``catalogue`` has all that its study adds.
    """

    conditions: Mapping[str, Condition] = field(default_factory=dict)
    prompts: Mapping[str, Prompt] = field(default_factory=dict)
    programs: Mapping[str, Program] = field(default_factory=dict)
    formats: Mapping[str, WireFormat] = field(default_factory=dict)
    catalogue: Catalogue = field(default_factory=Catalogue)

    @property
    def replays_humans(self) -> bool:
        """True where a program replays imported human trials."""
        return any(program.data is not None for program in self.programs.values())

    def with_humans(self, connection: DuckDBPyConnection | None) -> Parts:
        """Return the same with the human trials of a database to replay; None: there are none."""
        programs = {n: program.replaying(connection) for n, program in self.programs.items()}
        return replace(self, programs=programs)

    def with_humans_of(self, db: Path | None) -> Parts:
        """Return the same with the human trials of a file, where any are replayed."""
        if db is None or not self.replays_humans:
            return self
        with read_database(db) if db.is_file() else nullcontext() as connection:
            return self.with_humans(connection)


def find_parts(
    arms: Sequence[Arm], conditions: Iterable[str], catalogue: Catalogue, hint: str = ""
) -> Parts:
    """Resolve the names in arms and conditions by a catalogue.

    Raises UsageError, with a ``hint``, for an unknown name.
    """
    entries = {name: arm.entries.get(name) for arm in arms for name in arm.full_names.values()}
    prompts = dict.fromkeys(name for arm in arms for name in arm.read_prompts.values())
    with using(catalogue):
        return Parts(
            {name: CONDITIONS.require(name, hint) for name in conditions},
            {name: prompt_of(name) for name in prompts},
            {name: PROGRAMS.require(name, hint) for name, entry in entries.items() if not entry},
            {entry.format: FORMATS[entry.format] for entry in entries.values() if entry},
            catalogue,
        )
