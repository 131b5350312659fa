"""A sweep with any one transient fault ends like one without."""

import pytest

from merge_runner.results.store import results_digest
from tests.support.harness import a_model, watched
from tests.support.mock_server import TRANSIENT, FaultPlan

# What a fault is to the client, if not what it is called.
OTHERS = {"rate_limit": "rate_limited", "bad_gateway": "server_error", "hang": "timeout"}
OTHERS |= dict.fromkeys(("reset", "truncated_body"), "connection_lost")
OTHERS |= {"truncated_json": "bad_body"}
# Little patience, and a prompt every 4 s of driving, so that no sweep takes long.
MODELS = a_model(timeout_s=0.5, deadline_s=60)
SWEEP = "repetitions = { baseline = 1 }\n[scenario]\nprompt_rate_hz = 0.25\n"
COMMAND = ("sweep", "baseline", "--json", "--conditions", "N_0_0,L_4_8,R_-4_0,L_0_-8")
# Six calls fail, each once, and at most one decision of a trial, so that no waits add up.
SEED, FAULTS = 1282, 6


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
async def test_a_sweep_passes_through_a_transient_fault(
    merge_runner, tmp_path, clean_digest, fault
):
    write_experiments(tmp_path)
    plan = FaultPlan(seed=SEED, rates={fault: 0.2}, delay_s=0.1)
    async with watched(faults=plan) as server:
        run = await merge_runner(*COMMAND, **server.env)
    assert run.code == 0, run.err
    assert run.summary["attempts"][OTHERS.get(fault, fault)] >= FAULTS
    assert run.summary["trials"]["failed"] == 0
    assert results_digest(tmp_path / "results/merge.duckdb") == clean_digest
    assert clean_digest[1] == 4
