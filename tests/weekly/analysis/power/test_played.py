"""A driver that was played is simulated as its trials went."""

from __future__ import annotations

import json

import numpy as np
import pytest

from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner_analysis.data.study import Study
from merge_runner_analysis.power import played, simulate
from merge_runner_analysis.stats.regressions import gap_ols

REPS = 10


@pytest.mark.long
async def test_the_gaps_of_a_driver_as_played_scatter_as_those_that_it_left(merge_runner, tmp_path):
    study = ("baseline", "--model", "cei", "--reps", REPS)
    db = ("--db", tmp_path / "cei.duckdb")
    sweep = await merge_runner("sweep", *study, *db, "--json")
    told = await merge_runner("power", *study, *db, "--sims", 20, "--json")
    if sweep.code or told.code:
        pytest.fail(sweep.err + told.err)
    rows = json.loads(told.out)["chances"]
    assert {row["truth"] for row in rows} == {"human", "cei/baseline as played"}
    (group,) = Study(tmp_path / "cei.duckdb").models
    again = simulate(played(group), list(HUMAN_CONDITIONS), REPS, np.random.default_rng(1))
    errors = [
        gap_ols(trials, robust=True).terms["abs_projected_headway"].se
        for trials in (group.trials, again)
    ]
    assert errors[0] / errors[1] == pytest.approx(1, abs=0.3)
