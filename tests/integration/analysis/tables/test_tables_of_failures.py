"""What became of the calls, and the tables without trials that had a fallback."""

import json
from collections import Counter
from dataclasses import replace

import pytest

from merge_runner_analysis.explain import explain
from merge_runner_analysis.frames import load
from merge_runner_analysis.provenance import tally
from merge_runner_analysis.selection import Selection
from merge_runner_analysis.study import StudyResults
from tests.support.studies import Drive, Said, changed, write_study, yielding
from tests.support.tables import by_id, made, notes_with, values_of

FAILED = Said(failure="no_array")


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


@pytest.mark.parametrize(
    ("row", "column", "trials"),
    [
        ("o3/A1", "retried", [f"o3/A1/R_-4_0/rep0{i}" for i in (2, 3, 4)]),
        ("o3/A1", "refused_percent", ["o3/A1/R_-4_-8/rep01"]),
        ("o3/A1", "wrong_length", ["o3/A1/R_-4_-8/rep05"]),
        ("other/baseline", "failed", ["other/baseline/R_-4_-8/rep01"]),
        ("other/baseline", "lost_percent", ["other/baseline/R_-4_-8/rep01"]),
    ],
)
def test_a_count_leads_to_the_trials_that_it_was_in(study, tables, row, column, trials):
    found = explain(study, tables["attempts"], f"{row}:{column}")
    assert [list(source.numerator) for source in found.sources] == [trials]


def test_a_missing_decision_has_a_count_of_its_own_and_is_not_invalid(tmp_path):
    """Its plan is driven: no rate of failure has it."""
    missing = dict.fromkeys(range(3), Said(failure="no_decision"))
    drives = [
        replace(drive, said=missing if n < 2 else {0: FAILED} if n == 2 else {})
        for n, drive in enumerate(yielding("o3", reps=1))
    ]
    study = StudyResults(write_study(tmp_path / "t.duckdb", drives))
    table = made(study, "attempts")
    row = by_id(table)["o3/baseline"].values
    counts = {"no_decision": 6, "invalid": 1, "no_array": 1, "fallback": 1}
    assert {name: row[name] for name in counts} == counts
    assert row["no_decision_percent"] == 100 * 6 / row["calls"]
    for column, trials in (("no_decision", 2), ("invalid", 1), ("fallback", 1)):
        (source,) = explain(study, table, f"o3/baseline:{column}").sources
        assert len(source.numerator) == trials, column
    without = StudyResults(study.db, Selection(without_fallbacks=True))
    assert len(without.models[0].trials) == len(drives) - 1
    # One id may stand under several specs: the copy without the fallback stays.
    changed(
        study.db,
        *(
            f"INSERT INTO {name} SELECT * REPLACE ('other' AS spec_hash) FROM {name}"
            for name in ("trials", "states")
        ),
    )
    kept = StudyResults(study.db, Selection(without_fallbacks=True)).models
    assert sorted(len(group.trials) for group in kept) == [len(drives) - 1, len(drives)]


@pytest.fixture(scope="module")
def biased(tmp_path_factory):
    """Who is ahead goes first, but in the trials with a fallback the right one always does."""
    fair = [replace(drive, said={}) for drive in yielding("o3", reps=5)]
    right = [
        Drive("o3", "baseline", d.condition, 5 + d.rep, (-1.0,) * 3, (1.0,) * 3, {2: FAILED})
        for d in fair
    ]
    crash = [
        Drive("o3", "baseline", "N_0_0", 10 + rep, (0.0,), (0.0,), {1: FAILED}) for rep in (1, 2, 3)
    ]
    return write_study(tmp_path_factory.mktemp("biased") / "t.duckdb", [*fair, *right, *crash])


def test_failures_that_bias_the_outcomes_are_seen_without_them(biased):
    values = {}
    for without in (False, True):
        study = StudyResults(biased, Selection(without_fallbacks=without))
        indicators = made(study, "indicators")
        rows = by_id(indicators)
        collided = rows["o3/baseline/collided_percent"].values
        verdict = rows["o3/baseline/I3"].values["paper"]
        values[without] = (collided["n"], collided["value"], verdict)
        assert values_of(study, "attempts")["o3/baseline"]["trials"] == collided["n"]
        assert bool(notes_with(indicators, "--without-fallbacks")) == without
    assert values == {False: (113, pytest.approx(300 / 113), False), True: (55, 0, True)}
    (source,) = explain(study, indicators, "o3/baseline/collided_percent:n").sources
    assert len(source.trials) == len(load(source.query, biased)) == 55


def test_a_driver_whose_every_trial_had_a_fallback_has_a_row_that_says_so(study):
    kept = StudyResults(study.db, Selection(without_fallbacks=True))
    sizes = {group.id: len(group.trials) for group in kept.models}
    assert sizes == {"o3/baseline": 110, "o3/A1": 49, "other/baseline": 44}
    assert [group.id for group in kept.unjudged] == ["o3/A2"]
    assert by_id(made(kept, "ablation-quantitative"))["o3/A2"].note == "every trial had a fallback"


def test_the_option_is_that_of_the_tables_and_kept_apart(biased, prepare, tmp_path):
    for option, n in ((("--without-fallbacks",), 55), ((), 113)):
        shown = prepare(tmp_path, "tables", "attempts", "--db", biased, "--format", "json", *option)
        (table,) = json.loads(shown.out)["tables"]
        assert [row["trials"] for row in table["rows"]] == [n]


def test_only_failed_trials_leave_nothing_to_compare_and_say_why(tmp_path):
    lost = Said(("timeout", "timeout"), lost=True)
    drives = [replace(drive, said={0: lost}) for drive in yielding("o3", reps=1)]
    study = StudyResults(write_study(tmp_path / "t.duckdb", drives))
    row = values_of(study, "attempts")["o3/baseline"]
    assert (row["failed"], row["lost"], row["calls"], row["lost_percent"]) == (11, 11, 22, 50)
    study = changed(study.db, "DELETE FROM decisions; DELETE FROM calls WHERE side = 'right'")
    row = by_id(made(study, "attempts"))["o3/baseline"]
    assert row.values["lost_percent"] == 100
    assert row.note == "no call was answered; no decision is stored"
