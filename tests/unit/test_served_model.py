"""All that tell of another model's answers tell the same, by the aliases of all sweeps."""

import json

import duckdb
import pytest

from merge_runner.audit.checks import audited_database, check_sweep, sweep_facts
from merge_runner.served_model import others_among
from merge_runner_analysis.explain import explain
from merge_runner_analysis.provenance import provenance, tally
from merge_runner_analysis.study import StudyResults
from merge_runner_analysis.tables.attempts import attempts
from merge_runner_analysis.web.runs import list_runs
from merge_runner_analysis.web.trial_index import TrialIndex
from tests.support.studies import Drive, Said, write_study

SERVED = ("another", "o3", "o3-2025", "o3-2026", "it's")
OTHERS = ["another", "it's"]


@pytest.fixture
def db(tmp_path):
    """One sweep with answers under several names, and a later one of which it has an alias."""
    path = tmp_path / "m.duckdb"
    drives = [
        Drive("o3", "baseline", "L_4_0", rep, (0.5,), (-0.5,), said={0: Said(served=name)})
        for rep, name in enumerate(SERVED, 1)
    ]
    models = {"o3": {"id": "o3", "provider": "openai", "aliases": ["o3-2025"]}}
    write_study(path, drives, config={"models": models})
    with duckdb.connect(str(path)) as connection:
        connection.execute("UPDATE calls SET http_status = 200")
        models["o3"]["aliases"] = ["o3-2026"]
        connection.execute(
            "INSERT INTO sweeps BY NAME SELECT * REPLACE ('sweep-2' AS sweep_id, ? AS config) "
            "FROM sweeps",
            [json.dumps({"models": models})],
        )
    return path


def test_all_that_tell_of_other_models_tell_the_same(db):
    with audited_database(db, "sweep-1") as connection:
        facts = sweep_facts(connection, "sweep-1")
        findings = check_sweep(connection, "sweep-1", [], finished=True).findings
    assert sorted(served for _, served, _ in facts["others"]) == OTHERS
    assert sorted(provenance(db).mismatches.served) == OTHERS
    found = [finding.text for finding in findings if finding.kind == "served"]
    assert sorted(text.split(": ")[0] for text in found) == [f"o3 -> {name}" for name in OTHERS]
    trial_index = TrialIndex(db)
    *_, run = list_runs(trial_index)
    assert run["row"]["others"] == len(OTHERS)
    causes = [cause for cause, _ in trial_index.facets({})["cause"]]
    assert [c for c in causes if c.startswith("model: ")] == [f"model: o3 → {n}" for n in OTHERS]


def test_a_configuration_that_declares_nonsense_declares_nothing(db):
    with duckdb.connect(str(db)) as connection:
        connection.execute(
            "UPDATE sweeps SET config = ? WHERE sweep_id = 'sweep-2'",
            ['{"models": {"o3": {"id": "o3", "aliases": 5}, "x": [], "y": null}}'],
        )
    assert sorted(provenance(db).mismatches.served) == [*OTHERS, "o3-2026"]


def test_the_table_and_the_trials_behind_its_cell_agree(db):
    study = StudyResults(db)
    (group,) = study.models
    assert tally(study, group)["other_model"] == len(OTHERS)
    (source,) = explain(study, attempts(study), f"{group.id}:other_model").sources
    assert len(source.numerator) == len(OTHERS)


def test_neither_the_id_nor_an_alias_is_another_model():
    pairs = [("o3", "gpt-4o"), ("o3", "o3"), ("o3", "o3-2025")]
    assert others_among(pairs, [("o3", "o3-2025")]) == [("o3", "gpt-4o")]
