"""An effect that a study plants in the emulator is what its analysis finds in the long run."""

from itertools import product

import numpy as np
import pandas as pd
import pytest

from merge_runner.emulator.driver import answer
from merge_runner.planted_effect import PARAMETERS, PlantedEffect, planted_fields
from merge_runner.prompts.parse import parse_reply
from merge_runner.providers import PROVIDERS
from merge_runner.records import SIDES, Slot
from merge_runner.scenarios.merge.conditions import CONDITIONS, HUMAN_CONDITIONS
from merge_runner_analysis.stats.regressions import WHO_FIRST_TERMS, who_first_logit
from tests.support.emulator_fixtures import first_prompt

HURRIED = "You are in a hurry."
REPETITIONS = range(1, 201)


def told(condition, repetition, side, effect, added=""):
    slot = Slot(condition, repetition, side, 0, 0)
    return answer(first_prompt(condition, side) + added, slot, effect)


def firsts(effect, added=""):
    """Who goes first by the letters of both, as trials; contested ones did not finish."""
    rows = []
    for name, n in product(HUMAN_CONDITIONS, REPETITIONS):
        c = CONDITIONS[name]
        letters = "".join(told(name, n, side, effect, added)[0] for side in SIDES)
        who = {"MY": "left", "YM": "right"}.get(letters)
        status = "finished" if who else "collided"
        rows.append((name, c.projected_headway_m, c.relative_velocity_mps, status, who))
    columns = ["condition", "projected_headway_m", "relative_velocity_mps"]
    return pd.DataFrame(rows, columns=[*columns, "status", "merged_first"])


@pytest.mark.parametrize(
    ("given", "added", "expected"),
    [
        ({}, "", (-0.30, 1.11, -3.30)),
        ({"x_headway": 0.4, "x_relative_speed": 1.5, "x_left_first": 0.8}, "", (0.8, 0.4, 1.5)),
        ({"x_temperature": 0.7, "temperature": 2.0}, "", (-0.149, 0.551, -1.639)),
        ({"x_persona": {"text": HURRIED, "x_relative_speed": 2.3}}, "", (-0.30, 1.11, -3.30)),
        ({"x_persona": {"text": HURRIED, "x_relative_speed": 2.3}}, HURRIED, (-0.30, 1.11, -1.0)),
    ],
    ids=["human", "all three", "temperature", "not the persona", "persona"],
)
def test_the_logit_of_who_goes_first_has_the_planted_coefficients(given, added, expected):
    fit = who_first_logit(firsts(PlantedEffect(**given), added))
    for term, planted in zip(WHO_FIRST_TERMS, expected, strict=True):
        assert abs(fit.terms[term].b - planted) < 3 * fit.terms[term].se


def test_noise_flattens_the_coefficients_as_a_latent_normal_does():
    fit = who_first_logit(firsts(PlantedEffect(x_noise=3.0)))
    # A logit with normal noise of variance 9 is one of coefficients divided by the root of
    # 1 + 9 (16 sqrt(3) / (15 pi))^2, to about 3 % (Zeger, Liang and Albert 1988).
    flattened = np.array([1.11, -3.30]) / np.sqrt(1 + 9 * (16 * np.sqrt(3) / (15 * np.pi)) ** 2)
    for term, expected in zip(WHO_FIRST_TERMS[1:], flattened, strict=True):
        assert abs(fit.terms[term].b - expected) < 3 * fit.terms[term].se + 0.05 * abs(expected)


def test_without_a_planted_effect_the_script_answers_as_before_whatever_the_temperature():
    assert planted_fields({"temperature": 0.2, "model": "scripted-driver"}) == {}
    # The humans' coefficients said aloud are the same odds, but drawn anew.
    said, unsaid = firsts(PlantedEffect())["merged_first"], firsts(None)["merged_first"]
    assert (said == "left").mean() == pytest.approx((unsaid == "left").mean(), abs=0.03)
    assert list(said) != list(unsaid)


def test_trials_of_two_effects_are_independent():
    one, other = (
        (firsts(PlantedEffect(x_gap_m=gap)).query("condition == 'N_0_0'")["merged_first"] == "left")
        for gap in (0, 0.1)
    )
    assert abs(np.corrcoef(one, other)[0, 1]) < 3 / np.sqrt(len(one))


def test_the_planted_gap_opens_a_wider_gap():
    def hardest(gap_m):
        effect = PlantedEffect(x_gap_m=gap_m)
        answers = (told("N_0_0", *each, effect) for each in product(range(1, 101), SIDES))
        return np.mean([abs(parse_reply(each, 20).plan[0]) for each in answers])

    assert hardest(0) < hardest(2) < hardest(4)


def test_the_registry_lets_every_planted_parameter_through_to_the_emulator_alone():
    takers = {name for name, provider in PROVIDERS.items() if PARAMETERS & provider.parameters}
    assert takers == {"emulator"}
    assert PROVIDERS["emulator"].parameters == PARAMETERS


@pytest.mark.parametrize(
    ("parameters", "said"),
    [
        ("x_headwya = 1.0", "unknown key 'x_headwya'; valid: x_left_first, x_headway"),
        ("x_noise = -1", "x_noise"),
        ("x_temperature = 1000, temperature = 0", "x_temperature"),
    ],
)
async def test_an_effect_that_cannot_be_is_refused_in_words(
    merge_runner, tmp_path, parameters, said
):
    (tmp_path / "experiments").mkdir()
    (tmp_path / "experiments/models.toml").write_text(
        f'[planted]\nprovider = "emulator"\nformat = "openai-chat"\nid = "scripted-driver"\n'
        f'max_output_tokens = 4000\nprice = "free"\nparameters = {{ {parameters} }}\n'
    )
    run = await merge_runner("sweep", "baseline", "--model", "planted", "--reps", 1)
    assert run.code != 0
    assert said in run.err
