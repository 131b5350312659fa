"""A driver that was played is simulated as its trials went."""

from __future__ import annotations

import json

import pytest

REPS = 10
# A test at 5 % finds an effect of so many standard errors with a chance of 80 %.
FINDABLE_ERRORS = 1.96 + 0.84


@pytest.mark.long
async def test_the_gaps_of_a_driver_as_played_scatter_as_those_that_it_left(merge_runner):
    study = ("baseline", "--model", "cei", "--reps", REPS)
    sweep = await merge_runner("sweep", *study, "--json")
    told = await merge_runner("power", *study, "--json")
    tables = await merge_runner("tables", "gap", "--format", "json")
    if sweep.code or told.code or tables.code:
        pytest.fail(sweep.err + told.err + tables.err)
    (smallest,) = (
        chance["smallest"]
        for chance in json.loads(told.out)["chances"]
        if chance["table"] == "gap"
        and "as played" in chance["truth"]
        and "headway" in chance["question"]
    )
    (error,) = (
        row["hc3_se"]
        for row in json.loads(tables.out)["tables"][0]["rows"]
        if row["driver"] == "cei" and row["term"] == "Abs. projected headway"
    )
    assert smallest / (FINDABLE_ERRORS * error) == pytest.approx(1, abs=0.3)
