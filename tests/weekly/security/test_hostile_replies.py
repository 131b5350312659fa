"""Whatever a model answers, many times: a plan or a named refusal, no code, linear time."""

from __future__ import annotations

import random
from collections import Counter

import pytest

from merge_runner.config import ScenarioConfig
from merge_runner.emulator.driver import answer
from merge_runner.prompts.blocks import prompt_of, render_prompt
from merge_runner.records import Slot
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner.scenarios.merge.world import World
from tests.unit.security.test_hostile_replies import (
    EXECUTED,
    FRAMES,
    HOSTILE,
    MODEL_LIKE,
    REFUSALS,
    UNITS,
    Watch,
    check,
    seconds,
)

REPLIES = 100_000


def emulated():
    """Real replies of the emulator, in every condition, with and without the tactical token."""
    scenario = ScenarioConfig()
    for name, condition in CONDITIONS.items():
        for variant in ("baseline", "A1"):
            seen = World(scenario, condition, TRACK).observe("left")
            prompt = render_prompt(seen, None, prompt=prompt_of(variant), scenario=scenario)
            yield answer(prompt, Slot(name, 1, "left", 0, 0))


def mutated(chance, replies):
    """A reply with up to six things wrong in it."""
    text = chance.choice(replies)
    for _ in range(chance.randrange(1, 7)):
        at, end = sorted(chance.choices(range(len(text) + 1), k=2))
        piece = chance.choice([*HOSTILE, "0.1", "-1", "1.0000001", "+.5", "-0", "00.5"])
        entries = text.split(", ")
        entries[chance.randrange(len(entries))] = piece
        text = chance.choice(
            [
                text[:at] + chance.choice(replies)[at:],
                text[:at] + piece * chance.choice((1, 2, 30)) + text[at:],
                text[:at] + text[at + chance.choice((1, 2, 10, 100)) :],
                text[:end] + text[at:end] * chance.choice((1, 5)) + text[end:],
                text[:at] + "".join(chr(ord(letter) ^ 1) for letter in text[at : at + 3]),
                ", ".join(entries),
                f"[{text}]",
                f"```\n{text}\n```",
            ]
        )[:4_000]
    return text


def test_a_hundred_thousand_mutated_replies_give_plans_or_named_refusals_and_run_nothing():
    chance, watch = random.Random(20260409), Watch()
    replies = [*emulated(), *MODEL_LIKE]
    outcomes = Counter()
    for _ in range(REPLIES // 1000):
        texts = [mutated(chance, replies) for _ in range(1000)]
        with watch() as happened:
            outcomes.update(check(text) for text in texts)
        assert happened == []
    assert EXECUTED == []
    # Every outcome is met often, so that none is tested by name alone.
    assert outcomes.keys() == {"plan", *REFUSALS}
    assert min(outcomes.values()) > REPLIES / 1000, outcomes


@pytest.mark.parametrize("unit", UNITS, ids=repr)
def test_a_megabyte_takes_time_in_proportion_to_its_length(unit):
    """Four times the text takes about 4 times as long in linear and 16 times in quadratic time."""
    for frame in FRAMES:
        quarter = max(0.02, *(seconds(frame, unit, 2**18) for _ in range(3)))
        assert min(seconds(frame, unit, 2**20) for _ in range(3)) < 9 * quarter, frame
