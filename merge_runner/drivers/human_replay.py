"""The program ``human-replay``: one side of an imported human trial, without reactions."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import islice, pairwise
from typing import TYPE_CHECKING, NamedTuple

from merge_runner.config import ScenarioConfig
from merge_runner.drivers.base import DriverContext
from merge_runner.drivers.registry import PROGRAMS, Program
from merge_runner.errors import UsageError, unknown_name
from merge_runner.records import SIDES, Decision, Observation, Side
from merge_runner.scenarios.merge.vehicle import net_acceleration

if TYPE_CHECKING:
    from duckdb import DuckDBPyConnection

HUMAN_REPLAY = "human-replay"
EVERY_PAIR = "all"
SAMPLE_S = 0.05  # the recorder's clock
ROUNDING = 1e-6
TRACES = """
SELECT pair, rep, condition, spec_hash, side, list(position_m ORDER BY step),
    list(velocity_mps ORDER BY step), max(time_s)
FROM trials JOIN states USING (trial_id, spec_hash)
WHERE source = 'human' AND status = 'finished' AND step >= 0
GROUP BY ALL ORDER BY pair, rep, condition, spec_hash, side
"""
_Samples = dict[Side, tuple[tuple[float, ...], tuple[float, ...]]]
NOT_IMPORTED = (
    f"{HUMAN_REPLAY} drives imported human trials, and the database holds none: merge-runner human "
    "import PATH adds them (name the same --db)"
)


class HumanTrial(NamedTuple):
    """Human trial from the start of control on, with a sample every 0.05 s.

    ``number`` counts the trials of a ``pair``. Positions are travelled distances in m, speeds in
    m/s, both by side.
    """

    pair: str
    number: int
    condition: str
    positions_m: Mapping[Side, tuple[float, ...]]
    speeds_mps: Mapping[Side, tuple[float, ...]]

    @property
    def starts(self) -> dict[Side, tuple[float, float]]:
        """Position and speed of both sides at the start of control."""
        return {side: (self.positions_m[side][0], self.speeds_mps[side][0]) for side in SIDES}

    def net_mps2(self, side: Side) -> list[float]:
        """Return the net accelerations of a side from each sample to the next."""
        return [(after - before) / SAMPLE_S for before, after in pairwise(self.speeds_mps[side])]


class ImportedHumans:
    """Finished human trials of a database, and their hash ``digest``."""

    def __init__(self, trials: tuple[HumanTrial, ...] = ()) -> None:
        self.trials = trials
        self.digest = hashlib.sha256(repr(trials).encode()).hexdigest()
        self._usable: dict[tuple[object, ...], list[HumanTrial]] = {}

    def read(self, connection: DuckDBPyConnection | None) -> ImportedHumans:
        """Return the trials of a database; None: there is no database yet."""
        return ImportedHumans(() if connection is None else imported_trials(connection))

    def usable(self, config: ScenarioConfig, condition: str, pair: str) -> list[HumanTrial]:
        """Return the trials of a condition that these vehicles can drive, pairs in turn."""
        key = (condition, pair, config.resistance, config.max_acceleration_mps2)
        if key not in self._usable:
            chosen = [
                trial
                for trial in self.trials
                if trial.condition == condition
                and pair in (EVERY_PAIR, trial.pair)
                and _can_be_driven(config, trial)
            ]
            turns: dict[str, int] = {}
            order = []
            for trial in sorted(chosen, key=lambda t: (t.pair, t.number)):
                turns[trial.pair] = turns.get(trial.pair, 0) + 1
                order.append((turns[trial.pair], trial.pair, trial))
            self._usable[key] = [trial for *_, trial in sorted(order, key=lambda turn: turn[:2])]
        return self._usable[key]

    def check(
        self, program: Program, config: ScenarioConfig, condition: str, repetitions: int
    ) -> None:
        """Raise UsageError unless a program has a trial of a condition for each repetition."""
        pair = str(program.values["pair"])
        if not self.trials:
            raise UsageError(NOT_IMPORTED)
        if program.rate_hz != 1 / SAMPLE_S:
            raise UsageError(f"{HUMAN_REPLAY} takes no clock: what a human did stays as it was")
        pairs = sorted({trial.pair for trial in self.trials})
        if pair not in (EVERY_PAIR, *pairs):
            raise unknown_name(f"pair of {HUMAN_REPLAY}", pair, (EVERY_PAIR, *pairs))
        if (config.step_s, config.control_start) != (SAMPLE_S, "both_exits"):
            raise UsageError(
                f"{HUMAN_REPLAY} needs a world of step_s = {SAMPLE_S} and control_start = "
                '"both_exits": set them under [scenario] of the sweep\'s file'
            )
        available = len(self.usable(config, condition, pair))
        if repetitions > available:
            raise UsageError(
                f"{HUMAN_REPLAY} has {available} trials of {condition} to replay, and "
                f"{repetitions} repetitions are asked for: choose fewer by --reps, "
                "or other --conditions"
            )


def imported_trials(connection: DuckDBPyConnection) -> tuple[HumanTrial, ...]:
    """Return the finished human trials of a database, each once even if imported twice.

    Trials of another clock than the recorder's are left out.
    """
    ways: dict[tuple[str, int, str], dict[str, _Samples]] = {}
    for row in connection.execute(TRACES).fetchall():
        pair, number, condition, way, side, positions_m, speeds_mps, end_s = row
        if abs(end_s - SAMPLE_S * (len(speeds_mps) - 1)) < SAMPLE_S / 2:
            samples = ways.setdefault((pair, number, condition), {}).setdefault(way, {})
            samples[side] = tuple(positions_m), tuple(speeds_mps)
    trials = []
    for key, imported in ways.items():
        whole = (samples for samples in imported.values() if len(samples) == len(SIDES))
        for samples in islice(whole, 1):
            positions = {side: positions_m for side, (positions_m, _) in samples.items()}
            speeds = {side: speeds_mps for side, (_, speeds_mps) in samples.items()}
            trials.append(HumanTrial(*key, positions, speeds))
    return tuple(trials)


def _can_be_driven(config: ScenarioConfig, trial: HumanTrial) -> bool:
    """Return True if the scenario's vehicles reach every acceleration of the trial."""
    limit = config.max_acceleration_mps2 * (1 + ROUNDING)
    return all(
        abs(net - net_acceleration(0.0, speed, config.resistance)) <= limit
        for side in SIDES
        for net, speed in zip(trial.net_mps2(side), trial.speeds_mps[side], strict=False)
    )


@dataclass(slots=True)
class HumanReplayDriver:
    """Driver that executes a human's accelerations, and then keeps its speed."""

    context: DriverContext
    trial: HumanTrial = field(init=False)
    _net_mps2: list[float] = field(init=False)

    def __post_init__(self) -> None:
        """Raise UsageError if there is no such trial."""
        context = self.context
        pair = str(context.parameters["pair"])
        usable = context.data.usable(context.scenario, context.condition, pair)
        if len(usable) < context.repetition:
            raise UsageError(NOT_IMPORTED)
        self.trial = usable[context.repetition - 1]
        self._net_mps2 = self.trial.net_mps2(context.side)

    @property
    def starts(self) -> Mapping[Side, tuple[float, float]]:
        """Position and speed of both sides at the start of the human trial."""
        return self.trial.starts

    async def decide(self, observation: Observation, number: int) -> Decision:
        """Return the human's acceleration to the next sample, whatever speed is perceived."""
        if number < len(self._net_mps2):
            own_mps = self.trial.speeds_mps[self.context.side][number]
            return self.context.accelerating(self._net_mps2[number], own_mps)
        return self.context.accelerating(0.0, observation.own_speed_mps)


PROGRAMS.register(
    HUMAN_REPLAY,
    Program(
        HumanReplayDriver,
        "one side of an imported human trial; this human does not react",
        {"pair": EVERY_PAIR},
        1 / SAMPLE_S,
        settable=True,
        data=ImportedHumans(),
    ),
)
