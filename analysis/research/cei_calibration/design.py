"""Trials for the calibration of thresholds: those that the runner would play."""

from __future__ import annotations

from analysis.research.cei_calibration.simulation import Trial
from merge_runner.config import Resistance, ScenarioConfig
from merge_runner.drivers.cei.agents import Model
from merge_runner.drivers.cei.motion import task_of
from merge_runner.drivers.cei.parameters import OFFSETS, TICK_S, Habits, ThresholdSet, offsets_of
from merge_runner.drivers.registry import PROGRAMS
from merge_runner.records import Side
from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner.trial_records import TrialSpec

# As often as each human pair drove each condition.
TRIALS_OF_A_PAIR = 10


def experiment(resistance: Resistance = "human") -> ScenarioConfig:
    """The human experiment: its clock, its collisions, and with "human" its resistance."""
    return ScenarioConfig(step_s=TICK_S, collision_rule="rectangle", resistance=resistance)


def model_of(thresholds: ThresholdSet, scenario: ScenarioConfig) -> Model:
    """The model on the human experiment's track."""
    return Model(task_of(scenario, TRACK), thresholds, Habits())


def design(
    thresholds: ThresholdSet,
    scenario: ScenarioConfig,
    sample_set: int,
    trials_of_a_pair: int = TRIALS_OF_A_PAIR,
) -> list[Trial]:
    """All conditions, ``each`` times with every synthetic pair: of 10 these are 990 trials.

    Their seeds are those of the slots, so that the driver ``cei`` drives them alike.
    """
    trials = []
    for name, condition in HUMAN_CONDITIONS.items():
        for repetition in range(1, trials_of_a_pair * len(OFFSETS) + 1):
            left, right = (thresholds.base(offset) for offset in offsets_of(0, repetition))
            seeds = (
                _seed(scenario, name, repetition, "left", sample_set),
                _seed(scenario, name, repetition, "right", sample_set),
            )
            trials.append(Trial(condition, (left, right), seeds))
    return trials


def _seed(
    scenario: ScenarioConfig, condition: str, repetition: int, side: Side, sample_set: int
) -> int:
    spec = TrialSpec(
        trial_id="",
        spec_hash="",
        source="driver",
        model_left="cei",
        model_right="cei",
        variant=None,
        condition=condition,
        repetition=repetition,
        sample_set=sample_set,
        order=0,
        kinematics=HUMAN_CONDITIONS[condition],
    )
    return PROGRAMS["cei"].make(scenario, spec, side).context.seed
