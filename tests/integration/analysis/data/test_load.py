"""Results as data frames."""

from __future__ import annotations

import subprocess
import sys
from pkgutil import iter_modules

import numpy as np
import pandas as pd
import pytest

import merge_runner_analysis
from merge_runner.results.store import Store
from merge_runner_analysis import Study, load, load_trials, table


@pytest.mark.slow
def test_a_notebook_gets_one_row_a_trial_with_its_metrics(in_process, tmp_path):
    assert in_process("sweep", "baseline", "--model", "projected-order", "--reps", 1) == 0
    frame = load_trials(tmp_path / "results/merge.duckdb")
    assert len(frame) == 11
    assert frame["gap_m"].between(0, 30).all()
    assert set(frame["merged_first"]) == {"left", "right"}


@pytest.mark.slow
def test_a_notebook_gets_the_tables_at_full_precision(study):
    frame = table(Study(study.db), "ablation-quantitative")
    assert list(frame.index) == ["human", "o3/baseline", "o3/A1", "o3/A2", "other/baseline"]
    assert frame.equals(table(study.db, "ablation-quantitative"))
    assert frame.loc["o3/A1", "gap_m_ci_low"] < frame.loc["o3/A1", "gap_m"]


def test_the_menu_is_small_and_loads_nothing_before_it_is_used():
    assert merge_runner_analysis.__all__ == ["TABLES", "Study", "load", "load_trials", "table"]
    assert all(hasattr(merge_runner_analysis, name) for name in merge_runner_analysis.__all__)
    modules = {module.name for module in iter_modules(merge_runner_analysis.__path__)}
    assert not modules & {*merge_runner_analysis.__all__}, (
        "an import of the module would hide the name"
    )
    loaded = "print('pandas' in sys.modules or 'scipy' in sys.modules)"
    code = f"import sys, merge_runner_analysis.commands; {loaded}"
    assert subprocess.check_output([sys.executable, "-c", code], text=True).strip() == "False"


def test_columns_have_their_types_also_where_there_is_no_value(in_process, tmp_path):
    db = tmp_path / "results/merge.duckdb"
    part = ("sweep", "baseline", "--model", "projected-order", "--reps", 1)
    assert in_process(*part, "--conditions", "N_0_0") == 0
    text = pd.StringDtype(na_value=np.nan)
    expected = {
        "pair": text, "error": text, "scripted": np.dtype(bool), "rep": np.dtype("int64"),
        "end_time_s": np.dtype("float64"), "joint": np.dtype(bool), "min_ttc_s": np.dtype(float),
    }  # fmt: skip
    trials = load_trials(db)
    assert trials["pair"].isna().all()
    assert trials["error"].isna().all()
    assert {name: trials[name].dtype for name in expected} == expected
    none = load("select * from trials join trial_metrics using (trial_id, spec_hash) limit 0", db)
    assert {name: none[name].dtype for name in expected} == expected
    sweeps = load("select exit_code, started_at, versions, null::int as exit_code from sweeps", db)
    assert [str(dtype) for dtype in sweeps.dtypes] == ["int64", "datetime64[us]", "str", "Int64"]


def test_a_missing_truth_value_or_number_is_neither_false_nor_a_fraction(tmp_path):
    Store(tmp_path / "empty.duckdb")
    frame = load("values (true, 2), (null, null)", tmp_path / "empty.duckdb")
    assert [str(dtype) for dtype in frame.dtypes] == ["boolean", "Int64"]
    assert frame.iloc[0].tolist() == [True, 2]
    assert frame.iloc[1].isna().all()
