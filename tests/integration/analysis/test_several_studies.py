"""Several studies in one database: each can be read alone, and nothing is tested across them.

The driver is a program whose trials depend on the slot alone, so that no prompt changes anything.
"""

import json
import re

import pytest

from merge_runner.errors import UsageError
from merge_runner_analysis.explain import explain
from merge_runner_analysis.frames import load
from merge_runner_analysis.selection import Selection
from merge_runner_analysis.study import StudyResults
from merge_runner_analysis.web.report import design
from tests.support.studies import changed
from tests.support.tables import by_id, made, notes_with, values_of

MOOD = """
description = "Does the mood matter?"
models = ["human-odds"]
repetitions = 4
conditions = ["L_4_0", "R_-4_0"]
[factors]
prompt = ["baseline", "A1"]
"""
# Of the same name, in another folder.
OTHER_MOOD = MOOD.replace("Does", "Why does").replace(
    '["baseline", "A1"]', '["A1"]\nmemory_s = [1.0, 2.0]'
)


@pytest.fixture(scope="module")
def folder(prepare, tmp_path_factory):
    """The database of a sweep in all conditions, and of two studies of one name in two of them."""
    folder = tmp_path_factory.mktemp("several")
    (folder / "other").mkdir()
    (folder / "mood.toml").write_text(MOOD)
    (folder / "other/mood.toml").write_text(OTHER_MOOD)
    for study in ("baseline", "mood.toml", "other/mood.toml"):
        sweep = ("sweep", study, "--model", "human-odds", "--reps", 4, "--db", "t.duckdb")
        assert prepare(folder, *sweep).code == 0
    return folder


@pytest.fixture(scope="module")
def db(folder):
    return folder / "t.duckdb"


@pytest.fixture
def copy(db, tmp_path):
    (tmp_path / "t.duckdb").write_bytes(db.read_bytes())
    return tmp_path / "t.duckdb"


def test_a_study_that_is_named_is_shown_by_its_own_trials_alone(db, folder):
    study = StudyResults(db, Selection(file=str(folder / "mood.toml")))
    table = made(study, "factors")
    rows = by_id(table)
    assert rows["prompt=baseline/left_first_percent"].values["trials"] == 8
    for metric in ("left_first_percent", "collided_percent"):
        row = rows[f"prompt=A1/{metric}"]
        assert [row.values.get(n) for n in ("trials", "difference", "p")] == [8, None, None]
        assert "not tested: the same trials at both levels" in row.note
    assert "memory_s" not in {row.values["factor"] for row in table.rows}
    assert not notes_with(table, "several studies")
    (source,) = explain(study, table, "prompt=baseline/left_first_percent:trials").sources
    assert len(source.trials) == 8
    assert load(source.query, db)["trial_id"].tolist() == list(source.trials)
    assert design(study)[0] == ["Does the mood matter?"]


def test_without_a_choice_tables_say_what_they_pool_and_test_nothing_across_studies(db):
    study = StudyResults(db)
    table = made(study, "factors")
    rows = {name: row.values for name, row in by_id(table).items()}
    level = rows["prompt=A1/left_first_percent"]
    assert rows["prompt=baseline/left_first_percent"]["trials"] == 44
    assert level["trials"] == 8, "three times the same 8 trials"
    assert {level.get(name) for name in ("difference", "difference_ci", "p", "p_holm")} == {None}
    (note,) = notes_with(table, "trials of several studies")
    for named in ("baseline (44 trials)", "mood (16 trials)", "mood (memory_s) (16 trials)"):
        assert named in note
    assert not any("/A1/baseline/" in name for name in by_id(made(study, "contrasts")))


def test_a_trial_may_have_factors_of_another_study_beside_its_own(copy, prepare, tmp_path):
    changed(
        copy,
        "INSERT INTO trial_factors SELECT trial_id, spec_hash, 'weather', 'rain', false "
        "FROM trials",
    )
    prepare(tmp_path, "audit", "--db", copy, code=0)


def test_two_studies_are_pooled_with_a_note_too(copy):
    newest = "WHERE sweep_id = (SELECT max_by(sweep_id, started_at) FROM sweeps)"
    study = changed(copy, f"DELETE FROM sweep_trials {newest}", f"DELETE FROM sweeps {newest}")
    (note,) = notes_with(made(study, "factors"), "trials of several studies")
    assert all(named in note for named in ("baseline (44 trials)", "mood (16 trials)"))


def test_a_second_study_changes_no_reference(copy):
    levels = {"perception": ["perfect", "foggy"], "prompt": ["A1"], "model": ["human-odds"]}
    study = changed(
        copy,
        "INSERT INTO trial_factors SELECT trial_id, spec_hash, 'perception', "
        "if(rep % 2 = 0, 'foggy', 'perfect'), false FROM trials",
        f"UPDATE sweeps SET config = json_merge_patch(config, '{json.dumps({'levels': levels})}') "
        "WHERE started_at = (SELECT max(started_at) FROM sweeps)",
    )
    shown = [n for n in values_of(study, "factors") if re.match("perception=.*/gap_m", n)]
    assert shown == ["perception=perfect/gap_m", "perception=foggy/gap_m"]
    assert study.reference == "baseline", "a study of one prompt lists it first, and says nothing"


def test_a_study_that_was_not_played_is_named_beside_those_that_were(db):
    with pytest.raises(UsageError, match="no trial of the study ablations; its studies: "):
        StudyResults(db, Selection(file="ablations"))


def test_a_run_of_the_same_study_is_no_other_study(copy, prepare, tmp_path):
    (tmp_path / "mood.toml").write_text(MOOD.replace('"A1"]', '"A1", "A2"]'))
    sweep = ("sweep", "mood.toml", "--only", "prompt=A2", "--db", copy)
    assert prepare(tmp_path, *sweep).code == 0
    known = values_of(StudyResults(copy, Selection(file=str(tmp_path / "mood.toml"))), "factors")
    assert [known[f"prompt={name}/gap_m"]["trials"] for name in ("baseline", "A1", "A2")] == [8] * 3


def test_trials_of_no_sweep_are_of_no_study(copy):
    table = made(changed(copy, "DELETE FROM sweep_trials", "DELETE FROM sweeps"), "factors")
    assert by_id(table)["prompt=A1/left_first_percent"].values["trials"] == 8
    assert not notes_with(table, "several studies")
