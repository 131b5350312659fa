"""A model that understands nothing and answers in a valid form: it rehearses any prompt."""

from dataclasses import replace

import pytest

from merge_runner.config import ScenarioConfig
from merge_runner.emulator.driver import random_answer as answer
from merge_runner.prompts.blocks import VARIANTS
from merge_runner.prompts.parse import parse_reply
from merge_runner.records import SIDES, Slot
from merge_runner.scenarios.merge.conditions import CONDITIONS
from tests.support.emulator_fixtures import first_prompt

SCENARIO = ScenarioConfig()
SLOT = Slot("N_0_0", 1, "left", 0, 0)
PROMPTS = [first_prompt("L_4_8", variant=variant) for variant in VARIANTS]


@pytest.mark.parametrize(
    ("prompt", "actions"),
    [
        *((prompt, SCENARIO.plan_actions) for prompt in PROMPTS),
        ("Sie fahren 10.5 m/s und 120.0 m vor ihnen liegt ein Stau. Nennen Sie 45 Zahlen.", 45),
        ("Give me fifteen numbers between -1 and 1.", 15),
        ("", 20),
    ],
)
def test_any_prompt_gets_a_word_and_a_plan_of_the_length_that_it_asks_for(prompt, actions):
    for slot in (None, SLOT):
        parsed = parse_reply(answer(prompt, slot), actions)
        assert parsed.failure is None
        assert parsed.tactical in ("M", "Y")
        assert len(parsed.plan) == actions
        assert -1 <= min(parsed.plan) == max(parsed.plan) <= 1


def test_the_draw_is_a_function_of_the_prompt_and_of_each_part_of_the_slot():
    changes = {"condition": "L_4_0", "repetition": 2, "side": "right", "decision": 1}
    changes["sample_set"] = 1
    slots = [None, *(replace(SLOT, **{name: value}) for name, value in changes.items())]
    others = {answer("a", slot) for slot in slots} | {answer("b", SLOT)}
    assert answer("a", SLOT) == answer("a", SLOT) not in others


def test_both_words_and_the_whole_range_of_actions_are_drawn_alike():
    drawn = [
        parse_reply(answer("20 numbers", Slot(name, number, side, 0, 0)), 20)
        for name in CONDITIONS
        for number in range(20)
        for side in SIDES
    ]
    words = [parsed.tactical for parsed in drawn]
    actions = sorted(parsed.plan[0] for parsed in drawn)
    assert 0.4 < words.count("M") / len(words) < 0.6
    assert actions[0] < -0.98
    assert actions[-1] > 0.98
    assert abs(actions[len(actions) // 2]) < 0.15
