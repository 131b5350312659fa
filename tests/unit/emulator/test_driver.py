import math
from dataclasses import replace

import pytest

from merge_runner.chance import draw, draw_between, draw_index
from merge_runner.config import ScenarioConfig
from merge_runner.drivers.language_model import LanguageModel
from merge_runner.emulator.driver import NEEDED, Situation, answer, read_prompt
from merge_runner.prompts.blocks import VARIANTS, Variant, prompt_of, render_prompt
from merge_runner.prompts.parse import parse_reply
from merge_runner.records import SIDES, ChatReply, Slot
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner.scenarios.merge.world import World
from merge_runner.trial import Trial, play_trial
from tests.support.emulator_fixtures import first_prompt
from tests.support.specs import spec_of

SCENARIO = ScenarioConfig()
REPETITIONS = range(1, 11)
SLOT = Slot("L_4_0", 1, "right", 5, 0)


def straight_prompt(variant="baseline", previous=None, **changes):
    seen = World(SCENARIO, CONDITIONS["L_4_0"], TRACK).observe("right")
    seen = replace(seen, road="straight", distance_to_merge_m=None, **changes)
    return render_prompt(seen, previous, prompt=prompt_of(variant), scenario=SCENARIO)


def first_token(condition, repetition, side, sample_set=0):
    slot = Slot(condition, repetition, side, 0, sample_set)
    return answer(first_prompt(condition, side), slot).split("\n")[0]


def first_tokens(condition, repetition, sample_set=0):
    return tuple(first_token(condition, repetition, side, sample_set) for side in SIDES)


def first_action(prompt, slot=None):
    return parse_reply(answer(prompt, slot), SCENARIO.plan_actions).plan[0]


def play(condition, repetition):
    """A trial in this process, the scripted driver on either side."""

    def decide(question):
        text = answer(question.prompt, question.slot)
        return question.decision(question.prompt, ChatReply(text, "ok", None, (), 0))

    spec = spec_of(condition, repetition=repetition, variant="baseline")
    model = LanguageModel("emulator", {"baseline": prompt_of("baseline")})
    drivers = {side: model.make(SCENARIO, spec, side) for side in SIDES}
    return play_trial(Trial(spec, SCENARIO, drivers), decide)


@pytest.fixture(scope="module")
def trials():
    """The baseline's 110 trials, by condition and repetition."""
    pairs = [(condition, n) for n in REPETITIONS for condition in CONDITIONS]
    return {pair: play(*pair) for pair in pairs}


def test_draws_are_the_same_on_every_machine_and_keep_their_arguments_apart():
    # Committed recordings hold answers that were drawn like this.
    assert draw("who first", "N_0_0", 1, 0) == 0.05226905135811813
    assert draw_index(3, "words", 7) == 1
    assert draw_between(-2, 2, "gap") == -0.6744470744659119
    assert draw("a", "bc") != draw("ab", "c")
    assert draw("a", 1) == draw("a", "1")


def test_draws_fill_their_range_and_stay_in_it():
    uniform = [draw("uniform", n) for n in range(1000)]
    assert 0 <= min(uniform) < 0.01
    assert 0.99 < max(uniform) < 1
    assert {draw_index(3, n) for n in range(100)} == {0, 1, 2}
    between = [draw_between(-3, 5, n) for n in range(1000)]
    assert -3 <= min(between) < -2.9
    assert 4.9 < max(between) < 5


def test_each_part_of_a_slot_changes_some_plan():
    def actions(**changes):
        slots = [replace(Slot(condition, 1, "left", 0, 0), **changes) for condition in CONDITIONS]
        return [first_action(first_prompt(s.condition, "left"), s) for s in slots]

    assert actions() == actions()
    for change in ({"repetition": 2}, {"sample_set": 1}, {"decision": 1}, {"side": "right"}):
        assert actions() != actions(**change)


def test_both_sides_agree_on_who_goes_first_unless_the_trial_is_contested():
    tokens = {
        (condition, repetition): first_tokens(condition, repetition)
        for condition in CONDITIONS
        for repetition in range(1, 31)
    }
    assert set(tokens.values()) == {("M", "Y"), ("Y", "M"), ("M", "M")}
    contested = sorted(repetition for (_, repetition), pair in tokens.items() if pair == ("M", "M"))
    # One condition in every third repetition.
    assert len(contested) == 10
    assert contested == list(range(contested[0], 31, 3))


@pytest.mark.parametrize("condition", CONDITIONS)
def test_the_share_of_left_first_follows_the_human_odds(condition):
    h = CONDITIONS[condition].projected_headway_m
    dv = CONDITIONS[condition].relative_velocity_mps
    expected = 1 / (1 + math.exp(-(-0.30 + 1.11 * h - 3.30 * dv)))
    pairs = [first_tokens(condition, repetition) for repetition in range(1, 201)]
    agreed = [pair for pair in pairs if pair != ("M", "M")]
    share = agreed.count(("M", "Y")) / len(agreed)
    standard_error = math.sqrt(expected * (1 - expected) / len(agreed))
    assert abs(share - expected) < 3 * standard_error


def test_who_goes_first_is_drawn_anew_for_each_trial():
    def left_first(condition, sample_set=0):
        return {n for n in range(1, 101) if first_tokens(condition, n, sample_set) == ("M", "Y")}

    # Left goes first more rarely in N_0_0; were the draws shared, never in it alone.
    assert left_first("N_0_0") - left_first("L_4_8")
    assert left_first("N_0_0", 0) != left_first("N_0_0", 1)


def test_one_to_six_of_110_trials_collide_where_both_take_the_right_of_way(trials):
    collided = {key for key, trial in trials.items() if trial.status == "collided"}
    assert 1 <= len(collided) <= 6
    assert collided == {key for key in trials if first_tokens(*key) == ("M", "M")}
    assert {trial.status for trial in trials.values()} == {"finished", "collided"}
    decisions = [row.decision for trial in trials.values() for row in trial.decisions]
    assert {decision.failure for decision in decisions} == {None}


def test_whoever_does_not_collide_goes_as_drawn_drives_gently_and_leaves_a_gap(trials):
    for key, trial in trials.items():
        if trial.status == "finished":
            assert trial.merged_first == ("left" if first_tokens(*key)[0] == "M" else "right")
            # The hardest that the driver means to do, and the wobble of its hand.
            assert min(row.acceleration_mps2 for row in trial.states) >= -2.2 - 0.1
            assert max(row.acceleration_mps2 for row in trial.states) <= 1.4 + 0.1
            left = [row.position_m for row in trial.states if row.side == "left"]
            right = [row.position_m for row in trial.states if row.side == "right"]
            merging = next(pair for pair in zip(left, right, strict=True) if max(pair) >= 100)
            # Between the bumpers of two cars of 4.5 m.
            assert 1 < abs(merging[0] - merging[1]) - 4.5 < 8


def test_ten_repetitions_of_a_condition_differ_and_another_sample_set_does(trials):
    for condition in CONDITIONS:
        ten = [trials[condition, n] for n in REPETITIONS]
        assert (
            len({tuple(row.decision.reply.text for row in trial.decisions) for trial in ten}) == 10
        )
        # Plans have two decimals, so two of ten may happen to drive the same.
        assert len({trial.states for trial in ten}) >= 8
        slots = [Slot(condition, 1, "left", 0, sample_set) for sample_set in range(6)]
        assert len({answer(first_prompt(condition, "left"), slot) for slot in slots}) >= 5


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_prompt_of_any_variant_gets_a_valid_plan_and_the_token_that_it_asks_for(variant):
    merging = [
        (first_prompt(condition, side, variant), Slot(condition, 1, side, 0, 0), variant == "A7")
        for condition in CONDITIONS
        for side in SIDES
    ]
    straight = [
        (straight_prompt(variant, [0.1] * 15, relative_distance_m=metres), SLOT, True)
        for metres in (-10.0, 5.0, 10.0)
    ]
    for prompt, slot, without_token in merging + straight:
        for asked in (None, slot):
            parsed = parse_reply(answer(prompt, asked), SCENARIO.plan_actions)
            assert (parsed.failure, len(parsed.plan)) == (None, SCENARIO.plan_actions)
            assert parsed.rationale
            assert (parsed.tactical is None) == without_token


def test_the_plan_has_as_many_actions_as_the_prompt_asks_for():
    prompt = first_prompt("N_0_0", "left")
    shorter = prompt.replace("exactly 20 numbers", "exactly 8 numbers")
    assert shorter != prompt
    assert len(parse_reply(answer(shorter, None), 8).plan) == 8


def test_who_goes_first_does_not_brake_and_who_yields_does_not_accelerate():
    for condition in CONDITIONS:
        for repetition in REPETITIONS:
            for side in SIDES:
                slot = Slot(condition, repetition, side, 0, 0)
                action = first_action(first_prompt(condition, side), slot)
                # Within the wobble of the hand, 0.05 of 2.5 m/s^2.
                if first_token(condition, repetition, side) == "M":
                    assert action >= -0.02
                else:
                    assert action <= 0.02


def test_a_table_is_read_as_the_list_is(own_parts):
    tabled = Variant(removes=frozenset({"C0"}), adds=frozenset({"state.table"}))
    VARIANTS.register("tabled", tabled)
    for condition in CONDITIONS:
        listed, table = (first_prompt(condition, "left", name) for name in ("baseline", "tabled"))
        assert read_prompt(table) == read_prompt(listed)
        assert isinstance(read_prompt(table), Situation)
    assert read_prompt(straight_prompt("tabled")) == read_prompt(straight_prompt())


def test_a_car_that_is_not_seen_is_no_reason_to_act():
    for condition in CONDITIONS:
        seen = World(SCENARIO, CONDITIONS[condition], TRACK).observe("left")
        unseen = replace(seen, other_seen=False, other_speeds_mps=())
        prompt = render_prompt(unseen, None, prompt=prompt_of("baseline"), scenario=SCENARIO)
        assert abs(first_action(prompt, Slot(condition, 1, "left", 0, 0))) == 0
        assert "I do not see the other car" in answer(prompt, None)


def test_a_follower_brakes_for_a_slower_car_close_ahead_and_for_none_behind():
    ahead = straight_prompt(relative_distance_m=7.0, own_speed_mps=10.0, other_speed_mps=7.0)
    behind = straight_prompt(relative_distance_m=-7.0, own_speed_mps=10.0, other_speed_mps=7.0)
    assert first_action(ahead) < 0
    assert first_action(behind) == 0


def test_without_a_slot_an_answer_depends_on_the_prompt_alone():
    left, right = first_prompt("L_4_0", "left"), first_prompt("L_4_0", "right")
    assert answer(left, None) == answer(left, None)
    # The projected leader goes first.
    assert answer(left, None).startswith("M\n")
    assert answer(right, None).startswith("Y\n")


@pytest.mark.parametrize("slot", [None, Slot("N_0_0", 1, "left", 0, 0)])
@pytest.mark.parametrize("prompt", ["", "What is the capital of France?", "Your speed: x m/s"])
def test_a_prompt_about_something_else_gets_what_it_lacks_and_who_answers_it(prompt, slot):
    text = answer(prompt, slot)
    assert all(f"`{words}`" in text for words in NEEDED)
    assert text.endswith("The model `random` answers any prompt.")
    assert parse_reply(text, SCENARIO.plan_actions).plan is None


@pytest.mark.parametrize("words", NEEDED)
def test_a_prompt_without_a_number_that_the_driver_needs_is_told_which(words):
    prompt = "\n".join(each.replace("N", "7") for each in NEEDED if each != words)
    assert f"does not say `{words}`, with" in answer(prompt, None)
    whole = answer("\n".join(each.replace("N", "7") for each in NEEDED), None)
    assert len(parse_reply(whole, 7).plan) == 7
