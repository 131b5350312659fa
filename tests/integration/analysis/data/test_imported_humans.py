"""What imported human trials are, beside the published counts, and how their rows are named."""

from __future__ import annotations

import re
from dataclasses import replace

import pandas as pd
import pytest

from merge_runner.records import StateRow, TrialRecord, TrialSpec
from merge_runner.results.store import Store
from merge_runner.scenarios.merge.conditions import CONDITIONS, HUMAN_CONDITIONS
from merge_runner_analysis.data.imported_humans import (
    by_condition,
    by_pair,
    findings,
    human_trials,
)
from merge_runner_analysis.data.load import load
from merge_runner_analysis.data.reference_data import PAIRS, human_outcomes
from merge_runner_analysis.data.study import Study, _humans
from merge_runner_analysis.explain import explain
from merge_runner_analysis.metrics import BOXES, COLLISIONS, LEFT_FIRST
from merge_runner_analysis.stats.measures import counts, known
from merge_runner_analysis.tables import make_tables
from tests.support.harness import PROJECT


def published_trials() -> pd.DataFrame:
    """The 990 published outcomes as trials of nine pairs."""
    pairs = [list(PAIRS.values())[i % 9] for i in range(990)]
    return human_outcomes().assign(pair=pairs, of_pages=False)


def changed(trials: pd.DataFrame, condition: str, before: tuple, after: tuple, n: int = 1):
    """Trials of which ``n`` of a condition came to another (status, merged first)."""
    first = trials["merged_first"].fillna("nobody")
    chosen = (trials["condition"] == condition) & (trials["status"] == before[0])
    chosen &= first == (before[1] or "nobody")
    rows = trials.index[chosen][:n]
    found = trials.copy()
    found.loc[rows, ["status", "merged_first"]] = after
    return found


LEFT, RIGHT, CRASH = ("finished", "left"), ("finished", "right"), ("collided", None)


def test_there_is_nothing_to_say_of_the_published_trials():
    assert list(findings(published_trials())) == []


def test_a_part_is_named_so_and_keeps_the_published_outcomes():
    (said,) = findings(published_trials()[::8])
    assert said.startswith("124 of 990 trials are imported; who merged first and collisions are ")


def test_more_of_an_outcome_than_is_published_is_another_data_set():
    more = changed(published_trials(), "N_0_0", LEFT, CRASH, 8)
    (said,) = findings(more)
    assert said == "another data set than the published one: more of an outcome in N_0_0"


def test_a_swapped_outcome_is_found():
    (said,) = findings(changed(published_trials(), "R_0_8", LEFT, RIGHT))
    assert said.endswith("more of an outcome in R_0_8")


def test_trials_of_other_pairs_are_counted_for_nothing():
    trials = published_trials()
    moved = trials.assign(pair=trials["pair"].mask(trials.index == 0, "experiment_7"))
    (said,) = findings(moved)
    assert said.startswith("989 of 990 trials")
    assert by_condition(moved)["trials"].sum() == 989
    assert by_pair(moved)["trials"]["experiment_7"] == 1


def test_trials_of_other_pairs_alone_are_another_data_set_however_many():
    (said,) = findings(published_trials().assign(pair="experiment_7"))
    assert said == "another data set than the published one"


def test_the_docs_say_how_the_row_of_another_data_set_reads():
    text = (PROJECT / "docs/reference/analysis.md").read_text(encoding="utf-8")
    (said,) = re.findall(r"\*\*Another data set\*\*.*?\n- ", text, re.DOTALL)
    label = _humans(changed(published_trials()[:129], "N_0_0", LEFT, CRASH, 1)).label
    assert f"reads `{label}`" in said


@pytest.fixture
def stored(tmp_path):
    """Writes human trials, and a trial of a model, into a database."""

    def write(trials: pd.DataFrame):
        records = []
        for number, row in enumerate(trials.itertuples()):
            first = row.merged_first if isinstance(row.merged_first, str) else None
            spec = TrialSpec(
                f"human/{number}", "h", "human", "human", "human", None, row.condition, number,
                0, 0, pair=row.pair, kinematics=HUMAN_CONDITIONS[row.condition],
            )  # fmt: skip
            states = tuple(
                StateRow(0, 0.0, side, at_m, 10.0, 0.0)
                for side, at_m in (("left", 50), ("right", 60))
            )
            records.append(TrialRecord(spec, row.status, first, 5.0, None, states, ()))
        path = tmp_path / "merge.duckdb"
        model = replace(spec, trial_id="o3/1", source="llm", variant="baseline", pair=None)
        Store(path).add_recorded([*records, replace(records[-1], spec=model)], {})
        return path

    return write


def test_the_trials_of_a_database_are_counted(stored):
    trials = human_trials(stored(published_trials()))
    assert list(findings(trials)) == []
    assert list(by_condition(trials).index) == list(CONDITIONS)
    assert (by_condition(trials)["trials"] == 90).all()
    assert dict(by_pair(trials)["trials"]) == dict.fromkeys(PAIRS.values(), 110)
    assert by_condition(trials)["collided"].sum() == 28


def test_a_complete_import_leads_to_the_trials_behind_the_published_outcomes(stored):
    study = Study(stored(published_trials()))
    assert (study.human.label, study.human.traced, study.complete) == ("human", True, True)
    assert counts(study.human, BOXES) == (28, 990)
    assert not known(study.human, COLLISIONS)


def test_a_partial_import_has_both_numbers_of_trials_in_its_row(stored):
    study = Study(stored(published_trials()[::8]))
    human = study.human
    assert counts(human, BOXES) == (28, 990)
    assert counts(human, LEFT_FIRST)[1] == 962
    assert not known(human, COLLISIONS)
    (table,) = make_tables(study, ["ablation-quantitative"])
    row = next(row for row in table.rows if row.id == "human")
    assert row.values["driver"] == "humans (124 of 990 imported)"
    assert row.values["n"] == 990
    assert row.values.get("collided_percent") is None
    finished = len(human.finished)
    assert f"the 990 published outcomes; the rest: 124 imported trials, {finished}" in row.note
    assert "published human collisions are boxes that overlap" in row.note


@pytest.mark.slow
def test_another_data_set_is_named_under_every_table_with_humans(stored):
    more = changed(published_trials(), "N_0_0", LEFT, CRASH, 8)
    study = Study(stored(more))
    for table in make_tables(study, ["who-first", "ablation-quantitative"]):
        assert any("more of an outcome in N_0_0" in note for note in table.notes), table.name


def test_trials_of_other_pairs_are_in_no_row_and_in_no_query(stored):
    trials = published_trials()
    moved = trials.assign(pair=trials["pair"].mask(trials.index < 5, "experiment_7"))
    study = Study(stored(moved))
    assert len(study.human.trials) == 985
    (source,) = explain(study, make_tables(study, ["who-first"])[0], "human/intercept").sources
    trials = load(source.query, study.db)["trial_id"]
    assert trials.tolist() == list(source.trials)
    assert len(trials) == len(study.human.finished)
