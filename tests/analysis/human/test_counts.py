"""The comparison with the published counts."""

from __future__ import annotations

from dataclasses import replace

import pandas as pd
import pytest

from analysis.human.counts import COUNTS, by_condition, by_pair, findings, human_counts
from analysis.human.record import PAIRS
from analysis.published import human_outcomes, published
from merge_runner.records import StateRow, TrialRecord, TrialSpec
from merge_runner.simulator.conditions import CONDITIONS
from merge_runner.store import Store


def counted(*, without=(), changes=()) -> pd.DataFrame:
    """The published counts, all of the first pair, as rows of human_counts."""
    counts = published("human_outcomes").assign(pair="pair1")
    counts["trials"] = counts[COUNTS[1:]].sum(axis=1)
    for condition, outcome, change in changes:
        counts.loc[counts["condition"] == condition, outcome] += change
    return counts[~counts["condition"].isin(without)][["pair", "condition", *COUNTS]]


def test_the_published_counts_agree_with_themselves():
    assert list(findings(counted())) == []


def test_cells_that_differ_are_named():
    swapped = [("R_0_8", "left_first", -1), ("R_0_8", "right_first", 1)]
    assert list(findings(counted(changes=swapped))) == [
        "the outcomes differ from the published ones: "
        "R_0_8 left first 7 instead of 8, R_0_8 right first 79 instead of 78"
    ]
    assert list(findings(counted(changes=[("N_0_0", "collided", 1)]))) == [
        "the outcomes differ from the published ones: N_0_0 collided 6 instead of 5"
    ]


def test_a_whole_condition_is_compared_also_where_others_are_missing():
    some = counted(without=("N_0_0",), changes=[("L_4_0", "left_first", -1)])
    assert list(findings(some)) == [
        "900 of 990 trials: the human rows of the tables come from these",
        "the outcomes differ from the published ones: L_4_0 left first 87 instead of 88",
    ]


def test_a_part_of_a_condition_is_not_compared():
    some = counted(changes=[("L_4_0", "left_first", -1), ("L_4_0", "trials", -1)])
    assert list(findings(some)) == [
        "989 of 990 trials: the human rows of the tables come from these"
    ]


def test_990_trials_are_compared_whatever_conditions_they_are_of():
    moved = [("L_4_0", "trials", -1), ("L_4_8", "trials", 1)]
    moved += [("L_4_0", "left_first", -1), ("L_4_8", "left_first", 1)]
    assert list(findings(counted(changes=moved))) == [
        "the outcomes differ from the published ones: "
        "L_4_0 left first 87 instead of 88, L_4_8 left first 69 instead of 68"
    ]


def test_experiments_beside_the_published_pairs_are_named_and_not_compared():
    counts = counted()
    other = counts.iloc[:1].assign(pair="experiment_7")
    both = pd.concat([counts, other])
    assert list(findings(both)) == [
        "experiment_7: not of the nine published pairs, but in the tables too"
    ]
    assert by_condition(both)["trials"].sum() == 990
    assert dict(by_pair(both)["trials"]) == {"experiment_7": 90, "pair1": 990}


@pytest.fixture
def db(tmp_path):
    """The 990 published outcomes as trials of nine pairs, and a trial of a model."""
    pairs = list(PAIRS.values())
    records = []
    for number, row in enumerate(human_outcomes().itertuples()):
        first = row.merged_first if isinstance(row.merged_first, str) else None
        spec = TrialSpec(
            f"human/{number}", "h", "human", "human", "human", None, row.condition, number, 0, 0,
            pair=pairs[number % 9],
        )  # fmt: skip
        state = StateRow(0, 0.0, "left", 50.0, 10.0, 0.0)
        records.append(TrialRecord(spec, row.status, first, 5.0, None, (state,), ()))
    path = tmp_path / "merge.duckdb"
    spec = replace(spec, trial_id="o3/1", source="llm", variant="baseline", pair=None)
    Store(path).add_recorded([*records, replace(records[-1], spec=spec)], {})
    return path


def test_the_trials_of_a_database_are_counted(db):
    counts = human_counts(db)
    assert list(findings(counts)) == []
    assert list(by_condition(counts).index) == list(CONDITIONS)
    assert (by_condition(counts)["trials"] == 90).all()
    assert dict(by_pair(counts)["trials"]) == dict.fromkeys(PAIRS.values(), 110)
    assert by_condition(counts)["collided"].sum() == 28
