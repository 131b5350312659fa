"""What is kept beside the database: equal to what is computed anew, and renewed when it must be."""

import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from merge_runner.errors import UsageError
from merge_runner_analysis import cache
from merge_runner_analysis.cache import cache_finished, finished, present_state
from merge_runner_analysis.figures import FIGURES
from merge_runner_analysis.selection import Selection
from merge_runner_analysis.study import StudyResults
from merge_runner_analysis.table_format import TableFormat
from merge_runner_analysis.tables import TABLES, finished_tables
from merge_runner_analysis.tables.formats import render
from merge_runner_analysis.tables.model import from_text, to_text
from merge_runner_analysis.web.report import finished_figures
from tests.support.studies import damage, write_study, yielding

# Changes of the results that tables show, and one of each table that they are made of.
CHANGES = {
    "a speed": "UPDATE states SET velocity_mps = velocity_mps + 1e-9 "
    "WHERE step = 9 AND side = 'left' AND trial_id LIKE '%N_0_0/rep01'",
    "an outcome": "UPDATE trials SET status = 'timeout' WHERE trial_id LIKE '%N_0_0/rep01'",
    "a plan": "UPDATE decisions SET plan = [0.5] WHERE decision = 1",
    "a fate": "UPDATE calls SET outcome = 'unknown' WHERE attempt = 1 AND decision = 0",
    "an alias": "UPDATE sweeps SET config = '{\"models\": {}}'",
    "a trial of a sweep": "DELETE FROM sweep_trials WHERE trial_id LIKE '%N_0_0/rep01'",
    "a level": "INSERT INTO trial_factors SELECT trial_id, spec_hash, 'mood', 'good', false "
    "FROM trials",
    "a setting": "UPDATE specs SET spec = '{}'",
    "a trial": "INSERT INTO trials SELECT * REPLACE ('o3/baseline/N_0_0/rep99' AS trial_id, "
    "99 AS rep) FROM trials WHERE trial_id LIKE '%N_0_0/rep01'",
    "two trials' outcomes": "UPDATE trials SET merged_first = "
    "if(merged_first = 'left', 'right', 'left') WHERE condition IN ('L_4_0', 'R_-4_0')",
}


@pytest.fixture(scope="module")
def asked(tmp_path_factory):
    """o3 once in every condition, and asked."""
    drives = [replace(drive, said={}) for drive in yielding("o3", reps=1)]
    return write_study(tmp_path_factory.mktemp("asked") / "t.duckdb", drives)


@pytest.fixture
def db(asked, tmp_path) -> Path:
    (tmp_path / "t.duckdb").write_bytes(asked.read_bytes())
    return tmp_path / "t.duckdb"


def mark(db, name="attempts"):
    """Make a table, and mark the one that is kept."""
    (table,) = finished_tables(db, [name])
    state = present_state(db)
    kept = from_text(finished(db, state, Selection().key(db), [name])[name])
    assert to_text(kept) == to_text(table)
    kept.notes.append("kept")
    db.with_name(f"{db.name}.derived").unlink()
    cache_finished(db, state, Selection().key(db), {name: to_text(kept)})
    return state


def is_read(db, study=None, **selection) -> bool:
    """Whether the marked table is read, and not made anew."""
    (table,) = finished_tables(db, ["attempts"], study, Selection(**selection))
    return "kept" in table.notes


@pytest.mark.parametrize("name", TABLES)
def test_a_table_reads_the_same_after_it_was_a_text(tables, name):
    again = from_text(to_text(tables[name]))
    for form in TableFormat:
        assert render([again], form) == render([tables[name]], form)
    assert to_text(again) == to_text(tables[name])


def test_tables_are_made_once_beside_the_database_and_then_read(db):
    before = db.read_bytes()
    mark(db)
    assert is_read(db)
    assert not is_read(db, models=["o3"])
    other, again = finished_tables(db, ["criticality", "attempts"])
    assert (other.name, "kept" in other.notes, "kept" in again.notes) == (
        "criticality",
        False,
        True,
    )
    assert db.read_bytes() == before
    with pytest.raises(UsageError, match="unknown table 'gaps'"):
        finished_tables(db, ["gaps"])
    with pytest.raises(UsageError, match="unknown driver 'o4'"):
        finished_tables(db, ["attempts"], selection=Selection(["o4"]))


def test_after_any_change_of_the_results_tables_are_made_anew(db):
    states = [mark(db)]
    study = StudyResults(db)
    assert present_state(db) == states[0]
    for change in CHANGES.values():
        damage(db, change)
        states.append(present_state(db))
    assert len({*states}) == len(states)
    assert not is_read(db)
    # What was read before the change is not kept for the state after it.
    finished_tables(db, ["criticality"], study)
    assert finished(db, states[-1], Selection().key(db), ["criticality"]) == {}
    # Nor does it take a table of the later state.
    mark(db)
    assert not is_read(db, study)
    assert is_read(db)


def test_the_program_is_told_by_its_code_and_its_values(tmp_path, monkeypatch):
    program = cache.program.__wrapped__  # it is remembered as long as the process lives
    monkeypatch.setattr(cache, "PACKAGES", (tmp_path,))
    found = [program()]
    for name, text in (("b.csv", "1"), ("a.py", "x = 1"), ("a.py", "x = 2")):
        (tmp_path / name).write_text(text)
        later_ns = time.time_ns() + 10**9 * len(found)
        os.utime(tmp_path / name, ns=(later_ns, later_ns))
        found.append(program())
    (tmp_path / "b.csv").unlink()
    found.append(program())
    assert len({*found}) == 5


def test_what_cannot_be_kept_is_made_and_said_once(db, caplog):
    before = db.read_bytes()
    db.with_name(f"{db.name}.derived").mkdir()
    for _ in range(2):
        assert finished_tables(db, ["criticality"])
    assert caplog.text.count("is not cached for the next time") == 1
    assert db.read_bytes() == before


def test_figures_that_are_kept_are_not_taken_for_tables_and_not_drawn_again(db):
    study = StudyResults(db)
    kept = {f"{name}.svg": "PHN2Zy8+" for name in FIGURES}
    cache_finished(db, study.state, study.options, kept)
    assert finished_figures(study) == dict.fromkeys(FIGURES, "PHN2Zy8+")
    assert finished_tables(db, ["first-action"])[0].rows


def test_a_warm_table_waits_for_no_heavy_library(db):
    check = (
        "import sys; from merge_runner_analysis.commands import app; "
        "app(['tables', 'gap', '--db', sys.argv[1]], standalone_mode=False); "
        "heavy = {'duckdb', 'pandas', 'scipy', 'statsmodels', 'matplotlib', 'numpy'}; "
        "heavy &= sys.modules.keys(); "
        "assert not heavy, heavy"
    )
    finished_tables(db, ["gap"])
    done = subprocess.run(
        [sys.executable, "-c", check, str(db)], capture_output=True, text=True, check=False
    )
    assert "Table IV" in done.stdout
    assert done.returncode == 0, done.stderr
