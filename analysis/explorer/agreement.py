"""How far two readers agree in their tags, on what both of them have tagged."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

from analysis.explorer.notes import Note


@dataclass(frozen=True, slots=True)
class Agreement:
    """How often two readers gave a tag, over the trials or decisions (``units``) both tagged."""

    tag: str
    units: str
    readers: tuple[str, str]
    both: int
    first: int
    second: int
    neither: int

    @property
    def common(self) -> int:
        """How many both have tagged, with whatever tag."""
        return self.both + self.first + self.second + self.neither

    @property
    def expected(self) -> float | None:
        """The share in which they would agree by chance; None where there is nothing in common."""
        if not self.common:
            return None
        one, other = self.both + self.first, self.both + self.second
        rest = (self.common - one) * (self.common - other)
        return (one * other + rest) / self.common**2

    @property
    def kappa(self) -> float | None:
        """Cohen's kappa (Cohen 1960, eq. 1); None where ``undefined`` says why."""
        if self.undefined or self.expected is None:
            return None
        return ((self.both + self.neither) / self.common - self.expected) / (1 - self.expected)

    @property
    def undefined(self) -> str:
        """Why there is no kappa; empty where there is one."""
        if not self.common:
            return f"there are no {self.units} that both have tagged"
        if self.common in {self.both, self.neither}:
            gave = "all" if self.both else "none"
            return f"both gave it to {gave} of them: there is nothing to tell apart"
        return ""


def agreements(notes: Sequence[Note]) -> Iterator[Agreement]:
    """For each tag that two readers have used: first on trials, then on decisions."""
    for units in ("trials", "decisions"):
        given: dict[str, dict[tuple[object, ...], set[str]]] = {}
        for note in notes:
            if note.tags and (note.decision is None) == (units == "trials"):
                unit = (*note.trial, note.side, note.decision)
                given.setdefault(note.reader, {}).setdefault(unit, set()).update(note.tags)
        for one, other in combinations(sorted(given), 2):
            used = set().union(*given[one].values()) & set().union(*given[other].values())
            common = given[one].keys() & given[other].keys()
            pairs = [(given[one][unit], given[other][unit]) for unit in common]
            for tag in sorted(used):
                counts = [0, 0, 0, 0]  # neither, the second alone, the first alone, both
                for a, b in pairs:
                    counts[2 * (tag in a) + (tag in b)] += 1
                yield Agreement(tag, units, (one, other), *counts[::-1])
