"""What a running sweep tells other processes in the file beside its database."""

from __future__ import annotations

import asyncio

from merge_runner.run.plan import Options, make_plan
from merge_runner.run.progress import read_standing
from tests.support.gate import HANGS_S
from tests.support.harness import run_sweep

SWEEP = ("sweep", "baseline", "--reps", 2, "--conditions", "N_0_0,L_4_0", "--rpm", 100)


async def begun(db):
    """The one sweep of a database, as soon as some of its calls are answered and others wait."""
    async with asyncio.timeout(HANGS_S):
        while True:
            for path in db.parent.glob("*.progress/*.json"):
                found = read_standing(db, path.stem)
                if found and any("rate limits" in text for _, text in found.rows):
                    return found, path
            await asyncio.sleep(0.1)


async def test_a_sweep_says_where_it_stands_until_it_is_killed_and_the_next_one_tidies_up(
    merge_runner, tmp_path, emulator_url
):
    db = tmp_path / "m.duckdb"
    process = await merge_runner.start(*SWEEP, "--db", db, EMULATOR_BASE_URL=emulator_url)
    try:
        found, path = await begun(db)
        text, alive = path.read_text(), found.alive
    finally:
        process.kill()
        await process.communicate()
    assert (found.pid, found.doing) == (process.pid, "playing")
    assert dict(found.rows)["trials"] == "0/4 ended, 4 running"
    assert str(tmp_path) not in text
    assert (alive, read_standing(db, found.sweep_id).alive) == (True, False)
    assert (await merge_runner("sweep", "baseline", "--model", "constant", "--db", db)).code == 0
    assert not path.parent.exists()


async def test_the_last_word_of_a_sweep_is_that_it_checks_its_trials(tmp_path, monkeypatch):
    # The instant between the last trial and the end is too short to be met from outside.
    said = []
    for module in ("progress", "sweep"):
        name = f"merge_runner.run.{module}.write_standing"
        monkeypatch.setattr(name, lambda _, standing: said.append(standing))
    plan = make_plan("baseline", "constant", repetitions=2, conditions=["N_0_0", "L_4_0"])
    await run_sweep(plan, Options(tmp_path / "m.duckdb", tmp_path / "c"), say=print)
    assert (said[0].doing, said[-1].doing) == ("playing", "checking")
    assert (said[0].ended, said[-1].ended, said[-1].failed) == (0, 4, 0)
