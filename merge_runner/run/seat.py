"""The first situations of a study, asked without the loop, in its conditions or on a grid.

To ask is to play a trial whose time is up before its drivers would decide again. It is planned,
played, kept and checked as any other trial; its calls have the texts and the slots, and so the
keys, of the first decisions of the study's sweep, and no call waits for another one.

What is asked stands in the tables of trials, with the source ``seat``: its states and decisions are
read as any others, and recordings, exports, audits and digests need to know nothing of it. Tables
of trials that were driven to their end leave that source out (``analysis.data.load.TRIALS``).
"""

from __future__ import annotations

import re
from dataclasses import replace
from decimal import Decimal
from itertools import product

from merge_runner.config import ScenarioConfig, validated
from merge_runner.errors import UsageError
from merge_runner.records import SIDES
from merge_runner.run.plan import Plan
from merge_runner.scenarios.merge.conditions import CONDITIONS, NUMBER, Condition, condition_name
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner.scenarios.merge.world import World

USUAL_GRID = "h=-6:6:2,dv=-1.6:1.6:0.4"
"""Projected headways in m and relative velocities in m/s, left minus right: FROM:TO:STEP."""
MOST_VALUES = 100  # of an axis
_AXIS = re.compile(
    f"(?P<name>h|dv)=(?P<first>{NUMBER})(:(?P<last>{NUMBER}):(?P<step>{NUMBER}))?", re.ASCII
)


def first_situations(plan: Plan) -> Plan:
    """The plan that asks what a sweep by the other plan asks first, and nothing more.

    Raises UsageError where both drivers cannot be asked at once.
    """
    arms = tuple(replace(arm, scenario=_one_decision(arm.scenario)) for arm in plan.arms)
    for arm, condition in product(arms, plan.conditions):
        _check(arm.scenario, condition)
    changes = {"name": f"{plan.study.name}-first", "arms": arms, "seat": "first"}
    return plan.model_copy(update=changes)


def _one_decision(scenario: ScenarioConfig) -> ScenarioConfig:
    """The scenario with no time for a second decision of a language model."""
    given = scenario.model_dump(exclude_unset=True)
    interval_s = 1 / scenario.prompt_rate_hz
    return validated(ScenarioConfig, {**given, "timeout_s": interval_s}, "scenario")


def _check(scenario: ScenarioConfig, condition: str) -> None:
    world = World(scenario, CONDITIONS[condition], TRACK)
    if world.status is not None:
        raise UsageError(f"{condition}: the vehicles collide before both are driven")
    if not all(map(world.in_control, SIDES)):
        raise UsageError(
            f"{condition}: a vehicle is in its tunnel yet when the first driver decides. First "
            'situations need control_start = "both_exits"'
        )


def grid_conditions(text: str) -> list[str]:
    """The names of the conditions of a grid such as USUAL_GRID, or ``usual``.

    ``h`` or ``dv`` may be one number, or be left out for that of the usual grid. Raises UsageError.
    """
    axes = dict(map(_axis, USUAL_GRID.split(",")))
    given = list(map(_axis, [] if text == "usual" else text.split(",")))
    if len({name for name, _ in given}) < len(given):
        raise UsageError(f"--grid: {text!r} has an axis twice; write it once, as FROM:TO:STEP")
    return [_named(*point) for point in product(*(axes | dict(given)).values())]


def _axis(text: str) -> tuple[str, list[float]]:
    """Name and values of a part of a grid, computed in decimals: 3 * 0.4 is 1.2."""
    found = _AXIS.fullmatch(text.strip())
    if found is None:
        raise UsageError(
            f"--grid: {text!r} is no axis; write --grid usual, or --grid {USUAL_GRID}: "
            "FROM:TO:STEP or one number for each, with at most four decimals"
        )
    first = Decimal(found["first"])
    last, step = Decimal(found["last"] or first), Decimal(found["step"] or 1)
    if step <= 0:
        raise UsageError(f"--grid: {text!r} has a step of {step}; it must be above 0")
    if first > last:
        raise UsageError(
            f"--grid: {text!r} runs backwards; write {found['name']}={last}:{first}:{step}"
        )
    count = int((last - first) / step) + 1
    if count > MOST_VALUES:
        raise UsageError(f"--grid: {text!r} is {count} values; it may be up to {MOST_VALUES}")
    return found["name"], [float(first + i * step) for i in range(count)]


def _named(headway_m: float, velocity_mps: float) -> str:
    Condition(headway_m, velocity_mps)  # raises where a vehicle would not drive forwards
    return condition_name(headway_m, velocity_mps)
