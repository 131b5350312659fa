"""Trials that programs drive."""

from dataclasses import replace

from merge_runner.records import SIDES
from merge_runner.trial import Trial, play_trial
from tests.support.specs import spec_of

OTHER = {"left": "right", "right": "left"}


def spec(condition, repetition=1):
    trial_id = f"m/baseline/{condition}/rep{repetition:02d}"
    return spec_of(condition, repetition=repetition, trial_id=trial_id)


def ask_nobody(question):
    raise AssertionError(f"a program asks {question}")


def both(program):
    return dict.fromkeys(SIDES, program)


def play(programs, condition, repetition=1, *, scenario, seeds=None):
    """A trial of these programs by side; ``seeds`` by side in place of the slot's."""
    trial, drivers = spec(condition, repetition), {}
    for side, program in programs.items():
        drivers[side] = driver = program.make(scenario, trial, side)
        if seeds is not None:
            seeded = replace(driver.context, seed=seeds[side], other_seed=seeds[OTHER[side]])
            drivers[side] = program.driver(seeded)
    return play_trial(Trial(trial, scenario, drivers), ask_nobody)


def driven_by(plan, number=0):
    """A trial of a plan whose drivers are programs."""
    trial, (arm, *_), programs = plan.trial_specs()[number], plan.arms, plan.parts.programs
    drivers = {side: programs[arm.sides[side]].make(arm.scenario, trial, side) for side in SIDES}
    return play_trial(Trial(trial, arm.scenario, drivers), ask_nobody)
