"""The scenario's numbers: what follows from them, and what is refused."""

import hashlib

import pytest
from pydantic import ValidationError

from merge_runner.config import ScenarioConfig
from merge_runner.errors import UsageError
from merge_runner.records import canonical_json
from merge_runner.study.file import read_study


def test_the_default_plan_has_20_actions_of_which_5_are_executed():
    scenario = ScenarioConfig()
    assert (scenario.plan_actions, scenario.executed_actions) == (20, 5)
    assert (scenario.memory_samples, scenario.timeout_steps) == (10, 150)


def test_the_counts_follow_from_the_times():
    scenario = ScenarioConfig(horizon_s=3, step_s=0.1, prompt_rate_hz=2, memory_s=1.5, timeout_s=12)
    assert (scenario.plan_actions, scenario.executed_actions) == (30, 5)
    assert (scenario.memory_samples, scenario.timeout_steps) == (15, 120)


def test_a_plan_may_have_steps_of_its_own():
    scenario = ScenarioConfig(step_s=0.05, plan_step_s=0.2)
    assert (scenario.plan_actions, scenario.executed_actions, scenario.action_steps) == (20, 5, 4)
    assert (scenario.memory_samples, scenario.timeout_steps) == (40, 600)
    with pytest.raises(ValidationError, match=r"plan_step_s = 0\.3 s is no whole number"):
        ScenarioConfig(plan_step_s=0.3)


def test_a_knob_that_is_not_turned_stands_in_no_spec():
    assert "plan_step_s" not in ScenarioConfig().model_dump()
    assert ScenarioConfig(plan_step_s=1.0).model_dump()["plan_step_s"] == 1.0


@pytest.mark.parametrize(
    ("field", "seconds"),
    [
        ("horizon_s", 4.1),
        ("memory_s", 2.1),
        ("memory_s", 0.05),
        ("timeout_s", 30.1),
        ("step_s", 0.3),
        ("prompt_rate_hz", 3),
        ("prompt_rate_hz", 10),
    ],
)
def test_a_time_that_is_no_whole_number_of_steps_is_refused(field, seconds):
    with pytest.raises(ValidationError, match="no whole number"):
        ScenarioConfig(**{field: seconds})


def test_a_time_is_whole_also_where_binary_fractions_are_not():
    """0.6 / 0.2 is 2.9999999999999996 in binary."""
    assert ScenarioConfig(memory_s=0.6).memory_samples == 3


def test_a_plan_must_last_until_the_next_prompt():
    assert ScenarioConfig(horizon_s=1).plan_actions == 5
    with pytest.raises(ValidationError, match="horizon"):
        ScenarioConfig(horizon_s=0.8)


@pytest.mark.parametrize("value", [0, -1, float("nan"), float("inf")])
@pytest.mark.parametrize(
    "field",
    [name for name, info in ScenarioConfig.model_fields.items() if info.annotation is float],
)
def test_every_quantity_is_positive_and_finite(field, value):
    with pytest.raises(ValidationError):
        ScenarioConfig(**{field: value})


@pytest.mark.parametrize(
    "field",
    [
        "collision_rule",
        "control_start",
        "resistance",
        "history_start",
        "fallback",
        "straight_after",
    ],
)
def test_a_switch_takes_only_its_named_settings(field):
    with pytest.raises(ValidationError):
        ScenarioConfig(**{field: "sometimes"})


def test_an_unknown_key_is_refused():
    with pytest.raises(ValidationError, match="horizon"):
        ScenarioConfig(horizon=4)


def test_an_unknown_key_in_a_sweep_file_is_named_with_the_valid_ones(tmp_path):
    file = tmp_path / "mine.toml"
    file.write_text("[repetitions]\nbaseline = 1\n[scenario]\nhorizon = 4\n")
    with pytest.raises(UsageError) as caught:
        read_study(str(file))
    assert "'scenario.horizon'" in str(caught.value)
    assert all(field in str(caught.value) for field in ScenarioConfig.model_fields)


def test_a_scenario_does_not_change():
    with pytest.raises(ValidationError):
        ScenarioConfig().step_s = 0.1


def test_the_usual_scenario_is_written_as_ever_so_that_spec_hashes_stay():
    written = canonical_json({"scenario": ScenarioConfig().model_dump()})
    assert hashlib.sha256(written.encode()).hexdigest() == (
        "865c7980b733b5123b1dde61f3709f6d50229d6687c9c6b203edd89306972d30"
    )
