"""A study of one file and one plug-in, from `init` to its tables, with no change in the package."""

from __future__ import annotations

import asyncio
import json

import pytest

from merge_runner import Study
from merge_runner.results.store import results_digest
from tests.support.harness import FAST, watched
from tests.support.mock_server import FaultPlan

DEAR = """
[dear]
provider = "emulator"
format = "openai-chat"
id = "scripted-driver-dear"
max_output_tokens = 4000
price = { input = 10.0, output = 40.0, source = "made up" }
"""
PRICES = {"scripted-driver": (1.0, 4.0), "scripted-driver-dear": (10.0, 40.0)}
FACTORS = {"prompt", "opponent", "temperature"}


class Bill:
    """What a server's own count of tokens comes to in USD, by the prices of the models."""

    def __init__(self) -> None:
        self.usd = 0.0
        self.begun = asyncio.Event()

    async def __call__(self, request, handler):
        self.begun.set()
        response = await handler(request)
        usage = json.loads(response.body)["usage"]
        price_in, price_out = PRICES[(await request.json())["model"]]
        self.usd += usage["prompt_tokens"] * price_in / 1e6
        self.usd += usage["completion_tokens"] * price_out / 1e6
        return response


def with_budget(folder, usd):
    text = (folder / "study.toml").read_text().split("\n[budget]")[0]
    (folder / "study.toml").write_text(f"{text}\n[budget]\ntotal_usd = {usd}\n")


@pytest.mark.long
async def test_a_study_in_one_file_runs_within_its_budget_and_is_shown_by_factor(
    merge_runner, tmp_path, monkeypatch
):
    assert (await merge_runner("init", "mine")).code == 0
    mine = tmp_path / "mine"
    text = (mine / "study.toml").read_text()
    two = text.replace('models = ["emulator"]', 'models = ["emulator-priced", "dear"]')
    (mine / "study.toml").write_text(two)
    (mine / "models.toml").write_text((mine / "models.toml").read_text() + DEAR)
    bill = Bill()
    async with watched(bill, FaultPlan(latency_s=0.05)) as server:
        env = {"EMULATOR_BASE_URL": f"{server.url}/v1"}
        sweep = ("sweep", "study.toml", "--yes", "--json", *FAST)
        with_budget(mine, 1.5)
        process = await merge_runner.start(*sweep, "--in-flight", 2, cwd=mine, **env)
        await bill.begun.wait()
        await asyncio.sleep(0.5)
        process.kill()
        await process.wait()
        short = await merge_runner(*sweep, cwd=mine, **env)
        assert (short.code, bill.usd <= 1.5) == (3, True), short.err
        assert "or the study's budget" in short.err
        with_budget(mine, 20)
        whole = await merge_runner(*sweep, cwd=mine, **env)
        assert (whole.code, whole.summary["trials"]["planned"]) == (0, 48), whole.err
        assert whole.summary["sweep_cost_usd"] == pytest.approx(bill.usd, rel=0.05)
        assert max(server.asked.values()) <= 2  # the calls that the kill cut off
    assert (await merge_runner("recording", "export", "all.parquet", cwd=mine)).code == 0
    replay = ("replay", "study.toml", "--recording", "all.parquet", "--cache", "no", "--db", "r")
    again = await merge_runner(*replay, cwd=mine)
    assert again.code == 0, again.err
    assert results_digest(mine / "r") == results_digest(mine / "results/merge.duckdb")
    for command in (
        ("tables", "factors", "--study", "study.toml"),
        ("report", "--study", "study.toml", "--out", "report.html"),
        ("view", "--study", "study.toml", "--export", "pages"),
        ("audit", "--study", "study.toml"),
    ):
        done = await merge_runner(*command, cwd=mine)
        assert done.code == 0, (command, done.err)
        if command[0] == "tables":
            assert all(f"{factor} = " in done.out or factor in done.out for factor in FACTORS)
            assert "lowest speed" in done.out
    monkeypatch.chdir(mine)
    monkeypatch.setenv("EMULATOR_BASE_URL", env["EMULATOR_BASE_URL"])
    trials = (await Study("study.toml", db="n.duckdb").areplay("all.parquet")).trials()
    assert trials.shape[0] == 48
    assert trials.groupby("temperature").size().to_dict() == {0.2: 24, 1.0: 24}
