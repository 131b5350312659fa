"""Results as data frames."""

from __future__ import annotations

from analysis.load import load_trials


async def test_a_notebook_gets_one_row_a_trial_with_its_metrics(merge_runner, tmp_path):
    assert (
        await merge_runner("sweep", "baseline", "--model", "projected-order", "--reps", 1)
    ).code == 0
    frame = load_trials(tmp_path / "results/merge.duckdb")
    assert len(frame) == 11
    assert frame["gap_m"].between(0, 30).all()
    assert set(frame["merged_first"]) == {"left", "right"}
