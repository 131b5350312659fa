"""Who stands in which group: endpoints, mock models, and deterministic drivers."""

import json
from dataclasses import replace

import pytest

from merge_runner_analysis.explain import explain
from merge_runner_analysis.frames import load
from merge_runner_analysis.selection import Selection
from merge_runner_analysis.study import StudyResults
from merge_runner_analysis.tables import make_tables
from merge_runner_analysis.tables.formats import value_rows
from tests.support.studies import changed, write_study, yielding
from tests.support.tables import QUICK, alarms_of, by_id, made, notes_with

SCRIPTED = "UPDATE trials SET scripted = true WHERE "


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Three repetitions of two drivers."""
    drives = [*yielding("o3", reps=3), *yielding("other", reps=3)]
    return write_study(tmp_path_factory.mktemp("groups") / "t.duckdb", drives)


@pytest.fixture
def db(written, tmp_path):
    (tmp_path / "t.duckdb").write_bytes(written.read_bytes())
    return tmp_path / "t.duckdb"


def listed(study, table, cell):
    """How many trials explain lists, and its query finds."""
    (source,) = explain(study, table, cell).sources
    assert load(source.query, study.db)["trial_id"].tolist() == list(source.trials)
    return len(source.trials)


def test_a_driver_is_named_by_its_endpoint_unless_that_is_the_providers_own(tmp_path):
    urls = {"o3": "openai", "a": "http://localhost:8080/v1", "b": "https://gateway.example"}
    drives = [yielding(name, reps=1)[0] for name in urls]
    db = write_study(tmp_path / "t.duckdb", drives)
    for name, url in urls.items():
        asked = {"endpoint": url, "body": {"model": name}}
        spec = json.dumps({"left": asked, "right": asked})
        changed(db, f"UPDATE specs SET spec = '{spec}' WHERE spec_hash = '{name}-baseline'")
    names = {group.driver for group in StudyResults(db).models}
    assert names == {"o3", "a at localhost:8080", "b at gateway.example"}
    (chosen,) = StudyResults(db, Selection(["a at localhost:8080"])).models
    assert chosen.id == "a at localhost:8080/baseline"


def test_who_was_asked_is_read_from_the_columns_and_not_from_a_trials_name(db):
    study = changed(
        db,
        *(
            f"UPDATE {table} SET trial_id = 'again/' || trial_id"
            for table in ("trials", "decisions", "states")
        ),
        "UPDATE trials SET model_right = 'other'",
        SCRIPTED + "model_left = 'o3'",
        """INSERT INTO specs VALUES ('of no trial', '{"scenario": {"odd": 1}}')""",
    )
    assert [(group.driver, group.models) for group in study.models] == [
        ("other", ("other",)),
        ("o3+other", ("o3", "other")),
    ]
    assert study.models[1].posing == "mock model, not o3+other"


def test_stand_ins_stand_last_and_every_row_of_theirs_says_so(db):
    study = changed(db, SCRIPTED + "trial_id LIKE 'o3/%'")
    assert [group.label for group in study.models] == ["other", "o3 (mock model, not o3)"]
    for table in make_tables(study, QUICK):
        for row, plain in zip(table.rows, value_rows(table), strict=True):
            if row.groups[0].startswith("o3/"):
                assert plain["driver"] in {"o3*", "o3*, of 2 models"}, table.name
        if any(row.groups[0].startswith("o3/") for row in table.rows):
            assert table.notes.count("* o3: mock model, not o3") == 1, table.name


def test_a_mock_model_is_a_stand_in_for_no_model(tmp_path):
    drives = [yielding(name, reps=1)[0] for name in ("emulator", "random")]
    study = changed(write_study(tmp_path / "t.duckdb", drives), SCRIPTED + "true")
    assert {group.label for group in study.models} == {
        "emulator (mock model, no language model)",
        "random (mock model, no language model)",
    }
    assert alarms_of(study) == {}, "nobody takes it for a model"


def test_the_sides_of_a_stand_in_are_those_of_the_scripted_calls(tmp_path):
    drives = [replace(yielding("o3", reps=1)[0], said={})]
    scripted = "UPDATE calls SET scripted = true WHERE side = 'left'"
    study = changed(write_study(tmp_path / "t.duckdb", drives), scripted, SCRIPTED + "true")
    assert study.models[0].label == "o3 (mock model on the left, not o3)"


def test_trials_of_a_stand_in_are_never_pooled_with_those_of_the_model(db):
    study = changed(db, SCRIPTED + "trial_id LIKE 'o3/%/rep01'")
    sizes = {group.driver: len(group.trials) for group in study.models}
    assert sizes == {"o3": 22, "other": 33, "o3 [scripted]": 11}
    ((title, text),) = alarms_of(study).items()
    assert title == "A mock model answered"
    assert "o3 [scripted]/baseline: mock model, not o3" in text
    table = made(study, "ablation-quantitative")
    for row, trials in (("o3/baseline", 22), ("o3 [scripted]/baseline", 11)):
        assert listed(study, table, f"{row}:n") == trials


def same_each_time(who="trial_id LIKE 'o3/%'"):
    """Statements after which later repetitions are the first again."""
    return [
        f"DELETE FROM states WHERE {who} AND trial_id NOT LIKE '%rep01'",
        "INSERT INTO states SELECT replace(trial_id, 'rep01', rep) AS trial_id, "
        "states.* EXCLUDE (trial_id) FROM states, (VALUES ('rep02'), ('rep03')) AS reps (rep) "
        f"WHERE {who} AND trial_id LIKE '%rep01'",
        *(
            f"UPDATE trials SET {column} = (SELECT {column} FROM trials AS one "
            "WHERE one.trial_id = left(trials.trial_id, -2) || '01') WHERE " + who
            for column in ("status", "merged_first", "end_time_s")
        ),
    ]


def as_programs(chance, **scenario):
    """Statements after which o3 is two programs, ``b`` of which declares its ``chance``."""
    drivers = {"left": {"program": "a"}, "right": {"program": "b"} | chance}
    spec = json.dumps(drivers | {"scenario": scenario})
    return [
        f"UPDATE specs SET spec = '{spec}' WHERE spec_hash = 'o3-baseline'",
        "UPDATE trials SET source = 'driver' WHERE trial_id LIKE 'o3/%'",
    ]


def test_equal_trials_of_programs_count_once(db):
    study = changed(db, *same_each_time(), *as_programs({}))
    o3, other = study.models
    assert (len(o3.trials), o3.repeated, len(other.trials), other.repeated) == (11, 22, 33, 0)
    table = made(study, "ablation-quantitative")
    assert by_id(table)["o3/baseline"].values["n"] == 11
    assert listed(study, table, "o3/baseline:n") == 11
    assert notes_with(table, ": 22 of 33 trials of programs repeat an earlier one")
    ((title, text),) = alarms_of(study).items()
    assert title == "Trials repeat earlier ones"
    assert "o3/baseline: 22 of 33 trials of programs are as an earlier one to the last" in text
    accounts = made(study, "attempts")
    assert accounts.rows[0].values["trials"] == 33, "nothing is dropped from accounts"
    assert listed(study, accounts, "o3/baseline:trials") == 33


@pytest.mark.parametrize(
    ("chance", "scenario"),
    [
        ({"chance": True}, {}),
        ({}, {"perception_right": {"speed_sd_mps": 0.5}}),
        ({}, {"perception_left": {"delay_s": 0.2, "range_m": 30}}),
    ],
)
def test_only_equal_trials_of_programs_are_left_out_whatever_is_declared(db, chance, scenario):
    alike = "trial_id LIKE 'o3/%' AND trial_id NOT LIKE 'o3/baseline/N_0_0/%'"
    study = changed(db, *same_each_time(alike), *as_programs(chance, **scenario))
    assert (len(study.models[0].trials), study.models[0].repeated) == (13, 20)
    assert {*alarms_of(study)} == {"Trials repeat earlier ones"}


def test_equal_trials_of_a_language_model_are_told_and_count(db):
    study = changed(db, *same_each_time("trial_id LIKE 'o3/baseline/N_0_0/%'"))
    assert study.models[0].repeated == 0
    ((title, text),) = alarms_of(study).items()
    assert title == "Trials repeat earlier ones"
    says = "o3/baseline: 2 of 33 trials are as an earlier one to the last state; each counts"
    assert says in text


@pytest.mark.parametrize("newest", ["o3-A1", "o3-edited"])
def test_an_edited_prompt_is_compared_and_the_trials_of_its_former_text_are_named(tmp_path, newest):
    """Both texts of A1 have as many trials, so that the newer one has no mark."""
    drives = [*yielding("o3", reps=2), *yielding("o3", "A1", reps=2)]
    db = write_study(tmp_path / "t.duckdb", drives)
    study = changed(
        db,
        "INSERT INTO specs SELECT 'o3-edited', json_merge_patch(spec, "
        '\'{"prompt_blocks": {"C3": "edited"}}\') FROM specs WHERE spec_hash = \'o3-A1\'',
        *(
            f"UPDATE {name} SET spec_hash = 'o3-edited' WHERE spec_hash = 'o3-A1' "
            "AND trial_id LIKE '%rep02%'"
            for name in ("states", "decisions", "trial_factors", "calls", "sweep_trials", "trials")
        ),
        "INSERT INTO sweeps BY NAME SELECT 'later' AS sweep_id, name, started_at + INTERVAL 1 DAY "
        "AS started_at, config, versions FROM sweeps",
        f"UPDATE sweep_trials SET sweep_id = 'later' WHERE spec_hash = '{newest}'",
    )
    (unmarked,) = (g for g in study.models if g.setting == "A1" and not g.mark)
    assert unmarked.spec_hash == newest
    levels = made(study, "levels")
    (note,) = notes_with(levels, "another text or setting under the same name")
    assert note.startswith(f"o3 [{({'o3-A1', 'o3-edited'} - {newest}).pop()[:8]}")
    assert by_id(levels)["prompt=A1"].values["ended"] == 22
    assert notes_with(made(study, "verdicts"), "under the same name") == []
