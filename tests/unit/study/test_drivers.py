"""Drivers that a study makes of programs, and the world that they are driven in."""

import json
import tomllib

import pytest

from merge_runner.drivers.registry import PROGRAMS
from merge_runner.registry import using
from merge_runner.run.spec import spec_text
from merge_runner.study.file import StudyFile
from merge_runner.study.parts import declared_catalogue
from tests.support.braking import BRAKING
from tests.support.driven_trials import driven_by

HEAD = 'repetitions = 1\nconditions = ["N_0_0"]\n'


@pytest.fixture
def plan_of(plan_of):
    """Makes the plan of a study's text beside a plug-in with a program of 20 Hz."""
    added = '\n[plugins]\nfiles = ["mine.py"]\n'
    return lambda text, models=(): plan_of(text + added, models, BRAKING)


def specs(plan):
    """What the spec of each arm says."""
    return [json.loads(spec_text(plan, arm, "N_0_0")) for arm in plan.arms]


def hashes(plan):
    return {spec.spec_hash for spec in plan.trial_specs()}


MINE = '[drivers.mine]\nprogram = "braking"\n'


def test_a_driver_of_a_study_drives_by_its_parameters_and_has_them_in_its_spec(plan_of):
    plan = plan_of(MINE + "strength = 0.5\n", "mine")
    assert {row.decision.applied for row in driven_by(plan).decisions} == {(-0.5,)}
    (spec,) = specs(plan)
    assert spec["left"]["parameters"] == {"set": "mild", "strength": 0.5, "unused": 1.0}
    assert (spec["left"]["program"], spec["left"]["based_on"]) == ("mine", "braking")
    before = hashes(plan)
    assert not before & hashes(plan_of(MINE + "strength = 0.6\n", "mine"))


def test_a_set_brings_its_parameters_and_single_ones_go_before_it(plan_of):
    plan = plan_of(MINE + 'set = "hard"\nunused = 3\n', "mine")
    assert specs(plan)[0]["left"]["parameters"] == {"set": "hard", "strength": 0.9, "unused": 3.0}
    assert {row.decision.applied for row in driven_by(plan).decisions} == {(-0.9,)}


def test_it_stands_in_pairs_and_in_the_sweep_with_its_study(plan_of):
    plan = plan_of(MINE, ["mine+emulator", "constant+mine"])
    assert [arm.sides["left"] for arm in plan.arms] == ["mine", "constant"]
    assert "[drivers.mine]" in plan.model_dump(mode="json")["study"]["text"]


def test_a_clock_holds_each_action(plan_of):
    plan = plan_of(MINE + "clock = 1.0\n", "mine")
    trial = driven_by(plan)
    left = [row for row in trial.decisions if row.side == "left"]
    assert [row.time_s for row in left] == [float(n) for n in range(len(left))]
    assert specs(plan)[0]["left"]["rate_hz"] == 1.0


def test_a_stored_study_has_its_drivers_without_running_its_plugins(plan_of):
    text = plan_of(MINE + '[drivers.slow]\nprogram = "constant"\nclock = 2.0\n', "mine").study.text
    plan_of("", "constant")
    content = tomllib.loads(text.replace("braking", "not-installed"))
    with using(declared_catalogue(StudyFile.model_validate(content))):
        assert PROGRAMS["slow"].rate_hz == 0.5
        assert "mine" not in PROGRAMS


def steps(plan):
    return {arm.model: (arm.scenario.step_s, arm.scenario.plan_step_s) for arm in plan.arms}


def test_a_world_is_as_fine_as_its_drivers_need_and_otherwise_as_it_was(plan_of):
    slow = '[drivers.slow]\nprogram = "braking"\nclock = 1.0\n'
    odd = '[drivers.odd]\nprogram = "braking"\nclock = 0.3\n'
    plan = plan_of(slow + odd, ["braking", "emulator+braking", "constant", "slow", "odd"])
    assert steps(plan) == {
        "braking": (0.05, 0.2),
        "emulator+braking": (0.05, 0.2),
        "constant": (0.2, None),
        "slow": (0.2, None),
        "odd": (0.1, 0.2),
    }
