"""The programs that drive, and the hash of their source: an edited one is another driver."""

from __future__ import annotations

import ast
import hashlib
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from importlib.util import find_spec, resolve_name
from math import inf, isfinite
from pkgutil import iter_modules

from merge_runner import drivers
from merge_runner.config import ScenarioConfig
from merge_runner.drivers.base import Driver, Seat, take_seat
from merge_runner.drivers.pace import program_pace
from merge_runner.errors import UsageError
from merge_runner.records import SIDES, Side, TrialSpec
from merge_runner.registry import Registry

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
        """See ``source_digest``."""
        return source_digest(self.driver)

    def make(self, scenario: ScenarioConfig, spec: TrialSpec, side: Side) -> Driver:
        """See MakeDriver."""
        pace = program_pace(scenario, self.rate_hz)
        return self.driver(take_seat(scenario, spec, side, pace))

    def told(self, name: str) -> dict[str, object]:
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


@cache
def source_digest(driver: Callable[[Seat], Driver]) -> str:
    """SHA-256 of the source of a driver's module, and of all that it imports from its package.

    Of our own programs the package is this one without this module, which makes no decision: the
    world and the records, which they share with language models, are covered by the version of the
    spec. A change of the layout alone is a change, too. Raises UsageError where there is no source
    to read.
    """
    top = driver.__module__.partition(".")[0]
    package = __package__ if __package__.startswith(f"{top}.") else top
    sources: dict[str, str] = {}
    waiting = [driver.__module__]
    while waiting:
        name = waiting.pop()
        if name not in {*sources, __name__} and f"{name}.".startswith(f"{package}."):
            source = _source(name)
            if source is not None:
                sources[name] = source
                waiting += _imported(name, source)
    if driver.__module__ not in sources:
        raise UsageError(f"the driver {driver.__qualname__} is no module of its own")
    return hashlib.sha256(repr(sorted(sources.items())).encode()).hexdigest()


def _source(name: str) -> str | None:
    """The source of a module; None where the name is that of something within one."""
    try:
        found = find_spec(name)
    except (ModuleNotFoundError, ValueError):
        return None
    if found is None:
        return None
    read = getattr(found.loader, "get_source", None)
    source: str | None = read(name) if read else None
    if source is None:
        raise UsageError(f"the driver rests on {name}, whose source is not there: install that too")
    return source


def _imported(name: str, source: str) -> Iterator[str]:
    """What a module may import, also within functions."""
    found = find_spec(name)
    assert found is not None
    package = name if found.submodule_search_locations is not None else name.rpartition(".")[0]
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            whole = resolve_name("." * node.level + (node.module or ""), package)
            yield whole
            yield from (f"{whole}.{alias.name}" for alias in node.names)


# Each program registers itself, in a module of this package that nobody else needs to name.
for _module in iter_modules(drivers.__path__, f"{drivers.__name__}."):
    import_module(_module.name)
