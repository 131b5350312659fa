"""A sweep with any one transient fault ends like one without."""

import pytest

from merge_runner.results.store import results_digest
from tests.support.harness import watched
from tests.support.mock_server import TRANSIENT, FaultPlan

# What each fault is to the client.
OUTCOMES = {
    "rate_limit": "rate_limited",
    "request_timeout": "request_timeout",
    "conflict": "conflict",
    "server_error": "server_error",
    "bad_gateway": "server_error",
    "overloaded": "overloaded",
    "hang": "timeout",
    "reset": "connection_lost",
    "truncated_body": "connection_lost",
    "truncated_json": "bad_body",
}
# Little patience, and a prompt every 4 s of driving, so that no sweep takes long.
MODELS = """
[emulator]
provider = "emulator"
format = "openai-chat"
id = "scripted-driver"
max_output_tokens = 4000
price = "free"
timeout_s = 0.5
deadline_s = 60
"""
SWEEP = "repetitions = { baseline = 1 }\n[scenario]\nprompt_rate_hz = 0.25\n"
COMMAND = ("sweep", "baseline", "--json", "--conditions", "N_0_0,L_4_8,R_-4_0,L_0_-8")
# Six calls fail, each once, and at most one decision of a trial, so that no waits add up.
SEED, FAULTS = 1282, 6


@pytest.fixture
def folder(tmp_path):
    return write_experiments(tmp_path)


@pytest.fixture(scope="module")
def clean_digest(prepare, tmp_path_factory):
    folder = write_experiments(tmp_path_factory.mktemp("clean"))
    assert prepare(folder, *COMMAND).code == 0
    return results_digest(folder / "results/merge.duckdb")


def write_experiments(folder):
    (folder / "experiments").mkdir()
    (folder / "experiments/models.toml").write_text(MODELS)
    (folder / "experiments/baseline.toml").write_text(SWEEP)
    return folder


@pytest.mark.parametrize("fault", TRANSIENT)
async def test_a_sweep_passes_through_a_transient_fault(merge_runner, folder, clean_digest, fault):
    plan = FaultPlan(seed=SEED, rates={fault: 0.2}, delay_s=0.1)
    async with watched(faults=plan) as server:
        run = await merge_runner(*COMMAND, EMULATOR_BASE_URL=f"{server.url}/v1")
    assert run.code == 0, run.err
    assert run.summary["attempts"][OUTCOMES[fault]] >= FAULTS
    assert run.summary["trials"]["failed"] == 0
    assert results_digest(folder / "results/merge.duckdb") == clean_digest
    assert clean_digest[1] == 4
