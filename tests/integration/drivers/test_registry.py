"""The drivers that need no model: what they do, and what can be none."""

import subprocess
import sys
from functools import partial

import pytest

from merge_runner.config import ScenarioConfig
from merge_runner.drivers.registry import PROGRAMS, Program
from merge_runner.errors import UsageError
from merge_runner.scenarios.merge.conditions import CONDITIONS
from tests.support.driven_trials import both, play

CONSTANT = PROGRAMS["constant"].driver


@pytest.mark.parametrize("rule", ["euclid2d", "rectangle", "shared_lane"])
@pytest.mark.parametrize("condition", CONDITIONS)
def test_the_projected_order_opens_a_human_gap_behind_the_earlier_arrival(condition, rule):
    scenario = ScenarioConfig(collision_rule=rule)
    trial = play(both(PROGRAMS["projected-order"]), condition, scenario=scenario)
    # The condition's name says who is projected to lead; on a tie the right one yields.
    leader = "right" if CONDITIONS[condition].projected_headway_m < 0 else "left"
    assert (trial.status, trial.merged_first) == ("finished", leader)
    first = [row for row in trial.states if row.side == leader]
    second = [row for row in trial.states if row.side != leader]
    assert {row.acceleration_mps2 for row in first} == {0.0}
    assert -1.5 - 1e-9 <= min(row.acceleration_mps2 for row in second) < 0
    # Net of the vehicle length, at the moment when the first car is at the merge point, which
    # lies within a step, during which the cars drive at nearly constant speed.
    step = next(k for k, row in enumerate(first) if row.position_m >= 100)
    (first_m, first_on_m), (second_m, second_on_m) = (
        [row.position_m for row in rows[step - 1 : step + 1]] for rows in (first, second)
    )
    share = (100 - first_m) / (first_on_m - first_m)
    behind_m = second_m + share * (second_on_m - second_m)
    assert 100 - behind_m - 4.5 == pytest.approx(3.85, abs=0.01)


@pytest.mark.parametrize("driver", ["constant", "projected-order"])
def test_a_program_holds_one_action_over_a_whole_plan_and_constant_none(driver):
    trial = play(both(PROGRAMS[driver]), "L_4_-8", scenario=ScenarioConfig())
    for decision in (row.decision for row in trial.decisions):
        action = decision.plan[0]
        assert (decision.plan, decision.applied) == ((action,) * 20, (action,) * 5)
        assert action == 0 if driver == "constant" else abs(action) <= 1
        assert (decision.valid, decision.prompt) == (True, None)


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (lambda: Program(partial(CONSTANT), "x"), "is no class"),
        (lambda: Program(CONSTANT, "x", rate_hz=0), "needs a rate_hz above 0"),
        (lambda: Program(CONSTANT, "x", rate_hz=float("inf")), "needs a rate_hz above 0"),
        (lambda: Program(CONSTANT, "x", {"g": float("nan")}), "must be finite numbers"),
        (lambda: Program(CONSTANT, "x", {"g": {1}}), "must be finite numbers"),
        (lambda: PROGRAMS.register("a+b", PROGRAMS["constant"]), "needs a name of letters"),
    ],
)
def test_what_can_be_no_driver_is_refused(made, said):
    with pytest.raises(UsageError, match=said):
        made()


@pytest.mark.parametrize("first", ["idm", "base"])
def test_programs_are_listed_in_one_order_whichever_is_imported_first(first):
    listed = "from merge_runner.drivers.registry import PROGRAMS; print(*PROGRAMS)"
    listed = f"import merge_runner.drivers.{first}; {listed}"
    found = subprocess.check_output([sys.executable, "-c", listed], text=True)
    assert found == "cei constant human-odds human-replay idm projected-order quantal\n"
