"""One trial: whoever is due observes the same frozen state and decides, and both are driven.

What a driver is told of that state may be late, with errors, missing now and then, or not that far.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from itertools import takewhile
from math import exp, inf, sqrt, tanh
from statistics import NormalDist

from merge_runner.chance import draw
from merge_runner.config import PERFECT, Perception, ScenarioConfig
from merge_runner.drivers.base import Driver
from merge_runner.errors import UsageError
from merge_runner.records import (
    FAR_BEHIND_M,
    SIDES,
    CallFailed,
    Decision,
    DecisionRow,
    FailedCall,
    Observation,
    ReplayMiss,
    Side,
    TrialRecord,
    TrialSpec,
)
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner.scenarios.merge.world import World

TOP = 2**31
"""The error processes last so many milliseconds; time 0 is in the middle."""


async def play_trial(
    spec: TrialSpec,
    scenario: ScenarioConfig,
    drivers: Mapping[Side, Driver],
    *,
    in_turn: bool = False,
) -> TrialRecord:
    """Play a trial to its end, or until a call fails.

    Drivers are asked at once, or ``in_turn`` where their answers are there already. Raises
    UsageError for a decision that cannot be driven, and what a driver raises but CallFailed.
    """
    # Each side starts as its own driver says, or else as the other's does.
    given = {side: d.starts for side, d in drivers.items() if hasattr(d, "starts")}
    starts = {side: given.get(side, other)[side] for other in given.values() for side in SIDES}
    world = World(scenario, spec.kinematics, TRACK, starts)
    seats = [_Seated(drivers[side], side, scenario, world) for side in SIDES]
    decisions: list[DecisionRow] = []
    failures: dict[Side, CallFailed] = {}
    failed_calls: list[FailedCall] = []
    while world.status is None and not failures:
        due = [seat for seat in seats if seat.is_due()]
        if in_turn or len(due) < 2:  # both
            answers = [await seat.ask() for seat in due]
        else:
            answers = await _ask_at_once(due)
        for seat, answer in zip(due, answers, strict=True):
            number, side = world.step // seat.interval, seat.side
            if isinstance(answer, CallFailed):
                failures[side] = answer
                missed = isinstance(answer, ReplayMiss)
                call = answer.request, answer.attempts, answer.earlier
                failed_calls.append(FailedCall(number, side, *call, missed=missed))
            else:
                seat.take(answer)
                decisions.append(DecisionRow(number, world.time_s, side, answer, seat.told))
        if not failures:
            world.advance({seat.side: seat.action() for seat in seats})
    return TrialRecord(
        spec=spec,
        status=world.status or "failed",
        merged_first=None if failures else world.merged_first(),
        end_time_s=world.time_s,
        error="; ".join(f"{side}: {exc}" for side, exc in failures.items()) or None,
        states=world.states(),
        decisions=tuple(decisions),
        failed_calls=tuple(failed_calls),
    )


async def _ask_at_once(seats: Sequence[_Seated]) -> list[Decision | CallFailed]:
    """Ask drivers side by side; where one raises, no other goes on when this returns."""
    asking = [asyncio.create_task(seat.ask()) for seat in seats]
    try:
        return await asyncio.gather(*asking)
    finally:
        if left := [task for task in asking if not task.done()]:
            for task in left:
                task.cancel()
            await asyncio.gather(*left, return_exceptions=True)


class _Seated:
    """A driver in its trial: what it decided last, and at which step of the world.

    It has ``eyes`` where its perception is imperfect, and was ``told`` what they saw.
    """

    def __init__(self, driver: Driver, side: Side, scenario: ScenarioConfig, world: World) -> None:
        self.driver, self.side, self._world = driver, side, world
        self._pace = driver.seat.pace
        self.interval = self._pace.interval_steps
        perception, self.eyes = scenario.perception(side), None
        if perception != PERFECT:
            observe = partial(world.observe, side)
            self.eyes = Eyes(perception, driver.seat.seed, scenario.step_s, observe)
        self.told: Observation | None = None
        self._applied: tuple[float, ...] | None = None
        self._decided_at = 0

    def is_due(self) -> bool:
        """Whether it decides now: its instants count from the start of the trial."""
        return self._world.step % self.interval == 0 and self._world.in_control(self.side)

    async def ask(self) -> Decision | CallFailed:
        """Ask the driver; where its call fails, the other's answer is still awaited."""
        self.told = self.eyes.told(self._world.step) if self.eyes else None
        observation = self.told or self._world.observe(self.side)
        try:
            return await self.driver.decide(observation, self._world.step // self.interval)
        except CallFailed as failure:
            return failure

    def take(self, decision: Decision) -> None:
        """Drive by a decision from now on; raises UsageError for one that cannot be driven."""
        applied, wanted = decision.applied, self._pace.executed_actions
        if len(applied) != wanted or not all(-1 <= action <= 1 for action in applied):
            raise UsageError(
                f"the {self.side} driver decided on {applied}, and is to drive {wanted} actions "
                "from -1 to 1"
            )
        self._applied, self._decided_at = applied, self._world.step

    def action(self) -> float | None:
        """What is driven in a step; None: nothing is decided yet, and the vehicle cruises."""
        if self._applied is None:
            return None
        return self._applied[(self._world.step - self._decided_at) // self._pace.action_steps]


class Eyes:
    """The eyes of one driver in one trial, which ``observe`` the truth at a step of the world.

    ``seed`` is that of the driver's seat, so that a slot has the same errors whoever drives.
    """

    def __init__(
        self,
        perception: Perception,
        seed: int,
        step_s: float,
        observe: Callable[[int], Observation],
    ) -> None:
        self._perception, self._seed, self._step_s = perception, seed, step_s
        self._distance, self._speed, self._own_distance, self._own_speed = (
            error_process((seed, f"error of {name}"), sd, perception.autocorrelation_s)
            for name, sd in (
                ("distance", perception.position_sd_m),
                ("speed", perception.speed_sd_mps),
                ("own distance", perception.position_sd_m * perception.own),
                ("own speed", perception.speed_sd_mps * perception.own),
            )
        )
        self._observe, start = observe, observe(0)
        self._received = replace(start, other_seen=self._in_sight(start))

    def told(self, step: int) -> Observation:
        """What the driver is told at a step, the present one."""
        now_s, truth = step * self._step_s, self._observe(step)
        if draw(self._seed, "received", round(1000 * now_s)) >= self._perception.dropout:
            self._received = self._perceived(now_s - self._perception.delay_s)
        own_speed_mps = max(0.0, truth.own_speed_mps + self._own_speed(now_s))
        farther_m = self._own_distance(now_s)
        to_merge_m = truth.distance_to_merge_m
        other = self._received
        if not other.other_seen:
            other = replace(
                other,
                other_speed_mps=own_speed_mps,
                relative_distance_m=-FAR_BEHIND_M,
                other_speeds_mps=(),
                other_acceleration_mps2=0.0,
            )
        return replace(
            other,
            road=truth.road,
            own_speed_mps=own_speed_mps,
            own_position_m=truth.own_position_m + farther_m,
            distance_to_merge_m=None if to_merge_m is None else to_merge_m - farther_m,
            own_accelerations_mps2=truth.own_accelerations_mps2,
        )

    def _perceived(self, time_s: float) -> Observation:
        """The other as it appeared at a time, with its speeds since it came into sight."""
        truth = self._at(time_s)
        newest_first = [
            (time_s - steps * self._step_s, speed)
            for steps, speed in enumerate(reversed(truth.other_speeds_mps), start=1)
        ]
        seen = takewhile(lambda sample: self._in_sight(self._at(sample[0])), newest_first)
        return replace(
            truth,
            other_seen=self._in_sight(truth),
            other_speed_mps=self._appears(truth.other_speed_mps, time_s),
            relative_distance_m=truth.relative_distance_m + self._distance(time_s),
            other_speeds_mps=tuple(self._appears(speed, then_s) for then_s, speed in seen)[::-1],
        )

    def _appears(self, speed_mps: float, time_s: float) -> float:
        """An error lets no speed appear negative: nobody drives backwards."""
        return max(0.0, speed_mps + self._speed(time_s))

    def _in_sight(self, truth: Observation) -> bool:
        near = abs(truth.relative_distance_m) <= (self._perception.range_m or inf)
        to_merge_m = truth.distance_to_merge_m or 0.0
        return truth.other_seen and near and to_merge_m <= (self._perception.view_from_m or inf)

    def _at(self, time_s: float) -> Observation:
        """The truth at a time; before the start of control both cruised."""
        step = round(time_s / self._step_s)
        if step >= 0:
            return self._observe(step)
        start = self._observe(0)
        ahead_m = (start.other_speed_mps - start.own_speed_mps) * time_s
        return replace(
            start,
            relative_distance_m=start.relative_distance_m + ahead_m,
            distance_to_merge_m=(start.distance_to_merge_m or 0.0) - start.own_speed_mps * time_s,
        )


def error_process(
    stream: tuple[object, ...], sd: float, autocorrelation_s: float
) -> Callable[[float], float]:
    """Gaussian errors with exponential autocorrelation (Uhlenbeck and Ornstein, 1930), by time.

    The value at a time in s is a function of the ``stream`` and the time alone, to the millisecond:
    whoever asks, in whatever steps and order, finds the same process. It is laid out by halves
    (as Levy's construction of Brownian motion is): the process is Markov, so that the value in the
    middle of two known ones, x to either side, has the mean of both over cosh(x / tau), and the
    variance sd^2 tanh(x / tau).
    """

    @cache
    def standard(place: int) -> float:
        uniform = draw(*stream, place)
        chance = NormalDist().inv_cdf(0.5 + (uniform - 0.5) * (1 - 2**-52))
        if place == 0:
            return chance
        aside = place & -place  # to the neighbours of which it is the middle
        ratio = aside / (1000 * autocorrelation_s) if autocorrelation_s else inf
        if place == TOP:
            kept = exp(-ratio)
            return kept * standard(0) + sqrt(1 - kept**2) * chance
        variance = tanh(ratio)
        ends = standard(place - aside) + standard(place + aside)
        return ends / 2 * sqrt(1 - variance**2) + sqrt(variance) * chance

    return lambda time_s: sd * standard(TOP // 2 + round(1000 * time_s)) if sd else 0.0
