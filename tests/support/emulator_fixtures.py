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


@pytest.fixture(scope="session")
def driving_prompt():
    """What the left driver is asked first in a symmetric trial."""
    scenario = ScenarioConfig()
    seen = World(scenario, CONDITIONS["N_0_0"], TRACK).observe("left")
    return render_prompt(seen, None, prompt=prompt_of("baseline"), scenario=scenario)
