"""Table of the programs that drive; a program of another revision is another driver."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from inspect import iscoroutinefunction
from math import inf, isfinite
from typing import TYPE_CHECKING, Any, TypeGuard

from merge_runner.config import ScenarioConfig
from merge_runner.drivers.base import Driver, DriverContext, Parameter, make_context
from merge_runner.drivers.pace import program_pace
from merge_runner.errors import UsageError
from merge_runner.records import Side
from merge_runner.registry import FAULTS, Registry, fault_of, require
from merge_runner.trial_records import TrialSpec

if TYPE_CHECKING:
    from duckdb import DuckDBPyConnection

EMULATOR = "emulator"
MOCKS = frozenset({EMULATOR, "random"})
"""The mock models."""
SET = "set"  # the parameter that names a set of others


@dataclass(frozen=True, slots=True)
class Program:
    """Program: a class whose instances drive, each made with a DriverContext.

    The class may have a ``revision``, a whole number (default 1); a change of its decisions raises
    it, so that its trials are played anew. ``meaning`` is a short description; ``rate_hz`` is the
    number of decisions in a second (None: the prompt rate of the scenario).

    ``parameters`` belong to its rule; a study can set them if the program is ``settable`` and
    reads them from its context. ``sets`` are named sets of further parameters; the parameter
    ``set`` chooses one. ``check`` raises UsageError for invalid parameters, ``check_clock`` for a
    clock in s (the time between two decisions) that does not fit them.

    ``chance`` declares random draws from the seed of the context; of other programs the analysis
    counts equal first decisions once. ``from_humans`` declares that the rule was made from the
    data of the human experiment, so that its likeness to people is no finding. ``based_on`` is the
    program that a study has given other parameters or another clock.

    ``data`` are imported human trials that the program replays: an object with their hash as
    ``digest``. Its ``read`` returns another one with the trials of an open database (None: there is
    none yet), its ``check`` raises UsageError if there are too few trials of a condition.
    """

    driver: Callable[[DriverContext], Driver]
    meaning: str
    parameters: Mapping[str, Parameter] = field(default_factory=dict)
    rate_hz: float | None = None
    settable: bool = False
    sets: Mapping[str, Mapping[str, Parameter]] = field(default_factory=dict)
    check: Callable[[Mapping[str, Parameter]], None] | None = None
    check_clock: Callable[[Mapping[str, Parameter], float], None] | None = None
    data: Any = None
    chance: bool = False
    from_humans: bool = False
    based_on: str = ""

    def __post_init__(self) -> None:
        """Raise UsageError for invalid fields."""
        if not isinstance(self.driver, type):
            raise UsageError(f"the driver {self.driver!r} is no class")
        name = self.driver.__qualname__
        if not isinstance(self.revision, int) or self.revision < 1:
            raise UsageError(f"the revision of the driver {name} is a whole number from 1 on")
        if not iscoroutinefunction(getattr(self.driver, "decide", None)):
            raise UsageError(
                f"the driver {name} needs `async def decide(self, observation, number)`"
            )
        if self.rate_hz is not None and not 0 < self.rate_hz < inf:
            raise UsageError(f"the driver {name} needs a rate_hz above 0")
        if self.sets:
            require(self.sets, f"{SET} of the driver {name}", str(self.parameters.get(SET)))
        if not all(isinstance(value, str) or _is_number(value) for value in self.values.values()):
            raise UsageError(f"the parameters of the driver {name} must be finite numbers or texts")
        if self.check is not None:
            self.check(self.values)
        if self.check_clock is not None and self.rate_hz is not None:
            self.check_clock(self.values, 1 / self.rate_hz)

    @property
    def revision(self) -> int:
        """Revision of the class's rule."""
        revision: int = getattr(self.driver, "revision", 1)
        return revision

    @property
    def values(self) -> dict[str, Parameter]:
        """All parameters: the chosen set, overridden by the given ones."""
        chosen = self.sets[str(self.parameters[SET])] if self.sets else {}
        # First for the order of the names, last for precedence.
        return {**self.parameters, **chosen, **self.parameters}

    @property
    def described(self) -> str:
        """Description with rate and parameters, the chosen set first."""
        rate = "" if self.rate_hz is None else f" ({self.rate_hz:g} Hz)"
        shown = dict(self.values)
        if self.sets:
            shown[SET] = " | ".join(dict.fromkeys([str(shown[SET]), *self.sets]))
        parameters = ", ".join(f"{name} = {value}" for name, value in shown.items())
        kind = "parameters" if self.settable else "fixed"
        return self.meaning + rate + (f"; {kind}: {parameters}" if parameters else "")

    def with_changes(
        self, name: str, changes: Mapping[str, object], clock_s: float | None
    ) -> Program:
        """Return this program, called ``name``, with other parameters or another clock.

        Raise UsageError for an unknown or invalid parameter.
        """
        if changes and not self.settable:
            raise UsageError(f"the parameters of {name} stand in its source and cannot be set")
        values, given = self.values, dict(self.parameters)
        # The set comes first: the other parameters depend on it.
        for key in sorted(changes, key=lambda key: key != SET):
            hint = f"each {SET} has parameters of its own" if self.sets else ""
            value, default = changes[key], require(values, f"parameter of {name}", key, hint)
            if isinstance(default, str) and isinstance(value, str):
                given[key] = value
            elif not isinstance(default, str) and _is_number(value):
                given[key] = float(value)
            else:
                kind = "a text" if isinstance(default, str) else "a finite number"
                raise UsageError(f"{key} of {name} is {kind}, as {default!r}, not {value!r}")
            if key == SET:
                values = replace(self, parameters=given).values
        return replace(
            self,
            parameters=given,
            rate_hz=self.rate_hz if clock_s is None else 1 / clock_s,
            based_on=self.based_on or name,
        )

    def make(self, scenario: ScenarioConfig, spec: TrialSpec, side: Side) -> Driver:
        """Return the driver of one side of a trial."""
        pace = program_pace(scenario, self.rate_hz)
        context = make_context(scenario, spec, side, pace, self.values, self.data)
        try:
            return self.driver(context)
        except FAULTS as error:
            raise fault_of(f"the {side} driver", error) from error

    def replaying(self, connection: DuckDBPyConnection | None) -> Program:
        """Return this program with the human trials of a database, if it replays some."""
        return self if self.data is None else replace(self, data=self.data.read(connection))

    def in_spec(self, name: str) -> dict[str, object]:
        """Return its entry in the spec of a trial."""
        entry = {
            "program": name,
            "parameters": self.values,
            "revision": self.revision,
            "chance": self.chance or None,
            "rate_hz": self.rate_hz,
            "data": self.data and self.data.digest,
            "based_on": self.based_on or None,
        }
        # None is left out: a new key must not change the hashes of older specs.
        return {key: value for key, value in entry.items() if value is not None}


def _is_number(value: object) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool) and isfinite(value)


PROGRAMS = Registry[Program]("driver")
