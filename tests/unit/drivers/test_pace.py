"""When drivers decide, and what a world must be for that."""

import pytest

from merge_runner.config import ScenarioConfig
from merge_runner.drivers.pace import Pace, model_pace, pace_of, program_pace
from merge_runner.errors import UsageError

FINE = ScenarioConfig(step_s=0.05, plan_step_s=0.2)


@pytest.mark.parametrize(
    ("scenario", "side", "pace"),
    [
        # A model acts in the steps of its plan, and a program in those of the world.
        (FINE, {"endpoint": "emulator"}, Pace(4, 5, 20)),
        (FINE, {"program": "p", "rate_hz": 20}, Pace(1, 1, 80)),
        # Without a rate a program decides with the prompts.
        (ScenarioConfig(), {"program": "p"}, Pace(1, 5, 20)),
        (ScenarioConfig(prompt_rate_hz=2.5), {"program": "p"}, Pace(1, 2, 20)),
        # One slower than its horizon plans until it decides again.
        (ScenarioConfig(), {"program": "p", "rate_hz": 0.1}, Pace(1, 50, 50)),
    ],
)
def test_each_side_has_its_pace(scenario, side, pace):
    assert pace_of(scenario, side) == pace


def test_an_interval_is_one_of_steps_of_the_world():
    assert [pace.interval_steps for pace in (model_pace(FINE), program_pace(FINE, 5))] == [20, 4]


@pytest.mark.parametrize("rate_hz", [20, 3, 0, -1, "often", [5], float("nan"), 1e-300])
def test_a_rate_that_does_not_fit_is_refused(rate_hz):
    with pytest.raises(UsageError, match=r"^the driver p cannot decide .* times a second"):
        pace_of(ScenarioConfig(), {"program": "p", "rate_hz": rate_hz})
