"""An effect on the driver that is treated: both drivers of a trial follow it, on either side."""

import math
from dataclasses import replace

import pytest

from merge_runner.emulator.driver import answer
from merge_runner.planted_effect import PlantedEffect
from merge_runner.records import SIDES, Slot, other_side
from tests.support.emulator_fixtures import first_prompt

TRIALS = 1500


def says_first(slot, effect):
    return answer(first_prompt(side=slot.side), slot, effect).startswith("M")


@pytest.mark.parametrize("condition", ["N_0_0", "of-a-study"])
@pytest.mark.parametrize("treated", SIDES)
def test_the_planted_log_odds_are_those_of_the_treated_driver(condition, treated):
    """Where the chance is one half otherwise; a pair in which both say M misjudges."""
    own, other = (PlantedEffect(x_left_first=0.0, **{name: 1.5}) for name in (
        "x_own_first", "x_other_first"))  # fmt: skip
    first = decided = 0
    for repetition in range(1, TRIALS + 1):
        slot = Slot(condition, repetition, treated, 0, 0)
        one = says_first(slot, own)
        two = says_first(replace(slot, side=other_side(treated)), other)
        decided += one != two
        first += one and not two
        assert one or two, "they agree on who goes first"
    share = 1 / (1 + math.exp(-1.5))
    assert decided > 0.9 * TRIALS
    error = math.sqrt(share * (1 - share) / decided)
    assert first / decided == pytest.approx(share, abs=4 * error)


def test_an_effect_of_before_draws_its_trials_as_it_did():
    assert PlantedEffect(x_gap_m=1.0).before("").model_dump_json() == (
        '{"x_left_first":-0.3,"x_headway":1.11,"x_relative_speed":-3.3,"x_temperature":0.0,'
        '"x_noise":0.0,"x_gap_m":1.0,"x_persona":null,"temperature":1.0}'
    )
