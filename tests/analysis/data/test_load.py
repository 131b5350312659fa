"""Results as data frames."""

from __future__ import annotations

import subprocess
import sys

import analysis
from analysis import Study, load_trials, table


def test_a_notebook_gets_one_row_a_trial_with_its_metrics(in_process, tmp_path):
    assert in_process("sweep", "baseline", "--model", "projected-order", "--reps", 1) == 0
    frame = load_trials(tmp_path / "results/merge.duckdb")
    assert len(frame) == 11
    assert frame["gap_m"].between(0, 30).all()
    assert set(frame["merged_first"]) == {"left", "right"}


def test_a_notebook_gets_the_tables_at_full_precision(study):
    frame = table(Study(study.db), "ablation-quantitative")
    assert list(frame.index) == ["human", "o3/baseline", "o3/A1", "o3/A2", "other/baseline"]
    assert frame.loc["o3/A1", "gap_m_ci_low"] < frame.loc["o3/A1", "gap_m"]


def test_the_menu_is_small_and_loads_nothing_before_it_is_used():
    assert analysis.__all__ == ["TABLES", "Study", "load", "load_trials", "table"]
    assert all(hasattr(analysis, name) for name in analysis.__all__)
    code = "import sys, analysis.commands; print('pandas' in sys.modules or 'scipy' in sys.modules)"
    assert subprocess.check_output([sys.executable, "-c", code], text=True).strip() == "False"
