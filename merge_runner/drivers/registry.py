"""The programs that drive; one whose source is edited is another driver."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from math import inf, isfinite
from pkgutil import iter_modules

from merge_runner import drivers
from merge_runner.config import ScenarioConfig
from merge_runner.drivers.base import Driver, Seat, take_seat
from merge_runner.drivers.pace import program_pace
from merge_runner.errors import UsageError
from merge_runner.main_source import MAIN, main_source
from merge_runner.records import SIDES, Side, TrialSpec
from merge_runner.registry import Registry
from merge_runner.source import source_digest

EMULATOR = "emulator"  # the model that a scripted stand-in of ours answers for


@dataclass(frozen=True, slots=True)
class Program:
    """A class whose instances drive, made with a Seat.

    ``meaning`` says in a few words what it does, and ``parameters`` are those of its rule. It
    decides ``rate_hz`` times a second; None: at the prompt rate of the scenario.
    """

    driver: Callable[[Seat], Driver]
    meaning: str
    parameters: Mapping[str, float] = field(default_factory=dict)
    rate_hz: float | None = None

    def __post_init__(self) -> None:
        """Raises UsageError for what can be no driver, or could not be told apart from another."""
        if not isinstance(self.driver, type):
            raise UsageError(f"the driver {self.driver!r} is no class: its source is not known")
        if self.rate_hz is not None and not 0 < self.rate_hz < inf:
            raise UsageError(f"the driver {self.driver.__qualname__} needs a rate_hz above 0")
        if not all(isinstance(n, int | float) and isfinite(n) for n in self.parameters.values()):
            raise UsageError(
                f"the parameters of the driver {self.driver.__qualname__} must be finite numbers"
            )

    @property
    def source(self) -> str:
        """The hash of its source, without this module, which makes no decision.

        The world and the records, which it shares with language models, are covered by the version
        of the spec.
        """
        if self.main_source:
            return hashlib.sha256(repr(sorted(self.main_source.items())).encode()).hexdigest()
        return source_digest(self.driver, __package__, without=__name__)

    @property
    def main_source(self) -> dict[str, str]:
        """Its source by name where a notebook or a script defines it; see ``main_source``."""
        assert isinstance(self.driver, type)
        return main_source(self.driver) if self.driver.__module__ == MAIN else {}

    def make(self, scenario: ScenarioConfig, spec: TrialSpec, side: Side) -> Driver:
        """See MakeDriver."""
        pace = program_pace(scenario, self.rate_hz)
        return self.driver(take_seat(scenario, spec, side, pace))

    def in_spec(self, name: str) -> dict[str, object]:
        """What the spec of its trials says of it."""
        own_rate = {} if self.rate_hz is None else {"rate_hz": self.rate_hz}
        return {
            "program": name,
            "parameters": dict(self.parameters),
            "source": self.source,
            **own_rate,
        }


PROGRAMS = Registry[Program]("driver")


def stand_in(names: Mapping[Side, str], sides: Collection[Side] = SIDES) -> str:
    """What is said of trials of these models in which a stand-in answered on these sides."""
    models = {side: name for side, name in names.items() if name not in {EMULATOR, *PROGRAMS}}
    posing = "+".join(dict.fromkeys(name for side, name in models.items() if side in sides))
    real = [side for side in models if side not in sides]
    where = f" on the {'left' if real == ['right'] else 'right'}" if real else ""
    return f"scripted stand-in{where}, {f'not {posing}' if posing else 'no language model'}"


# Each program registers itself, in a module of this package that nobody else needs to name.
for _module in iter_modules(drivers.__path__, f"{drivers.__name__}."):
    import_module(_module.name)
