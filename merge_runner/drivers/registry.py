"""The programs that drive; one whose source is edited is another driver."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from importlib import import_module
from math import inf, isfinite
from pkgutil import iter_modules
from typing import TYPE_CHECKING, Any, Protocol

from merge_runner import drivers
from merge_runner.config import ScenarioConfig
from merge_runner.drivers.base import Driver, take_seat
from merge_runner.drivers.pace import program_pace
from merge_runner.drivers.program_seat import Parameter, ProgramSeat
from merge_runner.errors import UsageError
from merge_runner.records import SIDES, Side, TrialSpec, other_side
from merge_runner.registry import Registry, require
from merge_runner.source import source_digest

if TYPE_CHECKING:
    from duckdb import DuckDBPyConnection

EMULATOR = "emulator"
MOCKS = frozenset({EMULATOR, "random"})
"""The models of our own, under whose names no other is expected to answer."""
SET = "set"  # the parameter that names a set of others
RESERVED = ("program", "clock")  # what a study says of a driver beside its parameters


class HumanTrials(Protocol):
    """Imported human trials that a program drives again; ``digest`` is their hash."""

    digest: str

    def read(self, connection: DuckDBPyConnection | None) -> None:
        """Take the human trials of a database; None: there is no database yet."""
        ...

    def check(
        self, program: Program, config: ScenarioConfig, condition: str, repetitions: int
    ) -> None:
        """Raise UsageError where a program has too few trials of a condition to replay."""
        ...


@dataclass(frozen=True, slots=True)
class Program:
    """A class whose instances drive, made with a ProgramSeat.

    ``meaning`` says in a few words what it does, and ``parameters`` are those of its rule. It
    decides ``rate_hz`` times a second; None: at the prompt rate of the scenario. A ``settable``
    program reads its parameters from its seat, so that a study can set them. ``sets`` are named
    sets of further parameters, of which the parameter ``set`` chooses one. ``check`` raises
    UsageError for parameters that cannot be, ``check_clock`` for a clock in s (the time between two
    decisions) that cannot be beside them. ``data`` are human trials that it replays. ``chance``
    declares that it draws by the seed of its seat: the analysis counts equal trials of drivers that
    do not once. ``based_on`` names the program that a study has given other parameters or another
    clock.
    """

    driver: Callable[[ProgramSeat], Driver]
    meaning: str
    parameters: Mapping[str, Parameter] = field(default_factory=dict)
    rate_hz: float | None = None
    settable: bool = False
    sets: Mapping[str, Mapping[str, Parameter]] = field(default_factory=dict)
    check: Callable[[Mapping[str, Parameter]], None] | None = None
    check_clock: Callable[[Mapping[str, Parameter], float], None] | None = None
    data: HumanTrials | None = None
    chance: bool = False
    based_on: str = ""

    def __post_init__(self) -> None:
        """Raises UsageError for what can be no driver, or could not be told apart from another."""
        if not isinstance(self.driver, type):
            raise UsageError(f"the driver {self.driver!r} is no class: its source is not known")
        name = self.driver.__qualname__
        if self.rate_hz is not None and not 0 < self.rate_hz < inf:
            raise UsageError(f"the driver {name} needs a rate_hz above 0")
        if self.sets:
            require(self.sets, f"{SET} of the driver {name}", str(self.parameters.get(SET)))
        if not all(map(_can_be, self.values.values())):
            raise UsageError(f"the parameters of the driver {name} must be finite numbers or texts")
        if taken := {*RESERVED} & {*self.values}:
            raise UsageError(f"the driver {name} needs another name for its parameter {min(taken)}")
        if self.check is not None:
            self.check(self.values)
        if self.check_clock is not None and self.rate_hz is not None:
            self.check_clock(self.values, 1 / self.rate_hz)

    @property
    def values(self) -> dict[str, Parameter]:
        """All parameters: those of the set that is chosen, and over them those that are given."""
        chosen = self.sets[str(self.parameters[SET])] if self.sets else {}
        return {**self.parameters, **chosen, **self.parameters}

    @property
    def described(self) -> str:
        """What it does, how often it decides, and its parameters, the chosen set first."""
        often = "once" if self.rate_hz == 1 else f"{self.rate_hz or 0:g} times"
        rate = "" if self.rate_hz is None else f" ({often} a second)"
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
        if clock_s is not None and self.rate_hz is not None and clock_s < 1 / self.rate_hz:
            raise UsageError(
                f"clock = {clock_s:g} is too fast: {name} decides every {1 / self.rate_hz:g} s, "
                "and a clock can only slow it down"
            )
        # Which other parameters there are depends on the set.
        chosen = {SET: _like(self.values, name, SET, changes[SET])} if SET in changes else {}
        values = replace(self, parameters={**self.parameters, **chosen}).values
        for each in changes.keys() - values.keys():
            if having := [f'"{one}"' for one, numbers in self.sets.items() if each in numbers]:
                raise UsageError(
                    f"{each} of {name} is a number of its sets: name one beside it, "
                    f"{SET} = {' or '.join(having)}"
                )
        given = {each: _like(values, name, each, value) for each, value in changes.items()}
        return replace(
            self,
            parameters={**self.parameters, **given},
            rate_hz=self.rate_hz if clock_s is None else 1 / clock_s,
            based_on=self.based_on or name,
        )

    @property
    def source(self) -> str:
        """The hash of its source; see ``source_digest``."""
        assert isinstance(self.driver, type)
        return source_digest(self.driver)

    def make(self, scenario: ScenarioConfig, spec: TrialSpec, side: Side) -> Driver:
        """Return the driver of one side of a trial."""
        return self.driver(self.seat(scenario, spec, side))

    def seat(self, scenario: ScenarioConfig, spec: TrialSpec, side: Side) -> ProgramSeat:
        """Return the seat of one side of a trial."""
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
        """What the spec of its trials says of it; its version covers what all drivers share."""
        return {
            "program": name,
            "parameters": self.values,
            "source": self.source,
            # Left out where there is none, so that specs from before it keep their hashes.
            **({"chance": True} if self.chance else {}),
            **({} if self.rate_hz is None else {"rate_hz": self.rate_hz}),
            **({} if self.data is None else {"data": self.data.digest}),
            **({"based_on": self.based_on} if self.based_on else {}),
        }


def _can_be(value: object) -> bool:
    return isinstance(value, str) or (isinstance(value, int | float) and isfinite(value))


def _like(values: Mapping[str, Parameter], program: str, name: str, value: object) -> Parameter:
    """A parameter as it is set; raises UsageError where it is unknown or of another type."""
    default = require(values, f"parameter of {program}", name)
    if isinstance(default, str) and isinstance(value, str):
        return value
    number = isinstance(value, int | float) and not isinstance(value, bool) and isfinite(value)
    if isinstance(default, str) or not number:
        wanted = "a text" if isinstance(default, str) else "a finite number"
        raise UsageError(f"{name} of {program} is {wanted}, as {default!r}, not {value!r}")
    assert isinstance(value, int | float)
    return float(value)


PROGRAMS = Registry[Program]("driver")


def language_models(names: Mapping[Side, str], spec: Mapping[str, Any]) -> dict[Side, str]:
    """Of the drivers' names those of language models, as the spec of their trials tells them.

    It knows the programs of a study, too, which may not be registered here.
    """
    return {side: name for side, name in names.items() if "program" not in (spec.get(side) or {})}


def has_chance(spec: Mapping[str, Any], sides: Collection[Side] = SIDES) -> bool:
    """Return whether drivers of a spec, or what they perceive, are drawn by chance.

    A language model samples; a program declares it.
    """
    scenario = ScenarioConfig.model_validate(spec.get("scenario", {}))
    drivers = [spec.get(side) or {} for side in sides]
    return any("program" not in driver or driver.get("chance") for driver in drivers) or any(
        scenario.perception(side).is_random for side in sides
    )


def unresponsive(spec: Mapping[str, Any]) -> str:
    """Return what to say wherever trials of a spec are shown; empty where no human is replayed."""
    sides = [side for side in SIDES if "data" in (spec.get(side) or {})]
    if len(sides) == len(SIDES):
        return "both humans are replayed and do not react"
    return f"the human on the {sides[0]} is replayed and does not react" if sides else ""


def stand_in(models: Mapping[Side, str], sides: Collection[Side] = SIDES) -> str:
    """What is said of trials of these language models in which a stand-in answered on these sides.

    A side that a program drives has no model.
    """
    named = {side: name for side, name in models.items() if name not in MOCKS}
    posing = "+".join(dict.fromkeys(name for side, name in named.items() if side in sides))
    real = [side for side in named if side not in sides]
    where = f" on the {'left' if real == ['right'] else 'right'}" if real else ""
    return f"scripted stand-in{where}, {f'not {posing}' if posing else 'no language model'}"


# Each program registers itself, in a module of this package that nobody else needs to name.
for _module in iter_modules(drivers.__path__, f"{drivers.__name__}."):
    import_module(_module.name)
