"""One changed value of any stored column is found, or the audit says that no replay gives it."""

import shutil
from pathlib import Path

import pytest

from merge_runner.drivers.registry import Program
from merge_runner.prompts.blocks import Prompt
from merge_runner.results.database import schema_sql
from merge_runner.results.instance import in_memory
from merge_runner.results.store import query
from merge_runner.run.stored_replay import NOT_REPLAYED, audit_database
from tests.support.harness import PROJECT, RECORDING
from tests.support.mock_server import FaultPlan, served
from tests.support.studies import damage

FAULTS = FaultPlan(seed=4, delay_s=0.01, rates={"rate_limit": 0.2, "malformed": 0.2})
STUDY = """
repetitions = 1
conditions = ["L_4_0"]
factors = { opponent = ["constant"] }
"""
ANOTHER = {
    "VARCHAR": "coalesce({0}, '') || 'x'", "BOOLEAN": "NOT coalesce({0}, false)",
    "DOUBLE[]": "list_transform(coalesce({0}, [0.0]), lambda a : a + 0.01)",
    "TIMESTAMP": "{0} + INTERVAL 1 SECOND", "DOUBLE": "coalesce({0}, 0) + 1e-6",
    "JSON": "replace({0}::VARCHAR, 'e', 'a')",
}  # fmt: skip
CHANGES = {
    "calls.reply": "replace(reply::VARCHAR, 'I ', 'They ')",
    "sweeps.config": "replace(config::VARCHAR, 'L_4_0', 'L_4_8')",
}
# Of which row of a trial a value is changed.
ROWS = {
    "trials": "true",
    "sweep_trials": "true",
    "states": "step = 9 AND side = 'left'",
    "decisions": "decision = 3 AND side = 'left'",
    "calls": "decision = 3 AND side = 'left'",
}


@pytest.fixture(scope="module")
def made(prepare, tmp_path_factory):
    """A model against a program, with bad answers and retries; and the cache of it."""
    folder = tmp_path_factory.mktemp("made")
    (folder / "study.toml").write_text(STUDY)
    with served(FAULTS) as url:
        run = prepare(folder, "sweep", "study.toml", EMULATOR_BASE_URL=f"{url}/v1")
    assert run.code == 0, run.err
    return folder


@pytest.fixture
def db(made, tmp_path):
    return shutil.copy(made / "results/merge.duckdb", tmp_path / "copy.duckdb")


def findings(db: Path, cache: Path | None = None) -> list:
    return [finding for audit in audit_database(db, cache=cache) for finding in audit.findings]


def columns() -> list[tuple[str, str, str]]:
    with in_memory({}) as connection:
        connection.execute(schema_sql())
        return connection.execute(
            "SELECT table_name, column_name, data_type FROM duckdb_columns() "
            "WHERE table_name IN (SELECT table_name FROM duckdb_tables()) "
            # What a user imports has no reply that it could follow from.
            "AND table_name <> 'meta' ORDER BY ALL"
        ).fetchall()


COLUMNS = columns()
NAMED = {f"{table}.{column}": (table, column, kind) for table, column, kind in COLUMNS}
REPLAYED = sorted(NAMED.keys() - NOT_REPLAYED)
OF_A_TRIAL = [
    name for name in REPLAYED if NAMED[name][0] in ROWS and name != "sweep_trials.sweep_id"
]


def altered(table: str, column: str, kind: str, where: str = "true") -> str:
    other = CHANGES.get(f"{table}.{column}") or ANOTHER.get(kind, "coalesce({0}, 0) + 1")
    return f"UPDATE {table} SET {column} = {other.format(column)} WHERE {where}"


@pytest.fixture(scope="module")
def changed(prepare, tmp_path_factory):
    """The trials with a changed value each, by its column; and where something is found."""
    folder = tmp_path_factory.mktemp("changed")
    assert prepare(folder, "replay", "baseline", "--reps", 7, "--recording", RECORDING).code == 0
    db = folder / "results/merge.duckdb"
    trials = {trial for (trial,) in query(db, "SELECT trial_id FROM trials")[1]}
    of = dict(zip(OF_A_TRIAL, sorted(trials), strict=False))
    damage(db, *(altered(*NAMED[name], f"{ROWS[NAMED[name][0]]} AND trial_id = '{trial}'")
                 for name, trial in of.items()))  # fmt: skip
    told = {str(finding.trial).rstrip("x") for finding in findings(db)}
    unchanged = trials - {*of.values()}
    assert len(unchanged) > 5
    assert not unchanged & told
    return of, told


@pytest.mark.parametrize("name", OF_A_TRIAL)
def test_one_changed_value_of_a_column_is_a_finding(changed, name):
    of, told = changed
    assert of[name] in told


@pytest.mark.parametrize("name", [name for name in REPLAYED if name not in OF_A_TRIAL])
def test_one_changed_value_of_what_is_no_trials_is_a_finding(db, name):
    damage(db, altered(*NAMED[name]))
    assert findings(db)


def test_what_no_replay_gives_is_found_by_a_cache_alone(db, made):
    where = {"calls": ROWS["calls"], "sweeps": "true"}
    damage(db, *(altered(*NAMED[name], where[NAMED[name][0]]) for name in NOT_REPLAYED))
    assert findings(db) == [], "a replay gives it: take it from the list"
    told = {finding.text.split(" ")[0] for finding in findings(db, made / "cache/responses")}
    of_calls = {name for name in NOT_REPLAYED if name.startswith("calls.")}
    assert told == of_calls - {"calls.cached"}


def test_an_audit_by_a_cache_passes_and_counts_what_it_replayed(made):
    db = made / "results/merge.duckdb"
    assert findings(db, made / "cache/responses") == []
    (audit, _) = audit_database(db)
    assert audit.counts["replayed"] == 1
    assert audit.counts["attempts"] > audit.counts["calls"], "no retry was audited"
    (note,) = audit.notes
    assert "emulator+constant/baseline: not judged: 2 of the 9 decisions" in note


def test_a_format_that_there_is_not_is_a_finding_and_switches_nothing_off_in_silence(db):
    damage(db, "UPDATE sweeps SET config = replace(config::VARCHAR, 'openai-chat', 'zz')::JSON")
    (finding,) = findings(db)
    assert finding.kind == "config"
    assert finding.text.endswith("'zz'")


@pytest.mark.parametrize("merged", ['{"endpoints": {"emulator": null}}', '{"arms": [1]}', "1"])
def test_a_configuration_that_cannot_be_read_is_a_finding(db, merged):
    damage(db, f"UPDATE sweeps SET config = json_merge_patch(config, '{merged}')")
    assert "config" in {finding.kind for finding in findings(db)}


def test_what_is_not_replayed_is_listed_in_the_docs_and_by_the_command(made, prepare):
    page = (PROJECT / "docs/recordings.md").read_text()
    listed = prepare(made, "audit").out.splitlines()[-1]
    for name in NOT_REPLAYED:
        assert f"`{name}`" in page
        assert name in listed
    with_cache = prepare(made, "audit", "--cache", "cache/responses").out.splitlines()[-1]
    assert "calls.cost_usd" not in with_cache


def test_a_column_that_is_changed_throughout_is_one_finding_a_trial(db):
    damage(
        db,
        "UPDATE decisions SET rationale = 'Well.'",
        "UPDATE states SET velocity_mps = velocity_mps * 1.1",
    )
    found = {f.text[:24]: f for f in findings(db) if f.kind == "replay"}
    assert found.keys() == {"states.velocity_mps at s", "decisions.rationale is W"}
    for finding in found.values():
        assert "more in the trial" in finding.text
        assert finding.trial == "emulator+constant/baseline/L_4_0/rep01"


def test_the_answers_of_two_calls_that_are_exchanged_are_found(db, made):
    swap = """
        UPDATE calls SET reply = (SELECT reply FROM calls AS other WHERE outcome = 'ok'
            AND other.decision = if(calls.decision = 2, 5, 2))
        WHERE decision IN (2, 5) AND outcome = 'ok'
    """
    damage(db, swap)
    found = findings(db)
    assert {(f.kind, f.decision) for f in found} >= {("exchanged", 2)}
    assert 2 in {f.decision for f in findings(db, made / "cache/responses") if f.kind == "cache"}


def test_trials_of_another_program_or_other_prompts_are_a_note(db, monkeypatch):
    monkeypatch.setattr(Program, "revision", 2)
    monkeypatch.setattr(Prompt, "digests", {"C0": "older"})
    (audit, _) = audit_database(db)
    assert audit.findings == []
    assert audit.notes[-1].startswith("not replayed: 1 trials, since they were made by another ")
    for part in ("right.revision", "prompt_blocks.C0"):
        assert part in audit.notes[-1]


def test_a_difference_below_the_tolerance_is_none(db):
    damage(db, "UPDATE states SET position_m = position_m + 1e-11")
    assert findings(db) == []
