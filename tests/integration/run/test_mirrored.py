"""A pair that is played both ways round, from the sweep to the tables."""

from __future__ import annotations

from merge_runner.results.store import results_digest

PAIR = ("baseline", "--model", "emulator+projected-order", "--mirror", "--reps", 1,
        "--conditions", "N_0_0,L_4_0,R_-4_8")  # fmt: skip


async def test_a_mirrored_pair_replays_to_itself_and_is_one_driver_in_tables(
    merge_runner, tmp_path
):
    run = await merge_runner("sweep", *PAIR, "--json")
    assert (run.code, run.summary["trials"]["planned"]) == (0, 6), run.err
    assert (await merge_runner("replay", *PAIR, "--db", "again.duckdb")).code == 0
    digest = results_digest(tmp_path / "results/merge.duckdb")
    assert digest == results_digest(tmp_path / "again.duckdb")
    tables = await merge_runner("tables", "ablation-quantitative", "--format", "csv")
    assert "emulator+projected-order/baseline" in tables.out
    assert "projected-order+emulator" not in tables.out
    notes = " ".join((await merge_runner("tables", "who-first")).out.split())
    assert "emulator sat on the left in 3 trials, and on the right in 3, mirrored" in notes


async def test_the_summary_names_a_pair_as_the_tables_do(merge_runner):
    part = ("--reps", 1, "--conditions", "L_4_0")
    run = await merge_runner(
        "sweep", "baseline", "--model", "projected-order+constant", "--model", "constant", *part
    )
    assert run.code == 0, run.err
    counts = {line.split()[0]: line.split()[1] for line in run.out.splitlines() if line}
    assert counts["constant+projected-order"] == counts["constant"] == "1"
