"""The options of a run, as its user gives them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite
from pathlib import Path

from merge_runner.errors import UsageError
from merge_runner.providers import ModelEntry


@dataclass(frozen=True, slots=True)
class Options:
    """The options of a run; none of them changes a result.

    ``rpm`` and ``tpm`` override the registry's. ``max_cost_usd`` also covers ``ledgers``, the
    names of other sweeps. ``dask`` names the cluster that plays the trials; None: this process. A
    ``dry_run`` sends nothing, a ``quiet`` run shows no progress. With ``keep_going`` a model
    without a valid decision does not stop the run. In a ``batch`` run all trials ask together,
    at a lower price. ``typed`` are the command's arguments, which resume the run. ``name`` is the
    user's name for the run.
    """

    db: Path
    cache: Path
    in_flight: int = 200
    rpm: int | None = None
    tpm: int | None = None
    max_cost_usd: float | None = None
    ledgers: Sequence[str] = ()
    replay: bool = False
    recordings: Sequence[Path] = ()
    strict_model: bool = False
    keep_going: bool = False
    quiet: bool = False
    dask: str | None = None
    dry_run: bool = False
    batch: bool = False
    typed: Sequence[str] = ()
    name: str = ""

    def __post_init__(self) -> None:
        """Raise UsageError for a number that no run can use, by whichever name it was given."""
        usd = self.max_cost_usd
        if usd is not None and not (usd >= 0 and isfinite(usd)):
            raise UsageError(f"--max-cost (max_cost_usd) is a number of USD from 0, not {usd:g}")
        for name in ("in_flight", "rpm", "tpm"):
            number = getattr(self, name)
            if number is not None and number < 1:
                option = f"--{name.replace('_', '-')}"
                shown = option if option == f"--{name}" else f"{option} ({name})"
                raise UsageError(f"{shown} is a whole number from 1, not {number}")

    @property
    def connections(self) -> int:
        """The number of connections that a model may need: both drivers may ask at once."""
        return 2 * self.in_flight

    @property
    def sends_nothing(self) -> bool:
        """True where no model may be asked."""
        return self.replay or self.dry_run

    def rates(self, entry: ModelEntry) -> tuple[int | None, int | None]:
        """Return the requests and tokens a minute that a model may get; None: no limit."""
        return self.rpm or entry.rpm, self.tpm or entry.tpm
