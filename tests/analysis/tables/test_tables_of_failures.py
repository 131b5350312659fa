"""What became of the calls, and whether failures bias the outcomes."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import duckdb
import pytest

from analysis.data.load import load
from analysis.data.provenance import tally
from analysis.data.study import Study
from analysis.explain import explain
from analysis.metrics import LEFT_FIRST
from analysis.stats.measures import estimate
from analysis.stats.regressions import gap_ols
from analysis.tables import make_tables
from analysis.tables.fallbacks import without_fallbacks
from tests.analysis.studies import Drive, Said, write_study, yielding

FAILED = Said(failure="no_array")


def cell(table, row_id, column):
    (row,) = [row for row in table.rows if row.id == row_id]
    return row.values.get(column)


def row_of(table, row_id):
    (row,) = [row for row in table.rows if row.id == row_id]
    return row


def test_every_attempt_has_one_fate_and_every_call_one_end(study):
    every = load("SELECT spec_hash, fate, outcome FROM attempts", study.db)
    for group in study.models:
        found = tally(study, group)
        rows = every[every["spec_hash"] == group.spec_hash]
        fates = Counter(rows["fate"])
        assert found.attempts == len(rows) == found.calls + found.retried
        assert found.calls == fates["driven"] + fates["fallback"] + fates["lost"]
        assert (found.retried, found.lost) == (fates["retried"], fates["lost"])
        assert found.invalid == fates["fallback"] == found.fallbacks
        assert found.unknown == (rows["outcome"] == "unknown").sum()
        assert found.decisions == found.answers


def test_each_trouble_is_counted_where_it_was(tables):
    row = row_of(tables["attempts"], "o3/A1").values
    counts = {
        "trials": 55, "failed": 0, "calls": 892, "attempts": 896, "retried": 4, "lost": 0,
        "refused": 1, "truncated": 1, "empty": 1, "no_array": 2, "wrong_length": 1,
        "out_of_range": 0, "invalid": 6, "fallback": 6, "unknown": 1, "other_model": 0,
    }  # fmt: skip
    assert {name: row[name] for name in counts} == counts
    assert row["retried_percent"] == pytest.approx(100 * 4 / 896)
    assert row["refused_percent"] == pytest.approx(100 / 892)
    assert row["fallback_percent"] == pytest.approx(100 * 6 / 892)
    other = row_of(tables["attempts"], "other/baseline").values
    assert (other["failed"], other["lost"], other["retried"], other["other_model"]) == (1, 1, 1, 3)
    assert other["lost_percent"] == pytest.approx(100 / 704)
    assert cell(tables["attempts"], "o3/baseline", "other_model") == 0, "an alias is declared"


@pytest.mark.parametrize(
    ("column", "trials"),
    [
        ("retried", ["R_-4_0/rep02", "R_-4_0/rep03", "R_-4_0/rep04"]),
        ("unknown", ["R_-4_0/rep03"]),
        ("refused_percent", ["R_-4_-8/rep01"]),
        ("wrong_length", ["R_-4_-8/rep05"]),
        ("fallback", [*(f"R_-4_-8/rep0{i}" for i in range(1, 6)), "R_-4_0/rep01"]),
    ],
)
def test_a_count_leads_to_the_trials_that_it_was_in(study, tables, column, trials):
    found = explain(study, tables["attempts"], f"o3/A1:{column}")
    assert [list(source.trials) for source in found.sources] == [[f"o3/A1/{t}" for t in trials]]


def test_a_lost_call_leads_to_its_failed_trial(study, tables):
    for column in ("failed", "lost", "lost_percent"):
        found = explain(study, tables["attempts"], f"other/baseline:{column}")
        assert [source.trials for source in found.sources] == [("other/baseline/R_-4_-8/rep01",)]


def test_a_driver_that_asks_no_model_has_no_rate_but_a_reason(small):
    (table,) = make_tables(small, ["attempts"])
    row = row_of(table, "o3/baseline")
    assert (row.values["calls"], row.values["attempts"]) == (0, 0)
    assert row.values["retried_percent"] is None
    assert "no call" in row.note
    assert row.values["fallback_percent"] == 0


def test_without_are_the_trials_in_which_every_decision_was_driven_from_its_answer(study, tables):
    group = next(group for group in study.models if group.id == "o3/A1")
    had = load(
        "SELECT DISTINCT trial_id FROM decisions WHERE fallback AND spec_hash = 'o3-A1'", study.db
    )["trial_id"]
    kept = without_fallbacks(study, group)
    assert set(kept.trials["trial_id"]) == set(group.trials["trial_id"]) - set(had)
    assert (len(group.trials), len(kept.trials)) == (55, 49)
    table = tables["fallbacks"]
    rest = group.finished[~group.finished["trial_id"].isin(had)]
    assert cell(table, "o3/A1/gap_m", "all") == pytest.approx(group.finished["gap_m"].mean())
    assert cell(table, "o3/A1/gap_m", "without") == pytest.approx(rest["gap_m"].mean())
    assert cell(table, "o3/A1/gap_m", "difference") == pytest.approx(
        rest["gap_m"].mean() - group.finished["gap_m"].mean()
    )
    left = (rest["merged_first"] == "left").sum()
    assert cell(table, "o3/A1/left_first_percent", "without") == pytest.approx(100 * left / 49)
    assert cell(table, "o3/A1/left_first_percent", "ci_without") == pytest.approx(
        (estimate(kept, LEFT_FIRST).low, estimate(kept, LEFT_FIRST).high)
    )
    p = gap_ols(rest).terms["abs_projected_headway"].p
    assert cell(table, "o3/A1/I3", "paper_without") == (p < 0.05)


def test_where_no_trial_had_a_fallback_nothing_differs_and_the_row_says_so(tables):
    rows = [row for row in tables["fallbacks"].rows if row.groups == ("o3/baseline",)]
    assert len(rows) == 6 + 4
    for row in rows:
        assert "no trial had a fallback: nothing differs" in row.note
        assert row.values["n"] == row.values["n_without"] == 110
        assert row.values.get("difference", 0) == 0
        assert row.values.get("differ") is None


def test_where_every_trial_had_a_fallback_nothing_is_left_and_the_row_says_so(tables):
    rows = [row for row in tables["fallbacks"].rows if row.groups == ("o3/A2",)]
    for row in rows:
        assert "every trial had a fallback: nothing is left without" in row.note
        assert (row.values["n"], row.values["n_without"]) == (55, 0)
        assert row.values.get("without") is None
        assert row.values.get("paper_without") is None


@pytest.fixture(scope="module")
def biased(tmp_path_factory):
    """Who is ahead goes first, but in the trials with a fallback the right one always does."""
    fair = [replace(drive, said={}) for drive in yielding("o3", reps=5)]
    right = [
        Drive(
            "o3", "baseline", drive.condition, 5 + drive.rep, (-1.0,) * 3, (1.0,) * 3, {2: FAILED}
        )
        for drive in fair
    ]
    crash = [
        Drive("o3", "baseline", "N_0_0", 10 + rep, (0.0,), (0.0,), {1: FAILED}) for rep in (1, 2, 3)
    ]
    path = tmp_path_factory.mktemp("biased") / "t.duckdb"
    return Study(write_study(path, [*fair, *right, *crash]))


def test_failures_that_bias_the_outcomes_are_seen(biased):
    (table,) = make_tables(biased, ["fallbacks"])
    row = row_of(table, "o3/baseline/collided_percent").values
    assert (row["n"], row["n_without"]) == (113, 55)
    assert (row["all"], row["without"]) == (pytest.approx(300 / 113), 0)
    assert row["difference"] == pytest.approx(-300 / 113)
    assert cell(table, "o3/baseline/left_first_percent", "difference") > 20
    verdict = row_of(table, "o3/baseline/I3").values
    assert verdict["differ"] == "≠"
    assert (verdict["paper"], verdict["paper_without"]) == (False, True)


def test_the_two_sides_of_a_measure_explain_their_own_trials(biased):
    (table,) = make_tables(biased, ["fallbacks"])
    for row in (f"o3/baseline/{name}" for name in ("collided_percent", "gap_m", "I1", "I4")):
        for side, other in (("", "all"), ("_without", "without")):
            found = explain(biased, table, f"{row}:n{side}").sources[0].trials
            assert len(found) == cell(table, row, f"n{side}")
            if not row.endswith(("I1", "I4")):
                assert explain(biased, table, f"{row}:{other}").sources[0].trials == found


@pytest.mark.slow
def test_only_failed_trials_leave_nothing_to_compare_and_say_why(tmp_path):
    lost = Said(("timeout", "timeout"), lost=True)
    drives = [replace(drive, said={0: lost}) for drive in yielding("o3", reps=1)]
    study = Study(write_study(tmp_path / "t.duckdb", drives))
    attempts, fallbacks = make_tables(study, ["attempts", "fallbacks"])
    values = row_of(attempts, "o3/baseline").values
    assert (values["failed"], values["lost"], values["calls"]) == (11, 11, 22)
    assert values["lost_percent"] == 50
    assert all("no trial ended" in row.note for row in fallbacks.rows)
    with duckdb.connect(str(study.db)) as connection:
        connection.execute("DELETE FROM decisions; DELETE FROM calls WHERE side = 'right'")
    (attempts,) = make_tables(Study(study.db), ["attempts"])
    row = row_of(attempts, "o3/baseline")
    assert row.values["lost_percent"] == 100
    assert row.note == "no call was answered, and no decision made"
