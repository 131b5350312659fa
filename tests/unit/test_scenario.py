"""The scenario's numbers: what follows from them, and what is refused."""

import hashlib

import pytest
from pydantic import ValidationError

from merge_runner.config import ScenarioConfig
from merge_runner.records import canonical_json


@pytest.mark.parametrize(
    ("changes", "counts"),
    [
        ({}, (20, 5, 1, 10, 150)),
        (
            {"horizon_s": 3, "step_s": 0.1, "prompt_rate_hz": 2, "memory_s": 1.5, "timeout_s": 12},
            (30, 5, 1, 15, 120),
        ),
        ({"step_s": 0.05, "plan_step_s": 0.2}, (20, 5, 4, 40, 600)),
        ({"horizon_s": 1}, (5, 5, 1, 10, 150)),  # a plan must last until the next prompt
        ({"memory_s": 0.6}, (20, 5, 1, 3, 150)),  # 0.6 / 0.2 is 2.9999999999999996 in binary
    ],
)
def test_the_counts_follow_from_the_times(changes, counts):
    task = ScenarioConfig(**changes)
    plan = (task.plan_actions, task.executed_actions, task.action_steps)
    assert (*plan, task.memory_samples, task.timeout_steps) == counts


def test_a_knob_that_is_not_turned_stands_in_no_spec():
    assert "plan_step_s" not in ScenarioConfig().model_dump()
    assert ScenarioConfig(plan_step_s=1.0).model_dump()["plan_step_s"] == 1.0


@pytest.mark.parametrize("value", [0, -1, float("nan"), float("inf")])
@pytest.mark.parametrize(
    "field",
    [name for name, info in ScenarioConfig.model_fields.items() if info.annotation is float],
)
def test_every_quantity_is_positive_and_finite(field, value):
    with pytest.raises(ValidationError):
        ScenarioConfig(**{field: value})


def test_the_usual_scenario_is_written_as_ever_so_that_spec_hashes_stay():
    written = canonical_json({"scenario": ScenarioConfig().model_dump()})
    assert hashlib.sha256(written.encode()).hexdigest() == (
        "865c7980b733b5123b1dde61f3709f6d50229d6687c9c6b203edd89306972d30"
    )
