"""Fixtures for the whole program."""

import asyncio
import os
import signal
from pathlib import Path

import pytest
from hypothesis import settings

from merge_runner.registry import Catalogue, collecting
from merge_runner.results.store import results_digest
from tests.support import program
from tests.support.crossed_study import play
from tests.support.golden import golden, golden_copy
from tests.support.harness import Run, environment
from tests.support.mock_server import FaultPlan, served
from tests.support.program import Process

# No agreement is kept: no test must pass because another one agreed.
os.environ["XDG_STATE_HOME"] = os.devnull

# A script that starts the tests with `&` lets them ignore Ctrl-C, and programs would inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)

# The gate depends on neither luck nor load.
settings.register_profile("gate", derandomize=True, deadline=None)
# For an hour of one's own: `make test ARGS="-n0 ... --hypothesis-profile 100000"`.
settings.register_profile("100000", max_examples=100_000, derandomize=False, deadline=None)
settings.load_profile("gate")


def pytest_collection_modifyitems(items):
    """Begin with the longest, so that no worker is left with it in the end."""
    items.sort(key=lambda item: "test_every_command_of_the_docs" not in item.name)


@pytest.fixture(scope="session")
def shared(tmp_path_factory, worker_id):
    """The folder that all processes of this run of the tests have in common."""
    own = tmp_path_factory.getbasetemp()
    return own if worker_id == "master" else own.parent


@pytest.fixture(scope="session")
def emulator_url():
    """An emulator without faults, for all tests that need no other."""
    with served(FaultPlan()) as url:
        yield f"{url}/v1"


@pytest.fixture
def merge_runner(tmp_path, emulator_url):
    """Runs ``merge-runner`` in an empty folder, beside an emulator; it must end with ``code``.

    With ``EMULATOR_BASE_URL=""`` a sweep has an emulator of its own. ``start`` returns once a
    process of its own has begun, to be signalled.
    """
    one_at_a_time = asyncio.Lock()

    async def run(
        *arguments: object, code: int | None = None, cwd: Path = tmp_path, **changes: str
    ) -> Run:
        async with one_at_a_time:
            env = beside(emulator_url, changes)
            done = await asyncio.to_thread(program.run, arguments, cwd=cwd, env=env)
        return done.ending_with(code)

    async def start(
        *arguments: object, cwd: Path = tmp_path, module: str = "", **changes: str
    ) -> Process:
        env = beside(emulator_url, changes)
        return await program.start(arguments, cwd=cwd, env=env, module=module)

    run.start = start
    return run


@pytest.fixture(scope="session")
def prepare(emulator_url):
    """Runs ``merge-runner`` in a folder, for what is made once for several tests."""

    def run(folder: Path, *arguments: object, code: int | None = None, **changes: str) -> Run:
        done = program.run(arguments, cwd=folder, env=beside(emulator_url, changes))
        return done.ending_with(code)

    return run


@pytest.fixture(scope="session")
def quiet(prepare, tmp_path_factory):
    """The digest of an undisturbed ``sweep baseline --reps 1``."""
    folder = tmp_path_factory.mktemp("quiet")
    assert prepare(folder, "sweep", "baseline", "--reps", 1).code == 0
    return results_digest(folder / "results/merge.duckdb")


@pytest.fixture(scope="session")
def played(prepare, tmp_path_factory):
    """A study with several factors and models; see ``tests.support.crossed_study``."""
    return play(tmp_path_factory.mktemp("mine"), prepare)


@pytest.fixture
def own_parts():
    """What the test registers belongs to a study of its own."""
    with collecting(Catalogue()):
        yield


def beside(emulator_url, changes):
    """The environment of a run beside the emulator."""
    return environment(**{"EMULATOR_BASE_URL": emulator_url, **changes})
