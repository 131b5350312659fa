"""What is said of trials in which a scripted stand-in answered."""

import pytest

from merge_runner.config import both_sides
from merge_runner_analysis.data.driver_words import stand_in

BOTH = ("left", "right")


@pytest.mark.parametrize(
    ("model", "sides", "words"),
    [
        ("o3", BOTH, "scripted stand-in, not o3"),
        ("o3", ("left",), "scripted stand-in on the left, not o3"),
        ("emulator", BOTH, "scripted stand-in, no language model"),
        ("random", BOTH, "scripted stand-in, no language model"),
        ("emulator+constant", ("left",), "scripted stand-in, no language model"),
        ("emulator+o3", ("left",), "scripted stand-in on the left, no language model"),
        ("emulator+o3", BOTH, "scripted stand-in, not o3"),
        ("constant+o3", ("right",), "scripted stand-in, not o3"),
        ("o3+gemini-2.5-pro", ("right",), "scripted stand-in on the right, not gemini-2.5-pro"),
        ("o3+gemini-2.5-pro", BOTH, "scripted stand-in, not o3+gemini-2.5-pro"),
    ],
)
def test_a_stand_in_stands_for_the_models_on_whose_sides_it_answered(model, sides, words):
    models = {side: name for side, name in both_sides(model).items() if name != "constant"}
    assert stand_in(models, sides) == words
