"""What the factors of a study cross to, and what of it is refused before anything is asked."""

import json

import pytest

from merge_runner.config import PERFECT
from merge_runner.errors import UsageError
from merge_runner.run.plan import make_plan
from merge_runner.run.spec import spec_text

HEAD = 'description = "x"\nrepetitions = 2\nconditions = ["N_0_0"]\n'


def arms(plan):
    return {arm.label for arm in plan.arms}


def bodies(plan):
    texts = [spec_text(plan, arm, "N_0_0") for arm in plan.arms]
    return {json.loads(text)["left"]["body"].get("temperature") for text in texts}


def test_models_factors_and_prompts_are_crossed_and_named_by_what_varies(plan_of):
    plan = plan_of(
        'models = ["emulator", "local"]\n'
        '[factors]\nprompt = ["baseline", "A2"]\ntemperature = [0.2, 1.0]\nseed = [7]\n'
    )
    assert len(plan.arms) == 2 * 2 * 2
    assert "emulator temperature=0.2 A2" in arms(plan)
    specs = plan.trial_specs()
    assert plan.trials == len(specs) == len({spec.trial_id for spec in specs}) == 16
    named = {spec.trial_id: dict(spec.factors) for spec in specs}
    assert named["emulator/A2/N_0_0/rep01/seed=7/temperature=0.2"] == {
        "prompt": "A2",
        "temperature": "0.2",
        "seed": "7",
    }
    assert bodies(plan) == {0.2, 1.0}
    assert len({spec.spec_hash for spec in specs}) == len(plan.arms)
    assert set(plan.registered.values()) == {"emulator", "local"}


def test_more_trials_than_can_be_played_are_refused_before_they_are_built(plan_of):
    many = f"[factors]\nseed = {[*range(1_100)]}\nmax_output_tokens = {[*range(1, 1_001)]}\n"
    with pytest.raises(UsageError) as refused:
        plan_of(many)
    assert str(refused.value) == (
        "these are 1,100,000 combinations of levels, and at most 1,000,000 trials can be played: "
        "leave out levels, conditions or repetitions, in the file or by --only, --conditions or "
        "--reps"
    )
    part = {"seed": ["7", "8"], "max_output_tokens": ["300"]}
    assert plan_of(many, only=part).trials == 4
    with pytest.raises(UsageError, match="these are more than 1,000,000 trials"):
        make_plan("baseline", repetitions=100_000)


def test_only_what_is_played_counts_as_a_trial(plan_of):
    """What skip leaves out does not, and what is mirrored does."""
    seeds = f"[factors]\nseed = {[*range(12)]}\n"
    skip = f"skip = [{{ seed = {[*range(6)]} }}]\n"
    pair = ["constant+emulator"]
    assert plan_of(skip + seeds, pair, repetitions=100_000).trials == 600_000
    with pytest.raises(UsageError, match="these are more than 1,000,000 trials"):
        plan_of(skip + seeds, pair, repetitions=100_000, mirror=True)


def test_what_is_the_default_already_is_not_sent(plan_of):
    plan = plan_of("[factors]\ntemperature = [1.0]\n", ["o3"])
    assert plan.entries == make_plan("baseline", "o3").entries


@pytest.mark.parametrize(
    ("model", "factor", "sent"),
    [
        ("o3", 'reasoning_effort = ["default", "low"]', ["medium", "low"]),
        ("gpt-6-sol", 'reasoning_effort = ["low"]', [{"effort": "low"}]),
        ("gemini-2.5-pro", "thinking_budget = [128]", [{"thinkingBudget": 128}]),
        # It has no parameter of this name.
        (
            "gemini-2.5-pro",
            'reasoning_effort = ["low", "high"]',
            [{"thinkingBudget": 1024}, {"thinkingBudget": 24576}],
        ),
        # What is no table gives way to one.
        ("mine", 'reasoning_effort = ["low"]', [{"effort": "low"}]),
    ],
)
def test_common_names_stand_where_the_format_wants_them(plan_of, tmp_path, model, factor, sent):
    entry = 'provider = "local"\nformat = "openai-responses"\nid = "m"\nmax_output_tokens = 9\n'
    mine = f'[mine]\n{entry}parameters = {{ reasoning = "low" }}\n'
    (tmp_path / "models.toml").write_text(mine)
    entries = plan_of(f"[factors]\n{factor}\n", [model]).entries.values()
    named = ("reasoning_effort", "reasoning", "thinkingConfig")
    assert [entry.parameters[each] for entry in entries for each in named
            if each in entry.parameters] == sent  # fmt: skip


def test_an_opponent_drives_on_the_right_and_keeps_its_own_parameters(plan_of):
    plan = plan_of('[factors]\ntemperature = [0.2]\nopponent = ["self", "constant", "local"]\n')
    sides = [(arm.full_names["left"], arm.full_names["right"]) for arm in plan.arms]
    assert sides == [
        ("emulator temperature=0.2", "emulator temperature=0.2"),
        ("emulator temperature=0.2", "constant"),
        ("emulator temperature=0.2", "local"),
    ]
    assert {spec.model_right for spec in plan.trial_specs()} == {"emulator", "constant", "local"}


def test_only_plays_a_part(plan_of):
    text = 'models = ["emulator", "local"]\n[factors]\ntemperature = [0.2, 1.0]\n'
    plan = plan_of(text, only={"temperature": ["0.2"], "model": ["local"]})
    assert arms(plan) == {"local temperature=0.2"}
    whole = {spec.trial_id: spec.spec_hash for spec in plan_of(text).trial_specs()}
    assert {s.trial_id: s.spec_hash for s in plan.trial_specs()}.items() <= whole.items()


def test_what_is_left_out_may_be_of_a_model_or_a_prompt_that_is_not_asked_for_today(plan_of):
    text = (
        'models = ["emulator", "local"]\nskip = [{ model = "emulator", prompt = "A2" }]\n'
        '[factors]\nprompt = ["baseline", "A2"]\n'
    )
    assert arms(plan_of(text, ["local"])) == {"baseline", "A2"}
    assert arms(plan_of(text, ["emulator"], variants=["baseline"])) == {"baseline"}


def test_levels_that_are_no_names_have_ids_of_their_own(plan_of):
    levels = json.dumps(["é", "ü", "a/b", "x" * 300], ensure_ascii=False)
    plan = plan_of(f"[factors]\nresponse_format = {levels}\n")
    ids = {spec.trial_id for spec in plan.trial_specs()}
    assert len(ids) == 8
    assert all(trial_id.isascii() and len(trial_id) < 120 for trial_id in ids)


FOGGY = "[perception.foggy]\nspeed_sd_mps = 0.3\ndelay_s = 0.4\n"


def test_a_perception_is_a_factor_of_both_sides_or_of_one(plan_of):
    both = plan_of(f'[factors]\nperception = ["perfect", "foggy"]\n{FOGGY}')
    assert [arm.scenario.perception_left.delay_s for arm in both.arms] == [0, 0.4]
    assert [arm.scenario.perception_right.delay_s for arm in both.arms] == [0, 0.4]
    assert {spec.trial_id.rpartition("/")[2] for spec in both.trial_specs()} == {
        "perception=perfect",
        "perception=foggy",
    }
    one = plan_of(f'[factors]\nperception_right = ["foggy"]\n{FOGGY}')
    assert one.arms[0].scenario.perception_left == PERFECT
    assert one.arms[0].scenario.perception_right.speed_sd_mps == 0.3


def test_a_perfect_perception_leaves_a_spec_as_it_is_without(plan_of):
    plan = plan_of(f'[factors]\nperception = ["perfect", "foggy"]\n{FOGGY}')
    assert {spec.spec_hash for spec in plan_of("").trial_specs()} < {
        spec.spec_hash for spec in plan.trial_specs()
    }


@pytest.mark.parametrize("scenario", ["", "[scenario]\nstep_s = 0.05\nplan_step_s = 0.2\n"])
def test_a_delay_has_to_fit_the_step_of_the_world_that_is_played(plan_of, scenario):
    late = '[factors]\nperception = ["late"]\n[perception.late]\ndelay_s = 0.3\n'
    arm = plan_of(scenario + late, "idm").arms[0]
    assert (arm.scenario.step_s, arm.scenario.perception_left.delay_s) == (0.05, 0.3)


def test_the_reference_of_a_factor_is_its_first_level_or_the_one_that_is_named(plan_of):
    text = (
        '{}models = ["emulator", "local"]\n[factors]\nprompt = ["A2", "baseline"]\nseed = [7, 1]\n'
    )
    listed = {"model": ["emulator", "local"], "prompt": ["A2", "baseline"], "seed": ["7", "1"]}
    assert plan_of(text.format("")).model_dump()["levels"] == listed
    plan = plan_of(text.format('reference = { model = "local", seed = 1 }\n'), only={"seed": ["7"]})
    chosen = {"model": ["local", "emulator"], "prompt": ["A2", "baseline"], "seed": ["1", "7"]}
    assert plan.model_dump(mode="json")["levels"] == chosen
    assert next(iter(plan.arms)).model == "local", "power compares with the first arm"
