"""One of each kind, from five installed packages at once."""

from __future__ import annotations

import duckdb
import pytest

from tests.integration.how_to.test_wire_format import MODELS, Talker, listening
from tests.support.harness import Run, how_to, plugin

KINDS = ("condition", "driver", "metric", "prompt-block", "wire-format")
FILE = """
conditions = ["far", "fast-tie", "N_0_0"]
[repetitions]
baseline = 1
A8 = 1
[scenario]
step_s = 0.05
plan_step_s = 0.2
"""
PAIR = "talker-1+impulsive"


@pytest.fixture
def run(merge_runner, tmp_path):
    """Runs a command where the code of all pages is installed."""
    for kind in KINDS:
        installed = plugin(
            tmp_path / "installed", how_to(f"add-a-{kind}"), f"own_{kind.replace('-', '_')}"
        )
    (tmp_path / "experiments").mkdir()
    (tmp_path / "experiments/models.toml").write_text(MODELS)
    (tmp_path / "experiments/all.toml").write_text(FILE)

    async def run(*arguments, **changes) -> Run:
        process = await merge_runner.start(*arguments, cwd=tmp_path, **installed, **changes)
        out, err = await process.communicate()
        done = Run(process.returncode, out.decode(), err.decode())
        assert done.code == 0, f"{arguments}: {done.err}"
        return done

    return run


async def test_one_of_each_kind_goes_through_every_command(run, merge_runner, tmp_path):
    talker = Talker()
    async with listening(talker) as there:
        asked = ("--model", PAIR, "--max-cost", 9, "--yes", "--json")
        played = await run("sweep", "all", *asked, **there)
        assert played.summary["trials"]["planned"] == 6
        assert played.summary["audit"]["findings"] == []
        await run("recording", "export", "all.parquet")
        await run("recording", "verify", "all.parquet")
        await run("recording", "import", "all.parquet", "--cache", "again")
        again = ("--cache", "again", "--db", "again.duckdb", "--json")
        replayed = await run("replay", "all", "--model", PAIR, *again, **there)
    # After the merge point both prompts are the same, and share their replies.
    assert replayed.summary["calls"] == {"live": 0, "cached": sum(played.summary["calls"].values())}
    digests = {(await run("digest", *db)).out for db in ((), ("--db", "again.duckdb"))}
    assert len(digests) == 1

    tables = (await run("tables")).out
    for command in (
        ("audit",),
        ("figures", "--out", "figures"),
        ("report", "--out", "report.html"),
        ("view", "--export", "pages"),
    ):
        await run(*command)
    pages = "".join(page.read_text() for page in (tmp_path / "pages").rglob("*.html"))
    for text in ("talker-1", "mean |a|", "no human drove it", "with C6: warning of speed"):
        assert text in pages
    # Where the packages are not installed.
    audit = (await merge_runner("audit", "--json")).out
    assert "not replayed: 6 trials, since unknown " in audit
    bare = await merge_runner("view", "--export", "bare")
    assert bare.code == 0, bare.err
    assert "with C6:" not in "".join(p.read_text() for p in (tmp_path / "bare").rglob("*.html"))
    report = (tmp_path / "report.html").read_text()
    for name in ("talker-1 at ", "+impulsive", "A8", "mean |a|", "no human drove"):
        assert name in tables, name
        assert name in report, name
    assert "(20 Hz); parameters: steady_from_m = 20.0, strength = 0.5" in (await run("models")).out
    with duckdb.connect(str(tmp_path / "results/merge.duckdb"), read_only=True) as connection:
        rows = connection.execute(
            "SELECT condition, "
            "bool_or(prompt LIKE '%it is soon beside you%') FILTER (variant = 'A8'), "
            "bool_or(prompt LIKE '%it is soon beside you%') FILTER (variant = 'baseline') "
            "FROM trials JOIN decisions USING (trial_id, spec_hash) GROUP BY ALL ORDER BY ALL"
        ).fetchall()
    assert rows == [(name, True, False) for name in ("N_0_0", "far", "fast-tie")]
