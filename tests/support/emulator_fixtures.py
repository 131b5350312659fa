from functools import cache

import pytest

from merge_runner.config import ScenarioConfig
from merge_runner.prompts.blocks import prompt_of, render_prompt
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner.scenarios.merge.world import World
from tests.support.mock_server import serve


@pytest.fixture
async def emulator():
    """A function that starts an emulator with the given faults and returns its base URL."""
    runners = []

    async def start(faults=None):
        runner, url = await serve(0, faults)
        runners.append(runner)
        return url

    yield start
    for runner in runners:
        await runner.cleanup()


@cache
def first_prompt(condition="N_0_0", side="left", variant="baseline"):
    """What a driver is asked first in a condition."""
    scenario = ScenarioConfig()
    seen = World(scenario, CONDITIONS[condition], TRACK).observe(side)
    return render_prompt(seen, None, prompt=prompt_of(variant), scenario=scenario)


@pytest.fixture
def driving_prompt():
    """What the left driver is asked first in a symmetric trial."""
    return first_prompt()
