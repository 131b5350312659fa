"""Two different drivers of a study sit both ways round, so that driver and side are told apart."""

import pytest

from merge_runner.errors import UsageError

HEAD = 'repetitions = 2\nconditions = ["N_0_0", "L_4_0"]\n'


def seats(plan):
    """Who sits left and right in each arm, and on which side the ego does."""
    return [(arm.sides["left"], arm.sides["right"], arm.ego) for arm in plan.arms]


def trials(plan):
    return {spec.trial_id: spec.spec_hash for spec in plan.trial_specs()}


def test_a_mirrored_study_seats_a_model_and_its_opponent_both_ways(plan_of):
    plan = plan_of('mirror = true\n[factors]\nopponent = ["self", "constant"]\n')
    assert seats(plan) == [
        ("emulator", "emulator", "left"),
        ("emulator", "constant", "left"),
        ("constant", "emulator", "right"),
    ]
    assert plan.trials == len(trials(plan)) == 3 * 2 * 2
    factors = {spec.trial_id: dict(spec.factors) for spec in plan.trial_specs()}
    assert factors["constant+emulator/baseline/L_4_0/rep02"] == {"opponent": "constant"}


def test_to_mirror_changes_no_trial_that_was_played_without(plan_of):
    text = '[factors]\nopponent = ["self", "constant"]\ntemperature = [0.2]\n'
    one_way, both_ways = plan_of(text), plan_of(f"mirror = true\n{text}")
    assert trials(one_way).items() < trials(both_ways).items()
    assert [arm.label for arm in one_way.arms] == [arm.label for arm in both_ways.arms[:2]]
    turned = both_ways.arms[2]
    assert turned.full_names == {"left": "constant", "right": "emulator temperature=0.2"}


def test_a_pair_of_the_command_line_is_mirrored_too(plan_of):
    plan = plan_of("", "emulator+constant", mirror=True)
    assert seats(plan) == [("emulator", "constant", "left"), ("constant", "emulator", "right")]
    assert [arm["label"] for arm in plan.model_dump(mode="json")["arms"]] == [
        "baseline",
        "baseline mirrored",
    ]


def test_a_pair_that_is_named_both_ways_is_played_once(plan_of):
    pairs = 'mirror = true\nmodels = ["constant+projected-order", "projected-order+constant"]\n'
    everybody = (
        'mirror = true\nmodels = ["constant", "projected-order"]\n'
        '[factors]\nopponent = ["constant", "projected-order"]\n'
    )
    assert len(trials(plan_of(pairs))) == 2 * 2 * 2
    assert len(trials(plan_of(everybody))) == 4 * 2 * 2


def test_to_mirror_without_two_drivers_is_refused_with_what_to_type(plan_of):
    with pytest.raises(UsageError, match=r"--model emulator\+OTHER"):
        plan_of("", mirror=True)
    assert plan_of("mirror = true\n").trials == 4, "a study says it once, whatever of it is played"
