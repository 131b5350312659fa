"""The two drivers that need no model, from the first to the last step of every condition."""

import subprocess
import sys
from functools import partial

import pytest

from merge_runner.config import ScenarioConfig
from merge_runner.drivers.registry import PROGRAMS, Program
from merge_runner.errors import UsageError
from merge_runner.records import SIDES, TrialSpec
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner.trial import play_trial

MERGE_POINT_M = 100.0
LENGTH_M = 4.5
RULES = ("euclid2d", "rectangle", "shared_lane")


async def play(condition, driver, **scenario):
    """A trial with the same kind of driver on both sides."""
    scenario = ScenarioConfig(**scenario)
    spec = TrialSpec(
        trial_id="test",
        spec_hash="test",
        source="driver",
        model_left="test",
        model_right="test",
        variant="baseline",
        condition=condition,
        repetition=1,
        sample_set=0,
        order=0,
        kinematics=CONDITIONS[condition],
    )
    drivers = {side: PROGRAMS[driver].make(scenario, spec, side) for side in SIDES}
    return await play_trial(spec, scenario, drivers)


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("condition", CONDITIONS)
async def test_two_constant_drivers_collide_in_every_condition(condition, rule):
    trial = await play(condition, "constant", collision_rule=rule)
    assert (trial.status, trial.merged_first) == ("collided", None)
    assert {row.acceleration_mps2 for row in trial.states} == {0.0}


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("condition", CONDITIONS)
async def test_the_projected_order_lets_the_earlier_arrival_go_first_without_a_collision(
    condition, rule
):
    trial = await play(condition, "projected-order", collision_rule=rule)
    # The condition's name says who is projected to lead; on a tie the right one yields.
    first = "right" if CONDITIONS[condition].projected_headway_m < 0 else "left"
    assert (trial.status, trial.merged_first) == ("finished", first)


@pytest.mark.parametrize("condition", CONDITIONS)
async def test_under_the_projected_order_only_the_second_car_brakes_and_gently(condition):
    trial = await play(condition, "projected-order")
    first = trial.merged_first
    assert {row.acceleration_mps2 for row in trial.states if row.side == first} == {0.0}
    braking = [row.acceleration_mps2 for row in trial.states if row.side != first]
    assert -1.5 - 1e-9 <= min(braking) < 0


@pytest.mark.parametrize("condition", CONDITIONS)
async def test_under_the_projected_order_a_human_gap_is_open_at_the_merge_point(condition):
    """Net of the vehicle length, at the moment when the first car is there: 3.85 m."""
    trial = await play(condition, "projected-order")
    first = [row.position_m for row in trial.states if row.side == trial.merged_first]
    second = [row.position_m for row in trial.states if row.side != trial.merged_first]
    step = next(k for k, position in enumerate(first) if position >= MERGE_POINT_M)
    # The moment lies within a step, during which the cars drive at nearly constant speed.
    share = (MERGE_POINT_M - first[step - 1]) / (first[step] - first[step - 1])
    behind = second[step - 1] + share * (second[step] - second[step - 1])
    assert MERGE_POINT_M - behind - LENGTH_M == pytest.approx(3.85, abs=0.01)


@pytest.mark.parametrize("driver", ["constant", "projected-order"])
async def test_a_program_holds_one_action_over_a_whole_plan(driver):
    trial = await play("L_4_-8", driver)
    for row in trial.decisions:
        decision = row.decision
        assert decision.valid
        assert len(decision.plan) == 20
        assert decision.applied == decision.plan[:5]
        assert len(set(decision.plan)) == 1
        assert abs(decision.plan[0]) <= 1
        assert decision.prompt is None


class Undecided:
    def __init__(self, seat):
        self.seat = seat


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (lambda: Program(partial(Undecided), "x"), "is no class"),
        (lambda: Program(Undecided, "x", rate_hz=0), "needs a rate_hz above 0"),
        (lambda: Program(Undecided, "x", rate_hz=float("inf")), "needs a rate_hz above 0"),
        (lambda: Program(Undecided, "x", {"g": float("nan")}), "must be finite numbers"),
        (lambda: Program(Undecided, "x", {"g": {1}}), "must be finite numbers"),
        (lambda: PROGRAMS.register("a+b", PROGRAMS["constant"]), "needs a name of letters"),
    ],
)
def test_what_can_be_no_driver_is_refused(made, said):
    with pytest.raises(UsageError, match=said):
        made()


@pytest.mark.parametrize("first", ["registry", "idm", "base"])
def test_programs_are_listed_in_one_order_whichever_is_imported_first(first):
    listed = (
        f"import merge_runner.drivers.{first}\n"
        "from merge_runner.drivers.registry import PROGRAMS\n"
        "print(*PROGRAMS)"
    )
    command = [sys.executable, "-c", listed]
    found = subprocess.run(command, capture_output=True, text=True, check=True)
    assert found.stdout.split() == [
        "constant",
        "human-odds",
        "idm",
        "projected-order",
        "quantal",
        "cei",
        "human-replay",
    ]
