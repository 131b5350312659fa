"""The scenario of the page on adding one: played where it is installed, read where it is not."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial

import duckdb
import pytest

from analysis.explorer.details import read_trial
from merge_runner.errors import UsageError
from merge_runner.results.store import Store, query
from merge_runner.scenarios.merge.geometry import Track
from merge_runner.scenarios.merge.world import World
from merge_runner.scenarios.registry import SCENARIOS
from tests.harness import FAST, how_to, plugin

FILE = """
repetitions = { baseline = 1 }
conditions = ["N_0_0", "L_4_8"]
[scenario]
name = "long-merge"
"""
# When a vehicle first passes 120 m, linear within the step.
FIRST = """
SELECT trial_id, min(before_s + (time_s - before_s) * (120 - before_m) / (position_m - before_m))
FROM (SELECT *, lag(position_m) OVER vehicle AS before_m, lag(time_s) OVER vehicle AS before_s
    FROM states WINDOW vehicle AS (PARTITION BY trial_id, side ORDER BY step))
WHERE before_m < 120 AND position_m >= 120 GROUP BY ALL ORDER BY ALL
"""
MEASURED = "SELECT trial_id, time_to_merge_s FROM trial_metrics ORDER BY ALL"


@pytest.mark.long
async def test_a_scenario_from_outside_goes_through_every_command(merge_runner, tmp_path):
    env = plugin(tmp_path / "installed", how_to("add-a-scenario"))
    (tmp_path / "long.toml").write_text(FILE)

    async def installed(*arguments):
        process = await merge_runner.fork(*arguments, **env)
        out, err = await process.communicate()
        assert process.returncode == 0, err.decode()
        return out.decode()

    await installed("sweep", "long.toml", *FAST)
    await installed("sweep", "long.toml", "--model", "projected-order")
    assert "not derived anew" not in await installed("audit")

    # From here on the package is not there.
    for command in (
        ("report", "--out", "report.html"),
        ("view", "--trials", "*", "--single", "trials.html"),
        ("audit",),
    ):
        run = await merge_runner(*command)
        assert run.code == 0, run.err
    assert "not derived anew in 2 trials" in run.out
    db = tmp_path / "results/merge.duckdb"
    key = query(db, "SELECT trial_id, spec_hash FROM trials LIMIT 1")[1][0]
    assert read_trial(db, *key).track == Track(merge_point_m=120.0, end_m=170.0)
    assert query(db, MEASURED)[1] == [
        (trial, pytest.approx(first_s)) for trial, first_s in query(db, FIRST)[1]
    ]
    refused = await merge_runner("sweep", "long.toml")
    assert refused.code == 2
    assert "unknown scenario 'long-merge'; valid: merge" in refused.err


WORLD = """
from dataclasses import replace

from merge_runner.scenarios.merge.world import World
from merge_runner.scenarios.registry import SCENARIOS

class Mine(World):
    '''The merge, with rules of one's own.'''

SCENARIOS.register("mine", replace(SCENARIOS["merge"], make_world=Mine))
"""


@pytest.mark.slow
async def test_trials_of_a_world_whose_source_is_edited_are_other_trials(merge_runner, tmp_path):
    (tmp_path / "mine.toml").write_text(FILE.replace("long-merge", "mine"))

    async def installed(folder, source, *arguments):
        process = await merge_runner.fork(*arguments, **plugin(tmp_path / folder, source))
        return (await process.communicate())[0].decode()

    played = ("sweep", "mine.toml", "--model", "constant", "--json")
    edited = WORLD.replace("of one's own", "that were edited")
    runs = [(folder, source, await installed(folder, source, *played))
            for folder, source in (("a", WORLD), ("b", WORLD), ("c", edited))]  # fmt: skip
    stored_before = [json.loads(out)["trials"]["stored_before"] for *_, out in runs]
    assert stored_before == [0, 2, 0]
    audit = await installed("d", edited, "audit")
    assert "not derived anew in 2 trials: anything, since another version" in audit


def test_a_world_whose_source_cannot_be_told_is_refused():
    with pytest.raises(UsageError, match="its source is not known"):
        replace(SCENARIOS["merge"], make_world=partial(World))


async def test_older_measures_are_told_to_a_reader_and_replaced_when_the_database_is_written_to(
    merge_runner, tmp_path
):
    path = tmp_path / "t.duckdb"
    Store(path)
    with duckdb.connect(str(path)) as connection:
        connection.execute("CREATE OR REPLACE VIEW trial_metrics AS SELECT 1 AS old")
    asked = ("sql", "FROM trial_metrics", "--db", path)
    told = await merge_runner(*asked)
    assert (told.code, told.out.split()[0]) == (0, "old")
    assert told.err.count("another version of the program defined the measures") == 1
    assert "`merge-runner sweep` into it brings them up to date" in told.err
    Store(path)
    assert "gap_m" in query(path, "FROM trial_metrics")[0]
    assert (await merge_runner(*asked)).err == ""
