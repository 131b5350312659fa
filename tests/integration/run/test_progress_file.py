"""What a running sweep tells other processes in the file beside its database."""

from __future__ import annotations

import asyncio

from merge_runner.run.progress import read_standing
from tests.support.gate import HANGS_S

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
