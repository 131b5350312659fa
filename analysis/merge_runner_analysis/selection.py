"""Selection of a database's trials: the options of tables, figures and the report."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class Selection:
    """Part of a database that a study reads: everything by default."""

    models: Sequence[str] | None = None
    """These drivers alone; ``human`` is one."""
    where: Mapping[str, Sequence[str]] | None = None
    """Drivers' trials at these levels of factors alone."""
    file: str | None = None
    """The trials of this study alone: a name in experiments, or the path of its file."""
    by: str | None = None
    """The factor at whose levels the table ``factors`` shows the others."""
    without_fallbacks: bool = False
    """No trial in which a decision had no valid plan."""
    sweep: str = ""
    """Drivers' trials of this run alone, by its id, or of the runs of this name."""
    condition: str = ""
    """The trials of this condition alone."""

    def key(self, db: Path) -> str:
        """Return what tables depend on besides the results: their notes name the database, too."""
        return json.dumps([str(db), asdict(self)], sort_keys=True)
