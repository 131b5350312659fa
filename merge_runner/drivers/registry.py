"""The programs that drive; one of another revision is another driver."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import dataclass, field, replace
from math import inf, isfinite
from typing import TYPE_CHECKING, Any, TypeGuard

from merge_runner.config import ScenarioConfig
from merge_runner.drivers.base import Driver, take_seat
from merge_runner.drivers.pace import program_pace
from merge_runner.drivers.program_seat import Parameter, ProgramSeat
from merge_runner.errors import UsageError
from merge_runner.records import SIDES, Side, TrialSpec, other_side
from merge_runner.registry import Registry, require

if TYPE_CHECKING:
    from duckdb import DuckDBPyConnection

EMULATOR = "emulator"
MOCKS = frozenset({EMULATOR, "random"})
"""The models of our own, under whose names no other is expected to answer."""
SET = "set"  # the parameter that names a set of others
_making = threading.Lock()


@dataclass(frozen=True, slots=True)
class Program:
    """A class whose instances drive, made with a ProgramSeat.

    The class may name its ``revision``, a whole number, which is 1 where it does not: whoever
    changes what it decides raises it, so that its trials are played anew.
    ``meaning`` says in a few words what it does, and ``parameters`` are those of its rule. It
    decides ``rate_hz`` times a second; None: at the prompt rate of the scenario. A ``settable``
    program reads its parameters from its seat, so that a study can set them. ``sets`` are named
    sets of further parameters, of which the parameter ``set`` chooses one. ``check`` raises
    UsageError for parameters that cannot be, ``check_clock`` for a clock in s (the time between two
    decisions) that cannot be beside them. ``data`` are imported human trials that it replays: an
    object with their hash as ``digest``, whose ``read`` takes those of an open database (None:
    there is none yet), whose ``keep`` takes the ``trials`` of another such object, and whose
    ``check`` raises UsageError where a program has too few trials of a condition for a scenario and
    so many repetitions. ``shared`` is the one object in which its class looks for them, where
    ``data`` are the own ones of a plan (``replaying``). ``chance`` declares that it draws by the
    seed of its seat: the analysis counts equal first decisions of others once. ``based_on``
    names the program that a study has given other parameters or another clock.
    """

    driver: Callable[[ProgramSeat], Driver]
    meaning: str
    parameters: Mapping[str, Parameter] = field(default_factory=dict)
    rate_hz: float | None = None
    settable: bool = False
    sets: Mapping[str, Mapping[str, Parameter]] = field(default_factory=dict)
    check: Callable[[Mapping[str, Parameter]], None] | None = None
    check_clock: Callable[[Mapping[str, Parameter], float], None] | None = None
    data: Any = None
    shared: Any = None
    chance: bool = False
    based_on: str = ""

    def __post_init__(self) -> None:
        """Raises UsageError for what can be no driver, or could not be told apart from another."""
        if not isinstance(self.driver, type):
            raise UsageError(f"the driver {self.driver!r} is no class")
        name = self.driver.__qualname__
        if not isinstance(self.revision, int) or self.revision < 1:
            raise UsageError(f"the revision of the driver {name} is a whole number from 1 on")
        if self.rate_hz is not None and not 0 < self.rate_hz < inf:
            raise UsageError(f"the driver {name} needs a rate_hz above 0")
        if self.sets:
            require(self.sets, f"{SET} of the driver {name}", str(self.parameters.get(SET)))
        if not all(isinstance(each, str) or _is_number(each) for each in self.values.values()):
            raise UsageError(f"the parameters of the driver {name} must be finite numbers or texts")
        if self.check is not None:
            self.check(self.values)
        if self.check_clock is not None and self.rate_hz is not None:
            self.check_clock(self.values, 1 / self.rate_hz)

    @property
    def revision(self) -> int:
        """Which revision of its rule the class is."""
        revision: int = getattr(self.driver, "revision", 1)
        return revision

    @property
    def values(self) -> dict[str, Parameter]:
        """All parameters: those of the set that is chosen, and over them those that are given."""
        chosen = self.sets[str(self.parameters[SET])] if self.sets else {}
        return {**self.parameters, **chosen, **self.parameters}

    @property
    def described(self) -> str:
        """What it does, how often it decides, and its parameters, the chosen set first."""
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
        """The same with other parameters, and holding each action for a clock; raises UsageError.

        ``name`` is that of this program.
        """
        if changes and not self.settable:
            raise UsageError(f"the parameters of {name} stand in its source and cannot be set")
        values, given = self.values, dict(self.parameters)
        # Which other parameters there are depends on the set, so that it comes first.
        for each in sorted(changes, key=lambda each: each != SET):
            hint = f"each {SET} has parameters of its own" if self.sets else ""
            value, default = changes[each], require(values, f"parameter of {name}", each, hint)
            if isinstance(default, str) and isinstance(value, str):
                given[each] = value
            elif not isinstance(default, str) and _is_number(value):
                given[each] = float(value)
            else:
                wanted = "a text" if isinstance(default, str) else "a finite number"
                raise UsageError(f"{each} of {name} is {wanted}, as {default!r}, not {value!r}")
            if each == SET:
                values = replace(self, parameters=given).values
        return replace(
            self,
            parameters=given,
            rate_hz=self.rate_hz if clock_s is None else 1 / clock_s,
            based_on=self.based_on or name,
        )

    def make(self, scenario: ScenarioConfig, spec: TrialSpec, side: Side) -> Driver:
        """Return the driver of one side of a trial."""
        seat = self.seat(scenario, spec, side)
        if self.shared is None:
            return self.driver(seat)
        with _making:  # the plan of another thread may have other human trials
            if self.shared.digest != self.data.digest:
                self.shared.keep(self.data.trials)
            return self.driver(seat)

    def replaying(self, connection: DuckDBPyConnection | None) -> Program:
        """The same with the human trials of a database, if it replays some; None: it has none."""
        if self.data is None:
            return self
        own = copy(self.data)
        own.read(connection)
        return replace(self, data=own, shared=self.shared or self.data)

    def seat(self, scenario: ScenarioConfig, spec: TrialSpec, side: Side) -> ProgramSeat:
        """Return what that driver is given."""
        pace = program_pace(scenario, self.rate_hz)
        seeds = {each: take_seat(scenario, spec, each, pace).seed for each in SIDES}
        return ProgramSeat(
            scenario,
            side,
            pace,
            seeds[side],
            condition=spec.condition,
            repetition=spec.repetition,
            other_seed=seeds[other_side(side)],
            parameters=self.values,
        )

    def in_spec(self, name: str) -> dict[str, object]:
        """What the spec of its trials says of it."""
        said = {
            "program": name,
            "parameters": self.values,
            "revision": self.revision,
            "chance": self.chance or None,
            "rate_hz": self.rate_hz,
            "data": self.data and self.data.digest,
            "based_on": self.based_on or None,
        }
        # What there is not is left out, so that specs from before it keep their hashes.
        return {key: value for key, value in said.items() if value is not None}


def _is_number(value: object) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool) and isfinite(value)


PROGRAMS = Registry[Program]("driver")
