"""A server that others wrote in another language: aimock, where it is installed."""

import json
import shutil
import subprocess

import pytest

from tests.weekly.foreign.conftest import urls_at

AIMOCK = shutil.which("aimock")
CHAOS = {"dropRate": 0.1, "malformedRate": 0.1, "disconnectRate": 0.1, "rateLimitRate": 0.05}

pytestmark = pytest.mark.skipif(
    AIMOCK is None, reason="aimock is not installed: npm install --global @copilotkit/aimock"
)


@pytest.fixture
def url(tmp_path, plan):
    """An aimock that answers everything with a plan, when it does not drop, bend or refuse it."""
    answers = {"fixtures": [{"match": {}, "response": {"content": plan}}]}
    (tmp_path / "answers.json").write_text(json.dumps(answers))
    config = {"llm": {"fixtures": str(tmp_path / "answers.json"), "chaos": CHAOS}}
    (tmp_path / "aimock.json").write_text(json.dumps(config))
    with subprocess.Popen(
        [AIMOCK, "--config", tmp_path / "aimock.json", "--port", "0"],
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        yield process.stdout.readline().split()[-1]
        process.terminate()


async def test_a_sweep_in_each_format_passes_the_chaos_of_a_foreign_server(url, sweeps):
    runs = await sweeps(urls_at(url))
    outcomes = set().union(*(run.summary["attempts"] for run in runs.values()))
    assert outcomes > {"ok"}
    assert outcomes <= {"ok", "server_error", "bad_body", "connection_lost", "rate_limited"}
