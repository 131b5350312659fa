"""The step of a world: as fine as its drivers need."""

from __future__ import annotations

from collections.abc import Mapping
from fractions import Fraction
from functools import reduce
from math import gcd

from merge_runner.config import ScenarioConfig, validated
from merge_runner.drivers.registry import Program

FINEST = 1_000_000  # steps in a second; decimals like 0.05 become the fractions that they stand for


def with_world_step(scenario: ScenarioConfig, programs: Mapping[str, Program]) -> ScenarioConfig:
    """The scenario with the largest step of which every program's interval is a whole number.

    A language model's plan keeps its actions, of which each then lasts several steps. A ``step_s``
    that a study gives stays: what does not fit it is refused (``drivers.pace``). Raises UsageError.
    """
    rates_hz = [program.rate_hz for program in programs.values() if program.rate_hz is not None]
    if "step_s" in scenario.model_fields_set or not rates_hz:
        return scenario
    times_s = [scenario.step_s, scenario.action_s, *(1 / rate_hz for rate_hz in rates_hz)]
    step_s = float(reduce(_common, map(_fraction, times_s)))
    if step_s == scenario.step_s:
        return scenario
    given = scenario.model_dump(exclude_unset=True)
    fine = {**given, "step_s": step_s, "plan_step_s": scenario.action_s}
    return validated(ScenarioConfig, fine, f"a world for {', '.join(programs)}")


def _fraction(seconds: float) -> Fraction:
    return Fraction(seconds).limit_denominator(FINEST)


def _common(one: Fraction, other: Fraction) -> Fraction:
    """The largest time of which both are whole multiples."""
    denominator = one.denominator * other.denominator
    return Fraction(
        gcd(one.numerator * other.denominator, other.numerator * one.denominator), denominator
    )
