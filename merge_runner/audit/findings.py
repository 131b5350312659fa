"""What an audit says: findings, notes on what is no fault, and how much was checked."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from typing import Any

SHOWN = 10


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that does not hold, and where; docs/reference/audit.md lists the kinds."""

    kind: str
    text: str
    sweep: str | None = None
    trial: str | None = None
    side: str | None = None
    decision: int | None = None

    def __str__(self) -> str:
        number = None if self.decision is None else f"decision {self.decision}"
        where = ", ".join(filter(None, (self.sweep, self.trial, self.side, number)))
        return f"{self.kind}: {where}: {self.text}" if where else f"{self.kind}: {self.text}"


@dataclass(slots=True)
class Audit:
    """What was checked of ``subject``: a sweep, a database, a recording or a cache.

    The checks add to it. ``counts`` say how much was checked, in the order of checking; of a sweep
    among them ``missing`` and ``failed`` trials. All holds where there is no finding.
    """

    subject: str
    counts: dict[str, int] = field(default_factory=dict)
    findings: list[Finding] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def ok(self) -> bool:
        """Whether all holds."""
        return not self.findings

    def as_dict(self) -> dict[str, Any]:
        """The audit as JSON values."""
        return {**asdict(self), "ok": self.ok}

    def lines(self) -> Iterator[str]:
        """The audit for a reader; of each kind the first findings."""
        number = len(self.findings)
        yield f"{self.subject}: " + (f"{number} findings" if number else "all holds")
        yield "  checked: " + ", ".join(f"{n} {name}" for name, n in self.counts.items())
        for text in self.notes:
            yield f"  note: {text}"
        shown: Counter[str] = Counter()
        for finding in self.findings:
            shown[finding.kind] += 1
            if shown[finding.kind] <= SHOWN:
                yield f"  {finding}"
        for kind, count in shown.items():
            if count > SHOWN:
                yield f"  {kind}: and {count - SHOWN} more, all of them with --json"
