"""Who stands in which group: endpoints, stand-ins, and deterministic drivers."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from merge_runner.config import both_sides
from merge_runner_analysis.data.driver_words import stand_in
from merge_runner_analysis.data.load import load
from merge_runner_analysis.data.provenance import provenance
from merge_runner_analysis.data.study import Study
from merge_runner_analysis.explain import explain
from merge_runner_analysis.explorer.pages.sweep import list_runs
from merge_runner_analysis.explorer.site import Site
from merge_runner_analysis.report.page import alarms
from merge_runner_analysis.tables import make_tables
from merge_runner_analysis.tables.formats import value_rows
from tests.support.studies import changed, write_study, yielding


@pytest.fixture
def db(tmp_path):
    """Three repetitions of two drivers."""
    drives = [*yielding("o3", reps=3), *yielding("other", reps=3)]
    return write_study(tmp_path / "t.duckdb", drives)


def endpoint(url):
    """A statement that asks o3 there."""
    driver = {"endpoint": url, "body": {"model": "o3"}}
    spec = json.dumps({"left": driver, "right": driver})
    return f"UPDATE specs SET spec = '{spec}' WHERE spec_hash = 'o3-baseline'"


@pytest.mark.parametrize(
    ("url", "name"),
    [
        ("openai", "o3"),
        ("http://localhost:8080/v1", "o3 at localhost:8080"),
        ("https://gateway.example", "o3 at gateway.example"),
    ],
)
def test_a_driver_is_named_by_its_endpoint_unless_that_is_the_providers_own(db, url, name):
    study = changed(db, endpoint(url))
    assert [group.driver for group in study.models] == [name, "other"]
    assert [group.id for group in Study(db, [name]).models] == [f"{name}/baseline"]


def test_who_was_asked_is_read_from_the_columns_and_not_from_a_trials_name(db):
    study = changed(
        db,
        "UPDATE trials SET trial_id = 'again/' || trial_id, model_right = 'other'",
        "UPDATE decisions SET trial_id = 'again/' || trial_id",
        "UPDATE states SET trial_id = 'again/' || trial_id",
        "UPDATE trials SET scripted = true WHERE model_left = 'o3'",
    )
    assert [(group.driver, group.models) for group in study.models] == [
        ("other", ("other",)),
        ("o3+other", ("o3", "other")),
    ]
    assert study.models[1].posing == "scripted stand-in, not o3+other"


def test_a_bracket_in_a_drivers_name_is_no_mark(tmp_path):
    drives = [*yielding("o3", reps=1), *yielding("o3 [preview]", reps=1)]
    study = Study(write_study(tmp_path / "t.duckdb", drives))
    titles = [*alarms(study, provenance(study.db))]
    assert "Several settings under one name" not in titles


@pytest.mark.slow
def test_stand_ins_stand_last_and_every_row_of_theirs_says_so(db):
    study = changed(db, "UPDATE trials SET scripted = true WHERE trial_id LIKE 'o3/%'")
    assert [group.label for group in study.models] == ["other", "o3 (scripted stand-in, not o3)"]
    for table in make_tables(study):
        for row, plain in zip(table.rows, value_rows(table), strict=True):
            if row.groups[0].startswith("o3/"):
                assert plain["driver"] in {"o3*", "o3*, of 2 models"}, table.name
        if any(row.groups[0].startswith("o3/") for row in table.rows):
            assert table.notes.count("* o3: scripted stand-in, not o3") == 1, table.name


@pytest.mark.parametrize("name", ["emulator", "random"])
def test_a_mock_model_is_a_stand_in_for_no_model(tmp_path, name):
    db = write_study(tmp_path / "t.duckdb", yielding(name, reps=1))
    (group,) = changed(db, "UPDATE trials SET scripted = true").models
    assert group.label == f"{name} (scripted stand-in, no language model)"
    assert alarms(Study(db), provenance(db)) == {}, "nobody takes it for a model"


@pytest.mark.slow
def test_trials_of_a_stand_in_are_never_pooled_with_those_of_the_model(db):
    study = changed(db, "UPDATE trials SET scripted = true WHERE trial_id LIKE 'o3/%/rep01'")
    sizes = {group.driver: len(group.trials) for group in study.models}
    assert sizes == {"o3": 22, "other": 33, "o3 [scripted]": 11}
    ((title, text),) = alarms(study, provenance(db)).items()
    assert title == "A scripted stand-in answered"
    assert "o3 [scripted]/baseline: scripted stand-in, not o3" in text
    (table,) = make_tables(study, ["ablation-quantitative"])
    for row, trials in (("o3/baseline", 22), ("o3 [scripted]/baseline", 11)):
        (source,) = explain(study, table, f"{row}:n").sources
        assert len(load(source.query, db)) == len(source.trials) == trials


def same_each_time(db, who="trial_id LIKE 'o3/%'"):
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
    study = changed(db, *same_each_time(db), *as_programs({}))
    o3, other = study.models
    assert (len(o3.trials), o3.repeated, len(other.trials), other.repeated) == (11, 22, 33, 0)
    (table,) = make_tables(study, ["ablation-quantitative"])
    row = next(row for row in table.rows if row.id == "o3/baseline")
    assert row.values["n"] == 11
    (source,) = explain(study, table, "o3/baseline:n").sources
    assert len(load(source.query, db)) == len(source.trials) == 11
    assert any(
        ": 22 of 33 trials of programs repeat an earlier one" in note for note in table.notes
    )
    ((title, text),) = alarms(study, provenance(db)).items()
    assert title == "Trials repeat earlier ones"
    assert "o3/baseline: 22 of 33 trials of programs are as an earlier one to the last" in text
    (accounts,) = make_tables(study, ["attempts"])
    assert accounts.rows[0].values["trials"] == 33, "nothing is dropped from accounts"
    (source,) = explain(study, accounts, "o3/baseline:trials").sources
    assert len(load(source.query, db)) == len(source.trials) == 33


@pytest.mark.parametrize(
    ("chance", "scenario"),
    [
        ({"chance": True}, {}),
        ({}, {"perception_right": {"speed_sd_mps": 0.5}}),
        ({}, {"perception_left": {"dropout": 0.1}}),
        ({}, {"perception_left": {"delay_s": 0.2, "range_m": 30}}),
    ],
)
def test_equal_trials_of_programs_count_once_whatever_is_declared(db, chance, scenario):
    study = changed(db, *same_each_time(db), *as_programs(chance, **scenario))
    assert (len(study.models[0].trials), study.models[0].repeated) == (11, 22)
    assert {*alarms(study, provenance(db))} == {"Trials repeat earlier ones"}


def test_only_the_trials_that_are_equal_are_left_out(db):
    alike = "trial_id LIKE 'o3/%' AND trial_id NOT LIKE 'o3/baseline/N_0_0/%'"
    study = changed(db, *same_each_time(db, alike), *as_programs({"chance": True}))
    assert (len(study.models[0].trials), study.models[0].repeated) == (13, 20)


@pytest.mark.slow
@pytest.mark.parametrize(("where", "equal"), [("o3/baseline/N_0_0/%", 2), ("o3/%", 22)])
def test_equal_trials_of_a_language_model_are_told_and_count(db, where, equal):
    study = changed(db, *same_each_time(db, f"trial_id LIKE '{where}'"))
    assert study.models[0].repeated == 0
    ((title, text),) = alarms(study, provenance(db)).items()
    assert title == "Trials repeat earlier ones"
    says = f"o3/baseline: {equal} of 33 trials are as an earlier one to the last state; each counts"
    assert says in text


def test_trials_that_a_program_draws_otherwise_count_beside_its_copies(in_process, tmp_path):
    db = tmp_path / "t.duckdb"
    for pair in ("human-odds+constant", "projected-order+constant"):
        sweep = ("sweep", "baseline", "--model", pair, "--mirror", "--reps", 3)
        assert in_process(*sweep, "--conditions", "L_4_0,R_-4_0", "--db", db) == 0
    assert {group.driver: (len(group.trials), group.repeated) for group in Study(db).models} == {
        "constant+human-odds": (7, 5),  # one way where it goes first, and any other gap
        "constant+projected-order": (2, 10),
    }


@pytest.mark.parametrize(
    ("model", "sides", "words"),
    [
        ("o3", ("left", "right"), "scripted stand-in, not o3"),
        ("o3", ("left",), "scripted stand-in on the left, not o3"),
        ("emulator", ("left", "right"), "scripted stand-in, no language model"),
        ("random", ("left", "right"), "scripted stand-in, no language model"),
        ("emulator+constant", ("left",), "scripted stand-in, no language model"),
        ("emulator+o3", ("left",), "scripted stand-in on the left, no language model"),
        ("emulator+o3", ("left", "right"), "scripted stand-in, not o3"),
        ("constant+o3", ("right",), "scripted stand-in, not o3"),
        ("o3+gemini-2.5-pro", ("right",), "scripted stand-in on the right, not gemini-2.5-pro"),
        ("o3+gemini-2.5-pro", ("left", "right"), "scripted stand-in, not o3+gemini-2.5-pro"),
    ],
)
def test_a_stand_in_stands_for_the_models_on_whose_sides_it_answered(model, sides, words):
    models = {side: name for side, name in both_sides(model).items() if name != "constant"}
    assert stand_in(models, sides) == words


def test_a_driver_of_a_study_is_a_program_also_where_the_study_is_not_at_hand(prepare, tmp_path):
    (tmp_path / "mine.toml").write_text(
        'models = ["emulator+slow"]\nrepetitions = 1\nconditions = ["N_0_0"]\n'
        '[drivers.slow]\nprogram = "idm"\nclock = 1.0\n[factors]\nx_noise = [0.5]\n'
    )
    db = tmp_path / "results/merge.duckdb"
    assert prepare(tmp_path, "sweep", "mine.toml").code == 0
    site = Site(db)
    site.catalogue.refresh()
    (group,) = Study(db).models
    (trial,) = site.catalogue.every({})
    (run,) = list_runs(site.catalogue)
    said = "scripted stand-in, no language model"
    assert (group.posing, trial["stand_in"], run["stand_in"]) == (said, said, said)


def test_the_sides_are_those_of_the_scripted_calls(tmp_path):
    drives = [replace(drive, said={}) for drive in yielding("o3", reps=1)]
    study = changed(
        write_study(tmp_path / "t.duckdb", drives),
        "UPDATE calls SET scripted = true WHERE side = 'left'",
        "UPDATE trials SET scripted = true",
    )
    assert study.models[0].label == "o3 (scripted stand-in on the left, not o3)"


def test_a_spec_of_no_trial_keeps_nothing_from_being_read(db):
    assert changed(db, """INSERT INTO specs VALUES ('orphan', '{"scenario": {"odd": 1}}')""").models
