"""Trials of the model: played by the runner, and simulated."""

from analysis.research.cei_calibration.simulation import Trial
from merge_runner.config import ScenarioConfig
from merge_runner.drivers.cei.agents import Model
from merge_runner.drivers.cei.motion import task_of
from merge_runner.drivers.cei.parameters import SETS, Habits, offsets_of
from merge_runner.drivers.registry import PROGRAMS
from merge_runner.records import SIDES
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner.scenarios.merge.geometry import TRACK
from tests.support.driven_trials import both, play, spec


def scenario(**changes):
    usual = {"step_s": 0.05, "collision_rule": "rectangle", "resistance": "human"}
    return ScenarioConfig(**usual | changes)


def model(task, **habits):
    return Model(task_of(task, TRACK), SETS["K0"], Habits(**habits))


def cei(*, clock=None, **changes):
    """The program as a study may change it."""
    return PROGRAMS["cei"].with_changes("cei", changes, clock)


def played(condition, repetition, task, program):
    return play(both(program), condition, repetition, scenario=task)


def simulated(condition, repetition, task):
    """The same trial for the batch: same seeds, same pair."""
    one = spec(condition, repetition)
    left, right = (PROGRAMS["cei"].make(task, one, side).context.seed for side in SIDES)
    offsets = offsets_of(0, repetition)
    drivers = SETS["K0"].base(offsets.left), SETS["K0"].base(offsets.right)
    return Trial(CONDITIONS[condition], drivers, (left, right))
