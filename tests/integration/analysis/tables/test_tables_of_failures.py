"""What became of the calls, and the tables without trials that had a fallback."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import replace

import duckdb
import pytest

from merge_runner_analysis.data.load import load
from merge_runner_analysis.data.provenance import tally
from merge_runner_analysis.data.study import Study
from merge_runner_analysis.explain import explain
from merge_runner_analysis.tables import make_tables
from tests.support.studies import Drive, Said, write_study, yielding

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
        assert found["attempts"] == len(rows) == found["calls"] + found["retried"]
        assert found["calls"] == fates["driven"] + fates["fallback"] + fates["lost"]
        assert (found["retried"], found["lost"]) == (fates["retried"], fates["lost"])
        assert found["invalid"] == fates["fallback"] == found["fallback"]
        assert found["unknown"] == (rows["outcome"] == "unknown").sum()
        assert found["decisions"] == found["answers"]


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
    assert [list(source.numerator) for source in found.sources] == [[f"o3/A1/{t}" for t in trials]]


def test_a_lost_call_leads_to_its_failed_trial(study, tables):
    for column in ("failed", "lost", "lost_percent"):
        found = explain(study, tables["attempts"], f"other/baseline:{column}")
        assert [source.numerator for source in found.sources] == [("other/baseline/R_-4_-8/rep01",)]


def test_a_driver_that_asks_no_model_has_no_rate_but_a_reason(small):
    (table,) = make_tables(small, ["attempts"])
    row = row_of(table, "o3/baseline")
    assert (row.values["calls"], row.values["attempts"]) == (0, 0)
    assert row.values["retried_percent"] is None
    assert "no call" in row.note
    assert row.values["fallback_percent"] == 0


def test_a_missing_decision_has_a_count_of_its_own_and_is_not_invalid(tmp_path):
    """Its plan is driven: no rate of failure has it."""
    missing = dict.fromkeys(range(3), Said(failure="no_decision"))
    drives = [
        replace(drive, said=missing if n < 2 else {0: FAILED} if n == 2 else {})
        for n, drive in enumerate(yielding("o3", reps=1))
    ]
    study = Study(write_study(tmp_path / "t.duckdb", drives))
    (table,) = make_tables(study, ["attempts"])
    row = row_of(table, "o3/baseline")
    counts = {"no_decision": 6, "invalid": 1, "no_array": 1, "fallback": 1}
    assert {name: row.values[name] for name in counts} == counts
    assert row.values["no_decision_percent"] == 100 * 6 / row.values["calls"]
    for column, trials in (("no_decision", 2), ("invalid", 1), ("fallback", 1)):
        (source,) = explain(study, table, f"o3/baseline:{column}").sources
        assert len(source.numerator) == trials, column
    without = Study(study.db, without_fallbacks=True)
    assert len(without.models[0].trials) == len(drives) - 1


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
    return write_study(path, [*fair, *right, *crash])


def test_failures_that_bias_the_outcomes_are_seen_without_them(biased):
    names = ["indicators", "attempts"]
    values = {}
    for without in (False, True):
        study = Study(biased, without_fallbacks=without)
        indicators, attempts = make_tables(study, names)
        collided = row_of(indicators, "o3/baseline/collided_percent").values
        verdict = row_of(indicators, "o3/baseline/I3").values["paper"]
        values[without] = (collided["n"], collided["value"], verdict)
        assert row_of(attempts, "o3/baseline").values["trials"] == collided["n"]
        said = any("--without-fallbacks" in note for note in indicators.notes)
        assert said == without
    assert values == {False: (113, pytest.approx(300 / 113), False), True: (55, 0, True)}
    (source,) = explain(study, indicators, "o3/baseline/collided_percent:n").sources
    assert len(source.trials) == len(load(source.query, biased)) == 55


def test_a_driver_whose_every_trial_had_a_fallback_has_a_row_that_says_so(study):
    kept = Study(study.db, without_fallbacks=True)
    sizes = {group.id: len(group.trials) for group in kept.models}
    assert sizes == {"o3/baseline": 110, "o3/A1": 49, "other/baseline": 44}
    (table,) = make_tables(kept, ["ablation-quantitative"])
    assert row_of(table, "o3/A2").note == "every trial had a fallback"
    (kept_away,) = (group for group in kept.unjudged)
    assert kept_away.id == "o3/A2"


def test_the_option_is_that_of_the_tables_and_kept_apart(biased, in_process, capsys):
    for option, n in (((), "113"), (("--without-fallbacks",), "55"), ((), "113")):
        csv = ("--db", biased, "--format", "csv", *option)
        assert in_process("tables", "indicators", *csv) == 0
        shown = capsys.readouterr().out
        assert re.search(rf"^o3/baseline/collided_percent,.*,{n},[^,]*$", shown, re.MULTILINE)


@pytest.mark.slow
def test_only_failed_trials_leave_nothing_to_compare_and_say_why(tmp_path):
    lost = Said(("timeout", "timeout"), lost=True)
    drives = [replace(drive, said={0: lost}) for drive in yielding("o3", reps=1)]
    study = Study(write_study(tmp_path / "t.duckdb", drives))
    (attempts,) = make_tables(study, ["attempts"])
    values = row_of(attempts, "o3/baseline").values
    assert (values["failed"], values["lost"], values["calls"]) == (11, 11, 22)
    assert values["lost_percent"] == 50
    with duckdb.connect(str(study.db)) as connection:
        connection.execute("DELETE FROM decisions; DELETE FROM calls WHERE side = 'right'")
    (attempts,) = make_tables(Study(study.db), ["attempts"])
    row = row_of(attempts, "o3/baseline")
    assert row.values["lost_percent"] == 100
    assert row.note == "no call was answered; no decision is stored"
