"""Prompts of known observations, and the golden files that hold them."""

import os

from merge_runner.config import ScenarioConfig
from merge_runner.prompts.blocks import prompt_of, render_prompt
from merge_runner.records import Observation
from tests.support.cases import table
from tests.support.harness import PROJECT

GOLDEN = PROJECT / "tests/golden"
SEEN = {
    name: Observation(**{"distance_to_merge_m": None} | case)
    for name, case in table("observations", "observations").items()
}
FIRST = SEEN["first"]


def shown(observation, rest=None, variant="baseline", **scenario):
    scenario = ScenarioConfig(**scenario)
    return render_prompt(observation, rest, prompt=prompt_of(variant), scenario=scenario)


def check(file, text):
    """That a golden file holds the text."""
    if os.environ.get("UPDATE_GOLDEN_PROMPTS") == "1":
        (GOLDEN / file).write_bytes(text.encode())
    assert text == (GOLDEN / file).read_bytes().decode()
