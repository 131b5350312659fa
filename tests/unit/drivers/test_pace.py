"""When drivers decide, and what a world must be for that."""

from __future__ import annotations

import pytest

from merge_runner.config import ScenarioConfig
from merge_runner.drivers.pace import Pace, model_pace, pace_of, program_pace
from merge_runner.errors import UsageError

FINE = ScenarioConfig(step_s=0.05, plan_step_s=0.2)


def test_a_model_acts_in_the_steps_of_its_plan_and_a_program_in_those_of_the_world():
    assert model_pace(FINE) == pace_of(FINE, {"endpoint": "emulator"}) == Pace(4, 5, 20)
    assert (
        program_pace(FINE, 20) == pace_of(FINE, {"program": "p", "rate_hz": 20}) == Pace(1, 1, 80)
    )
    assert [pace.interval_steps for pace in (model_pace(FINE), program_pace(FINE, 5))] == [20, 4]


def test_a_program_without_a_rate_decides_with_the_prompts():
    assert (
        pace_of(ScenarioConfig(), {"program": "constant"})
        == model_pace(ScenarioConfig())
        == Pace(1, 5, 20)
    )
    assert program_pace(ScenarioConfig(prompt_rate_hz=2.5), None).interval_steps == 2


def test_a_program_slower_than_its_horizon_plans_until_it_decides_again():
    assert program_pace(ScenarioConfig(), 0.1) == Pace(1, 50, 50)


@pytest.mark.parametrize("rate_hz", [20, 3, 0, -1, "often", [5], float("nan"), 1e-300])
def test_a_rate_that_does_not_fit_is_refused(rate_hz):
    with pytest.raises(UsageError, match=r"^the driver p cannot decide .* times a second"):
        pace_of(ScenarioConfig(), {"program": "p", "rate_hz": rate_hz})
