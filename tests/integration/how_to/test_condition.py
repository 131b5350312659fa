"""The page on adding a condition: played where it is installed, read where it is not."""

from __future__ import annotations

import re

import pytest

from merge_runner.errors import UsageError
from merge_runner.results.store import query
from merge_runner.scenarios.merge.conditions import Condition
from tests.support.harness import FAST, how_to, plugin

CHOSEN = ("--reps", 1, "--conditions", "N_0_0,far,fast-tie")


@pytest.mark.long
async def test_conditions_from_outside_go_through_every_command(merge_runner, tmp_path):
    env = plugin(tmp_path / "installed", how_to("add-a-condition"))

    async def installed(*arguments):
        process = await merge_runner.start(*arguments, **env)
        out, err = await process.communicate()
        assert process.returncode == 0, err.decode()
        return out.decode()

    await installed("sweep", "baseline", *CHOSEN, *FAST)
    await installed("sweep", "baseline", *CHOSEN, "--model", "projected-order")
    assert "not replayed: " not in await installed("audit")

    # From here on the package is not there.
    read = {
        command[0]: await merge_runner(*command)
        for command in (
            ("tables", "factors", "who-first"),
            ("report", "--out", "report.html"),
            ("view", "--export", "pages"),
            ("audit",),
        )
    }
    assert {name: run.code for name, run in read.items()} == dict.fromkeys(read, 0)
    noted = r"projected-order/baseline: no human drove far, fast-tie \(2 trials\)"
    assert re.search(noted, read["tables"].out)
    assert "not replayed: 3 trials" in read["audit"].out
    assert "no human drove" in (tmp_path / "report.html").read_text()
    assert "no human drove it" in (tmp_path / "pages/index.html").read_text()

    # Who keeps a speed of 15 m/s deviates from it by nothing.
    rmse = "SELECT least(rmse_left_mps, rmse_right_mps) FROM trial_metrics JOIN trials "
    rmse += "USING (trial_id, spec_hash) WHERE condition = 'fast-tie' AND source = 'driver'"
    assert query(tmp_path / "results/merge.duckdb", rmse)[1] == [(0.0,)]


@pytest.mark.parametrize(
    ("name", "headway_m", "reason"),
    [("beyond", 60.0, "at the merge point"), ("too far", 8.0, "needs a name of letters")],
)
async def test_a_condition_that_cannot_be_played_is_refused_before_any_call(
    merge_runner, tmp_path, name, headway_m, reason
):
    source = (
        how_to("add-a-condition") + f"CONDITIONS.register({name!r}, Condition({headway_m}, 0.0))"
    )
    env = plugin(tmp_path / "installed", source)
    process = await merge_runner.start("sweep", "baseline", "--conditions", name, **env)
    _, err = await process.communicate()
    assert process.returncode == 2
    assert reason in err.decode()


@pytest.mark.parametrize("numbers", [(0.0, 3.0, 1.5), (0.0, -3.0, 1.0), (float("nan"), 0.0, 10.0)])
def test_both_vehicles_drive_forwards(numbers):
    with pytest.raises(UsageError, match="must drive forwards"):
        Condition(*numbers)
