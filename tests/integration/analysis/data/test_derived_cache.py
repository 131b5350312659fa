"""What is kept beside the database: equal to what is computed anew, and renewed when it must be."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import duckdb
import pytest

from merge_runner.errors import UsageError
from merge_runner_analysis.data import derived_cache as kept
from merge_runner_analysis.data.derived_cache import (
    finished,
    keep_finished,
    options_text,
    present_state,
)
from merge_runner_analysis.data.study import Study
from merge_runner_analysis.names import TableFormat
from merge_runner_analysis.report.page import finished_figures
from merge_runner_analysis.tables import TABLES, finished_tables, make_tables
from merge_runner_analysis.tables.formats import render
from merge_runner_analysis.tables.model import from_text, to_text
from tests.support.studies import write_study, yielding

# Changes of the results that tables show, and one of each table that they are made of.
CHANGES = {
    "a speed": "UPDATE states SET velocity_mps = velocity_mps + 1e-9 "
    "WHERE step = 9 AND side = 'left' AND trial_id LIKE '%N_0_0/rep01'",
    "an outcome": "UPDATE trials SET status = 'timeout' WHERE trial_id LIKE '%N_0_0/rep01'",
    "a plan": "UPDATE decisions SET plan = [0.5] WHERE decision = 1",
    "a fate": "UPDATE calls SET outcome = 'unknown' WHERE attempt = 1 AND decision = 0",
    "an alias": "UPDATE sweeps SET config = '{\"models\": {}}'",
    "a trial of a sweep": "DELETE FROM sweep_trials WHERE trial_id LIKE '%N_0_0/rep01'",
    "a level": "INSERT INTO trial_factors SELECT trial_id, spec_hash, 'mood', 'good' FROM trials",
    "a setting": "UPDATE specs SET spec = '{}'",
    "a trial": "INSERT INTO trials SELECT * REPLACE ('o3/baseline/N_0_0/rep99' AS trial_id, "
    "99 AS rep) FROM trials WHERE trial_id LIKE '%N_0_0/rep01'",
    "two trials' outcomes": "UPDATE trials SET merged_first = "
    "if(merged_first = 'left', 'right', 'left') WHERE condition IN ('L_4_0', 'R_-4_0')",
}
UNSEEN = "UPDATE decisions SET prompt = 'other'; UPDATE calls SET reply = '{}'"


@pytest.fixture
def db(tmp_path) -> Path:
    """o3 once in every condition, and asked."""
    drives = [replace(drive, said={}) for drive in yielding("o3", reps=1)]
    return write_study(tmp_path / "t.duckdb", drives)


@pytest.fixture
def made(monkeypatch):
    """Notes which tables are made."""
    names = []

    def make(study, missing):
        names.extend(missing)
        return make_tables(study, missing)

    monkeypatch.setattr("merge_runner_analysis.tables.make_tables", make)
    return names


def change(db, sql):
    with duckdb.connect(str(db)) as connection:
        connection.execute(sql)


@pytest.mark.parametrize("name", TABLES)
@pytest.mark.parametrize("form", TableFormat)
def test_a_table_reads_the_same_after_it_was_a_text(tables, name, form):
    again = from_text(to_text(tables[name]))
    assert render([again], form) == render([tables[name]], form)
    assert to_text(again) == to_text(tables[name])


@pytest.mark.slow
def test_tables_are_made_once_and_then_read(db, made):
    first = finished_tables(db, ["gap", "attempts"])
    assert made == ["gap", "attempts"]
    again = finished_tables(db, ["attempts", "factors", "gap"])
    assert made == ["gap", "attempts", "factors"]
    assert [to_text(t) for t in (again[2], again[0])] == [to_text(t) for t in first]
    assert finished_tables(db, ["gap"], options={"models": ["o3"]})
    assert made[3:] == ["gap"]


@pytest.mark.slow
@pytest.mark.parametrize("what", CHANGES)
def test_after_any_change_of_the_results_tables_are_made_anew(db, made, what):
    finished_tables(db, ["attempts"])
    state = present_state(db)
    change(db, UNSEEN)
    assert present_state(db) == state
    change(db, CHANGES[what])
    assert present_state(db) != state
    finished_tables(db, ["attempts"])
    assert made == ["attempts", "attempts"]


@pytest.mark.slow
def test_another_program_makes_tables_anew(db, made, monkeypatch):
    for name in ("one", "one", "other", "other"):
        monkeypatch.setattr(
            "merge_runner_analysis.data.derived_cache.program", lambda name=name: name
        )
        finished_tables(db, ["criticality"])
    assert made == ["criticality"] * 2


def test_the_program_is_told_by_its_code_its_values_and_its_libraries(tmp_path, monkeypatch):
    (tmp_path / "a.py").write_text("x = 1")
    monkeypatch.setattr("merge_runner_analysis.data.derived_cache.PACKAGES", (tmp_path,))
    found = {kept.program.__wrapped__()}
    (tmp_path / "a.py").write_text("x = 2")
    found.add(kept.program.__wrapped__())
    (tmp_path / "b.csv").write_text("1")
    found.add(kept.program.__wrapped__())
    monkeypatch.setattr("merge_runner_analysis.data.derived_cache.version", lambda _: "0")
    found.add(kept.program.__wrapped__())
    assert len(found) == 4


@pytest.mark.slow
def test_what_is_kept_is_not_in_the_database(db):
    before = db.read_bytes()
    finished_tables(db, ["criticality"])
    assert db.read_bytes() == before


def test_tables_of_results_that_changed_meanwhile_are_not_kept(db):
    state = present_state(db)
    change(db, CHANGES["an outcome"])
    keep_finished(db, state, "x", {"gap": "old"})
    now = present_state(db)
    assert finished(db, now, "x", ["gap"]) == finished(db, state, "x", ["gap"]) == {}
    keep_finished(db, now, "x", {"gap": "new"})
    assert finished(db, now, "x", ["gap"]) == {"gap": "new"}


def test_tables_of_a_study_that_was_read_before_a_change_are_not_kept(db):
    study = Study(db)
    change(db, CHANGES["an outcome"])
    finished_tables(db, ["attempts"], study)
    assert finished(db, present_state(db), options_text(db), ["attempts"]) == {}


@pytest.mark.slow
def test_a_study_that_was_read_before_a_change_takes_no_table_of_the_later_state(db, made):
    study = Study(db)
    change(db, CHANGES["an outcome"])
    finished_tables(db, ["attempts"])
    finished_tables(db, ["attempts"], study)
    assert made == ["attempts", "attempts"]


def test_what_cannot_be_kept_is_made_and_said_once(db, made, caplog):
    before = db.read_bytes()
    db.with_name(f"{db.name}.derived").mkdir()
    for _ in range(2):
        assert finished_tables(db, ["criticality"])
    assert made == ["criticality"] * 2
    assert caplog.text.count("is not kept for the next time") == 1
    assert db.read_bytes() == before


def test_a_figure_is_not_taken_for_the_table_of_its_name(db, monkeypatch):
    monkeypatch.setattr("merge_runner_analysis.report.page.FIGURES", {"attempts": None})
    monkeypatch.setattr("merge_runner_analysis.report.page.rendered", lambda *_: b"<svg/>")
    (table,) = finished_tables(db, ["attempts"])
    assert finished_figures(Study(db)) == {"attempts": "PHN2Zy8+"}
    (again,) = finished_tables(db, ["attempts"])
    assert to_text(again) == to_text(table)


@pytest.mark.slow
def test_figures_are_drawn_once_and_renewed(db, monkeypatch):
    drawn = []
    monkeypatch.setattr(
        "merge_runner_analysis.report.page.FIGURES", {"figure2": None, "first-action": None}
    )
    monkeypatch.setattr(
        "merge_runner_analysis.report.page.rendered",
        lambda *wanted: drawn.append(wanted[1:]) or b"<svg/>",
    )
    first = finished_figures(Study(db))
    assert finished_figures(Study(db)) == first == dict.fromkeys(first, "PHN2Zy8+")
    assert drawn == [("figure2", "svg"), ("first-action", "svg")]
    change(db, CHANGES["an outcome"])
    finished_figures(Study(db))
    assert drawn == [("figure2", "svg"), ("first-action", "svg")] * 2


@pytest.mark.long
def test_a_warm_table_waits_for_no_heavy_library(db, tmp_path):
    check = (
        "import sys; from merge_runner_analysis.commands import app; "
        "app(['tables', 'gap', '--db', sys.argv[1]], standalone_mode=False); "
        "heavy = {'pandas', 'scipy', 'statsmodels', 'matplotlib', 'numpy'} & sys.modules.keys(); "
        "assert not heavy, heavy"
    )
    for warm in (False, True):  # in a process of its own: a test here may have a study in use
        done = subprocess.run(
            [sys.executable, "-c", check, str(db)], capture_output=True, text=True, check=False
        )
        assert "Table IV" in done.stdout
        assert (done.returncode == 0) == warm, done.stderr


@pytest.mark.slow
def test_unknown_names_are_refused_also_beside_kept_tables(db):
    finished_tables(db, ["attempts"])
    with pytest.raises(UsageError, match="unknown table 'gaps'"):
        finished_tables(db, ["gaps"])
    with pytest.raises(UsageError, match="unknown driver 'o4'"):
        finished_tables(db, ["attempts"], options={"models": ["o4"]})
