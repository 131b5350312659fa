"""Results as data frames, and what is remembered of a study."""

import gc
import subprocess
import sys
import weakref
from pkgutil import iter_modules

import numpy as np
import pandas as pd

import merge_runner_analysis
from merge_runner.results.database import read_database
from merge_runner.results.store import Store
from merge_runner_analysis import StudyResults, load, load_trials, table
from merge_runner_analysis.explain import explain
from merge_runner_analysis.figures.gallery import rendered
from merge_runner_analysis.frames import TRIALS
from merge_runner_analysis.stats.indicators import fits
from merge_runner_analysis.tables import TABLES, make_tables
from merge_runner_analysis.trials import with_metrics


def test_the_menu_is_small_and_loads_nothing_before_it_is_used():
    names = ["TABLES", "StudyResults", "load", "load_trials", "table"]
    assert merge_runner_analysis.__all__ == names
    assert all(hasattr(merge_runner_analysis, name) for name in merge_runner_analysis.__all__)
    modules = {module.name for module in iter_modules(merge_runner_analysis.__path__)}
    assert not modules & {*merge_runner_analysis.__all__}, (
        "an import of the module would hide the name"
    )
    loaded = "print('pandas' in sys.modules or 'scipy' in sys.modules)"
    code = f"import sys, merge_runner_analysis.commands, merge_runner_analysis.web.app; {loaded}"
    assert subprocess.check_output([sys.executable, "-c", code], text=True).strip() == "False"


def test_columns_have_their_types_also_where_there_is_no_value(small):
    text = pd.StringDtype(na_value=np.nan)
    expected = {
        "pair": text, "error": text, "scripted": np.dtype(bool), "rep": np.dtype("int64"),
        "end_time_s": np.dtype("float64"), "joint": np.dtype(bool), "min_ttc_s": np.dtype(float),
    }  # fmt: skip
    trials = load_trials(small.db)
    assert len(trials) == 11
    assert trials[["pair", "error"]].isna().all(axis=None)
    assert {name: trials[name].dtype for name in expected} == expected
    every = "select * from trials join trial_metrics using (trial_id, spec_hash) limit 0"
    none = load(every, small.db)
    assert {name: none[name].dtype for name in expected} == expected
    sweeps = load("select started_at, versions, null::int as exit_code from sweeps", small.db)
    assert [str(dtype) for dtype in sweeps.dtypes] == ["datetime64[us]", "str", "Int64"]


def test_a_missing_truth_value_or_number_is_neither_false_nor_a_fraction(tmp_path):
    Store(tmp_path / "empty.duckdb")
    frame = load("values (true, 2), (null, null)", tmp_path / "empty.duckdb")
    assert [str(dtype) for dtype in frame.dtypes] == ["boolean", "Int64"]
    assert frame.iloc[0].tolist() == [True, 2]
    assert frame.iloc[1].isna().all()


def test_metrics_that_need_more_memory_than_is_asked_for_first_get_it(small):
    with read_database(small.db) as connection:
        expected = with_metrics(connection, TRIALS)
        connection.execute("SET memory_limit = '3MB'; SET threads = 1")
        pd.testing.assert_frame_equal(with_metrics(connection, TRIALS), expected)


def used(db):
    """References to a study and to its groups, after all of its tables have been made."""
    study = StudyResults(db)
    for name in TABLES:
        table(study, name)
    for made in make_tables(study, ["who-first", "gap", "attempts", "verdicts"]):
        for row in made.rows:
            explain(study, made, row.id)
    rendered(study, "first-action", "svg")
    (group,) = study.models
    assert fits(group) is fits(group), "what is computed of a group is computed once"
    assert fits(group) is not fits(study.human)
    return [weakref.ref(one) for one in (study, group, *study.probes)]


def test_a_study_is_remembered_while_it_is_used_and_then_freed(small):
    references = used(small.db)
    gc.collect()
    assert [one() for one in references if one() is not None] == []
