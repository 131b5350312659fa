"""One changed value of any stored column is found, or the audit says that no replay gives it."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import duckdb
import pytest

from merge_runner.audit.checks import audit_recording
from merge_runner.llm.cache import ResponseCache
from merge_runner.prompts.blocks import Prompt
from merge_runner.results.database import in_memory, schema_sql
from merge_runner.results.recording import export_recording
from merge_runner.run.stored_replay import NOT_REPLAYED, audit_database
from tests.support.harness import PROJECT, as_a_model, watched
from tests.support.mock_server import FaultPlan, served

FAULTS = FaultPlan(seed=4, delay_s=0.01, rates={"rate_limit": 0.2, "malformed": 0.2})
STUDY = """
repetitions = 1
conditions = ["L_4_0"]
factors = { opponent = ["constant"] }
"""
MIXED = ("sweep", "study.toml")
PART = ("--reps", 1, "--conditions", "L_4_0")
# Of which row a value is changed, and to what, where another row or value tells more.
ROWS = {
    "states": "step = 9 AND side = 'left'",
    "decisions": "decision = 3 AND side = 'left'",
    "calls": "decision = 3 AND attempt = (SELECT max(attempt) FROM calls WHERE decision = 3)",
}
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


@pytest.fixture(scope="module")
def made(prepare, tmp_path_factory):
    """A model against a program, with bad answers and retries; and the cache of it."""
    folder = tmp_path_factory.mktemp("made")
    (folder / "study.toml").write_text(STUDY)
    with served(FAULTS) as url:
        run = prepare(folder, *MIXED, EMULATOR_BASE_URL=f"{url}/v1")
    assert run.code == 0, run.err
    return folder


@pytest.fixture
def db(made, tmp_path):
    return shutil.copy(made / "results/merge.duckdb", tmp_path / "copy.duckdb")


def change(db: Path, *statements: str) -> None:
    with duckdb.connect(str(db)) as connection:
        for statement in statements:
            assert connection.execute(statement).fetchone()[0] > 0, f"nothing changed: {statement}"


def findings(db: Path, cache: Path | None = None) -> list:
    return [finding for audit in audit_database(db, cache=cache) for finding in audit.findings]


def columns() -> list[tuple[str, str, str]]:
    with in_memory({}) as connection:
        connection.execute(schema_sql())
        return connection.execute(
            "SELECT table_name, column_name, data_type FROM duckdb_columns() "
            "WHERE table_name IN (SELECT table_name FROM duckdb_tables()) "
            # What a user imports has no reply that it could follow from.
            "AND table_name <> 'meta'"
        ).fetchall()


COLUMNS = columns()


def altered(table: str, column: str, kind: str) -> str:
    other = CHANGES.get(f"{table}.{column}") or ANOTHER.get(kind, "coalesce({0}, 0) + 1")
    where = ROWS.get(table, "true")
    return f"UPDATE {table} SET {column} = {other.format(column)} WHERE {where}"


@pytest.mark.long
def test_what_is_changed_is_bad_and_good_answers_a_retry_and_a_program(made):
    db = made / "results/merge.duckdb"
    assert findings(db, made / "cache/responses") == []
    with duckdb.connect(str(db), read_only=True) as connection:
        ask = lambda sql: connection.execute(sql).fetchone()[0]  # noqa: E731
        assert ask("SELECT count(*) FROM decisions WHERE NOT valid") > 0
        assert ask("SELECT count(*) FROM calls WHERE outcome = 'rate_limited'") > 0
        assert ask(f"SELECT valid FROM decisions WHERE {ROWS['decisions']}")
    (audit, _) = audit_database(db)
    assert audit.counts["replayed"] == 1
    (note,) = audit.notes
    assert "emulator+constant/baseline: not judged: 2 of the 9 decisions" in note


@pytest.mark.long
@pytest.mark.parametrize(("table", "column", "kind"), COLUMNS)
def test_one_changed_value_of_a_column_is_a_finding(db, made, table, column, kind):
    change(db, altered(table, column, kind))
    found = findings(db)
    if f"{table}.{column}" not in NOT_REPLAYED:
        assert found
        return
    assert not found, "a replay gives it: take it from the list"
    with_cache = findings(db, made / "cache/responses")
    assert bool(with_cache) == (table == "calls" and column != "cached")


def test_a_format_that_there_is_not_is_a_finding_and_switches_nothing_off_in_silence(db):
    change(db, "UPDATE sweeps SET config = replace(config::VARCHAR, 'openai-chat', 'zz')::JSON")
    (finding,) = findings(db)
    assert finding.kind == "config"
    assert finding.text.endswith("'zz'")


@pytest.mark.parametrize(
    "config",
    ["'1'", "'[]'", "json_merge_patch(config, '{\"endpoints\": {\"emulator\": null}}')",
     "json_merge_patch(config, '{\"study\": 1}')", "json_merge_patch(config, '{\"arms\": [1]}')"],
)  # fmt: skip
def test_a_configuration_that_cannot_be_read_is_a_finding(db, config):
    change(db, f"UPDATE sweeps SET config = {config}")
    assert "config" in {finding.kind for finding in findings(db)}


@pytest.mark.slow
def test_what_is_not_replayed_is_listed_in_the_docs_and_by_the_command(made, prepare):
    page = (PROJECT / "docs/reference/audit.md").read_text()
    known = {f"{table}.{column}" for table, column, _ in COLUMNS}
    assert set(NOT_REPLAYED) <= known
    listed = prepare(made, "audit").out.splitlines()[-1]
    for name in NOT_REPLAYED:
        assert f"`{name}`" in page
        assert name in listed
    with_cache = prepare(made, "audit", "--cache", "cache/responses").out.splitlines()[-1]
    assert "calls.cost_usd" not in with_cache


@pytest.mark.parametrize(
    ("statement", "says"),
    [
        (
            "UPDATE decisions SET rationale = 'All is well.'",
            "decisions.rationale is All is well., and ",
        ),
        (
            "UPDATE decisions SET tactical = if(tactical = 'M', 'Y', 'M') WHERE side = 'left'",
            "decisions.tactical is ",
        ),
        ("UPDATE states SET acceleration_mps2 = -acceleration_mps2", "states.acceleration_mps2 at"),
        ("UPDATE states SET velocity_mps = velocity_mps * 1.1", "states.velocity_mps at step 0"),
    ],
)
def test_a_column_that_is_changed_throughout_is_one_finding_a_trial(db, statement, says):
    change(db, statement)
    (finding,) = (f for f in findings(db) if f.kind == "replay")
    assert says in finding.text
    assert "more in the trial" in finding.text
    assert finding.trial == "emulator+constant/baseline/L_4_0/rep01"


def test_the_answers_of_two_calls_that_are_exchanged_are_found(db, made):
    swap = """
        UPDATE calls SET reply = (SELECT reply FROM calls AS other WHERE outcome = 'ok'
            AND other.decision = if(calls.decision = 2, 5, 2))
        WHERE decision IN (2, 5) AND outcome = 'ok'
    """
    change(db, swap)
    found = findings(db)
    assert {(f.kind, f.decision) for f in found} >= {("exchanged", 2)}
    assert 2 in {f.decision for f in findings(db, made / "cache/responses") if f.kind == "cache"}


def test_an_answer_that_is_said_to_have_come_with_an_error_is_found(db):
    change(db, f"UPDATE calls SET http_status = 500 WHERE {ROWS['calls']}")
    texts = [finding.text for finding in findings(db) if finding.kind == "replay"]
    assert any("it cannot be replayed: left: HTTP 500" in text for text in texts)


def test_trials_of_another_program_are_a_note(db, monkeypatch):
    monkeypatch.setattr("merge_runner.drivers.registry.source_digest", lambda *_, **__: "edited")
    (audit, _) = audit_database(db)
    assert audit.findings == []
    assert audit.notes[-1] == (
        "not replayed: 1 trials, since they were made by another version or other data: "
        "right.source"
    )


def test_trials_of_other_prompts_are_a_note(db, monkeypatch):
    monkeypatch.setattr(Prompt, "digests", {"C0": "older"})
    (audit, _) = audit_database(db)
    assert audit.findings == []
    assert "made by another version or other data: prompt_blocks.C0" in audit.notes[-1]


def test_a_difference_below_the_tolerance_is_none(db):
    change(db, "UPDATE states SET position_m = position_m + 1e-11")
    assert findings(db) == []


POINTED = {
    "o3": ("OPENAI_BASE_URL", "/v1"),
    "gpt-5.6-sol": ("OPENAI_BASE_URL", "/v1"),
    "gemini-2.5-pro": ("GOOGLE_GEMINI_BASE_URL", ""),
    "claude-sonnet-4-6": ("ANTHROPIC_BASE_URL", ""),
}


@pytest.mark.long
@pytest.mark.parametrize("model", POINTED)
async def test_each_format_is_read_anew_as_it_was_read(merge_runner, tmp_path, model):
    variable, path = POINTED[model]
    keys = dict.fromkeys(("OPENAI_API_KEY", "GEMINI_API_KEY", "ANTHROPIC_API_KEY"), "x")
    async with watched(as_a_model, honest=False) as server:
        run = await merge_runner(
            "sweep", "baseline", "--model", model, *PART, "--yes", "--rpm", 10**6,
            "--tpm", 10**9, **keys, **{variable: server.url + path},
        )  # fmt: skip
    assert run.code == 0, run.err
    db = tmp_path / "results/merge.duckdb"
    assert findings(db, tmp_path / "cache/responses") == []
    change(db, f"UPDATE calls SET output_tokens = output_tokens + 1 WHERE {ROWS['calls']}")
    (finding,) = findings(db)
    assert "calls.output_tokens" in finding.text
    change(db, "UPDATE calls SET scripted = true WHERE decision = 5 AND side = 'left'")
    assert any("trials.scripted" in finding.text for finding in findings(db))


@pytest.mark.slow
async def test_answers_that_were_exchanged_before_they_were_kept_are_found(
    merge_runner, tmp_path, made
):
    """All agrees with them then: only that the emulator says what it answers tells of it."""
    folder = shutil.copytree(made / "cache/responses", tmp_path / "swapped")
    cache = ResponseCache(folder)
    entries = {entry.request.slot.decision: entry for entry in cache.entries()}
    cache.close()
    first, second = entries[2], entries[5]
    swapped = [
        *(entry for number, entry in entries.items() if number not in (2, 5)),
        replace(first, attempts=second.attempts),
        replace(second, attempts=first.attempts),
    ]
    shutil.rmtree(folder)
    cache = ResponseCache(folder)
    cache.put_now(swapped)
    keys = [entry.request.key for entry in swapped]
    export_recording(tmp_path / "swapped.parquet", cache, keys, {})
    cache.close()
    (finding, *_) = audit_recording(tmp_path / "swapped.parquet").findings
    assert (finding.kind, finding.decision) == ("exchanged", 2)
    # The trial goes another way after the first of them, so that it ends for want of a reply.
    await merge_runner(
        "replay", "baseline", "--model", "emulator+constant", *PART, "--cache", "swapped"
    )
    texts = {f.decision: f.text for f in findings(tmp_path / "results/merge.duckdb")}
    assert "the answer to another request" in texts[2]
