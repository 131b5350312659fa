"""The audit of a database, a recording and a cache: what is whole passes, each damage is named."""

from __future__ import annotations

import json
import re
import shutil
import sqlite3
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path

import duckdb
import pytest
from aiohttp import web
from typer.testing import CliRunner

from merge_runner.audit import checks
from merge_runner.audit.checks import audit_sweep
from merge_runner.cli import app
from merge_runner.errors import UsageError
from merge_runner.llm.cache import CachedCall, ResponseCache
from merge_runner.records import SCRIPTED_FIELD, make_request
from merge_runner.results.recording import export_recording, read_recording
from merge_runner.run.stored_replay import audit_database
from merge_runner.scenarios.merge.conditions import CONDITIONS
from tests.support.harness import FAST, PROJECT, RECORDING, watched
from tests.support.mock_server import FaultPlan, served
from tests.support.recordings import drive, write_folder

FAULTS = FaultPlan(
    seed=4, delay_s=0.01, rates={"rate_limit": 0.1, "refused": 0.1, "malformed": 0.15}
)
TWO = ("--conditions", "N_0_0,L_4_8")
RESTARTS = """
[repetitions]
baseline = 1
[scenario]
fallback = "restart"
control_start = "own_exit"
"""
# Two prompt variants with bad answers and retries; a third without; a mixed pair; programs alone;
# and the other rules of when control starts and what is driven after a bad answer.
SWEEPS = (
    ("baseline", "--variants", "baseline,A7", "--reps", "2", *TWO),
    ("baseline", "--variants", "A1", "--reps", "3", *TWO),
    ("baseline", "--model", "emulator+constant", "--reps", "1", "--conditions", "N_0_0"),
    ("baseline", "--model", "projected-order", "--reps", "1", *TWO),
    ("restarts.toml", "--conditions", "R_-4_8"),
)
FAULTY = (SWEEPS[0], SWEEPS[-1])
PAIR = "emulator/baseline/N_0_0/rep01"
MIXED = "emulator+constant/baseline/N_0_0/rep01"
OF_PAIR = f"trial_id = '{PAIR}'"
OF_MIXED = f"trial_id = '{MIXED}'"
SLOT = f"{OF_MIXED} AND side = 'left' AND decision = 2"
SWEEP = f"(SELECT sweep_id FROM sweep_trials WHERE {OF_PAIR})"


@dataclass
class Audited:
    """What the command found."""

    code: int
    audits: list[dict]

    @property
    def findings(self) -> list[dict]:
        return [finding for audit in self.audits for finding in audit["findings"]]

    @property
    def kinds(self) -> set[str]:
        return {finding["kind"] for finding in self.findings}

    @property
    def notes(self) -> str:
        return "\n".join(note for audit in self.audits for note in audit["notes"])


def audit(*arguments: object) -> Audited:
    run = CliRunner().invoke(app, ["audit", *map(str, arguments), "--json"])
    told = json.loads(run.stdout)
    assert told["ok"] == (run.exit_code == 0) == (not Audited(0, told["audits"]).findings)
    return Audited(run.exit_code, told["audits"])


@pytest.fixture(scope="module")
def made(tmp_path_factory, prepare):
    """A folder in which the program ran these sweeps."""
    folder = tmp_path_factory.mktemp("made")
    (folder / "restarts.toml").write_text(RESTARTS)
    with served(FAULTS) as url:
        for sweep in SWEEPS:
            faulty = {"EMULATOR_BASE_URL": f"{url}/v1"} if sweep in FAULTY else {}
            assert prepare(folder, "sweep", *sweep, **faulty).code == 0
    return folder


@pytest.fixture
def db(made, tmp_path):
    """A copy of the database, to be damaged."""
    return shutil.copy(made / "results/merge.duckdb", tmp_path / "copy.duckdb")


def damage(db: Path, *statements: str) -> None:
    with duckdb.connect(str(db)) as connection:
        for statement in statements:
            rows = connection.execute(statement).fetchall()
            assert rows[0][0] > 0, f"nothing was damaged: {statement}"


def test_whole_sweeps_pass_and_what_was_checked_is_counted(made):
    found = audit("--db", made / "results/merge.duckdb")
    assert found.code == 0
    assert [told["counts"]["trials"] for told in found.audits] == [8, 6, 1, 2, 1, 18]
    counts = found.audits[0]["counts"]
    assert counts["invalid"] > 0, "no bad answer was audited"
    assert counts["attempts"] > counts["calls"], "no retry was audited"
    assert counts["decisions"] >= counts["calls"] == counts["reply ids"] > 100
    assert found.audits[3]["counts"]["calls"] == 0
    assert found.audits[4]["counts"]["invalid"] > 0
    assert [note for note in found.notes.splitlines() if " share " not in note] == [
        f"emulator/{prompt}: not judged: 21 of the 76 decisions of emulator are invalid (27.6 %, "
        "more than 20 %)"
        for prompt in ("A7", "baseline")
    ]


def test_the_audit_at_the_end_of_a_run_reads_that_run_s_replies_alone(made, monkeypatch):
    db, read, told = made / "results/merge.duckdb", [], checks._told
    monkeypatch.setattr(checks, "REPLIES_AT_ONCE", 50)
    monkeypatch.setattr(checks, "_told", lambda *row: read.append(row) or told(*row))
    with duckdb.connect(str(db), read_only=True) as connection:
        rows = connection.execute("""
            SELECT sweep_id, list((calls.rowid, reply::VARCHAR) ORDER BY calls.rowid)
            FROM sweep_trials JOIN calls USING (trial_id, spec_hash) GROUP BY ALL
        """).fetchall()
    assert len(rows) > 3
    for sweep, replies in rows:
        read.clear()
        found = audit_sweep(db, sweep, [], finished=True)
        assert (found.findings, read) == ([], replies)
        assert found.counts["reply ids"] > 0


@pytest.mark.slow
def test_identical_requests_of_two_variants_are_listed_and_no_finding(made):
    notes = audit("--db", made / "results/merge.duckdb").audits[-1]["notes"]
    assert any(re.match("emulator/A7 and emulator/baseline share [1-9]", note) for note in notes)


@pytest.mark.slow
async def test_the_command_says_what_it_checked_and_fails_with_the_findings(merge_runner, made, db):
    whole = await merge_runner("audit", "--db", made / "results/merge.duckdb")
    assert whole.code == 0
    assert "all holds\n  checked: 8 trials, 8 stored, 0 missing" in whole.out
    assert "note: emulator/A7 and emulator/baseline share " in whole.out
    damage(db, f"UPDATE decisions SET prompt_hash = 'x' WHERE {SLOT}")
    damaged = await merge_runner("audit", "--db", db)
    assert damaged.code == 1
    assert f", {MIXED}, left, decision 2: decisions.prompt_hash is x" in damaged.out


TRIALS = {
    "it is gone": (
        [f"DELETE FROM {t} WHERE {{it}}"
         for t in ("trials", "states", "decisions", "calls", "sweep_trials")],
        {"missing": "it was not played"},
    ),
    "it is in no sweep": (
        ["DELETE FROM sweep_trials WHERE {it}"],
        {"missing": "it was not played",
         "orphan": "no sweep has this trial"},
    ),
    "it is linked twice": (
        ["INSERT INTO sweep_trials FROM sweep_trials WHERE {it}"],
        {"unplanned": "the sweep lists it 2 times"},
    ),
    "it has no row": (
        ["DELETE FROM trials WHERE {it}", "DELETE FROM states WHERE {it}",
         "DELETE FROM decisions WHERE {it}"],
        {"orphan": "rows of calls belong to no trial"},
    ),
    "its row is another's": (
        ["UPDATE trials SET source = 'driver' WHERE {it}"],
        {"replay": "trials.source is driver, and llm replayed"},
    ),
    "it failed": (
        ["DELETE FROM states WHERE {it} AND step > 5",
         "DELETE FROM decisions WHERE {it} AND decision > 0",
         "DELETE FROM calls WHERE {it} AND decision > 1",
         "UPDATE trials SET status = 'failed', error = 'no answer', merged_first = NULL, "
         "end_time_s = 1 WHERE {it}"],
        {"failed": "no answer",
         "replay": "rows of states at step 6 are missing"},
    ),
    "it ended at another time": (
        ["UPDATE trials SET end_time_s = end_time_s + 1 WHERE {it}"],
        {"outcome": "its states after",
         "replay": "trials.end_time_s"},
    ),
    "it ended in another way": (
        ["UPDATE trials SET status = 'timeout' WHERE {it}"],
        {"outcome": "it is timeout, and a vehicle has reached the end of the track",
         "replay": "trials.status is timeout, and finished"},
    ),
    "another vehicle merged first": (
        ["UPDATE trials SET merged_first = if(merged_first = 'left', 'right', 'left') "
         "WHERE {it}"],
        {"outcome": "another vehicle merged first by its states",
         "replay": "trials.merged_first"},
    ),
    "it has no first merger": (
        ["UPDATE trials SET merged_first = NULL WHERE {it}"],
        {"outcome": "another vehicle merged first by its states",
         "replay": "trials.merged_first is NULL"},
    ),
    "a state is gone": (
        ["DELETE FROM states WHERE {it} AND step = 7 AND side = 'left'"],
        {"outcome": "samples of both vehicles in",
         "replay": "rows of states at step 7 are missing or too many"},
    ),
    "a failure has no reason": (
        ["DELETE FROM states WHERE {it} AND step > 5",
         "DELETE FROM decisions WHERE {it} AND decision > 0",
         "DELETE FROM calls WHERE {it} AND decision > 0",
         "UPDATE trials SET status = 'failed', merged_first = NULL, end_time_s = 1 WHERE {it}"],
        {"failed": "it failed",
         "outcome": "it failed and names no reason"},
    ),
}  # fmt: skip


WIDER = {
    "a trial has two specs": (
        [f"INSERT INTO sweep_trials SELECT sweep_id, trial_id, 'feed' FROM sweep_trials "
         f"WHERE {OF_PAIR}"],
        {"unplanned": "the sweep lists it 2 times",
         "orphan": "it is not among the trials"},
    ),
    "trials were not asked for": (
        ["UPDATE sweeps SET config = replace(config::VARCHAR, '\"A7\":2', '\"A7\":1')"],
        {"config": "it disagrees with itself in repetitions"},
    ),
    "the sweep's configuration is gone": (
        [f"UPDATE sweeps SET config = '{{}}' WHERE sweep_id = {SWEEP}"],
        {"config": "its configuration cannot be read"},
    ),
    "the specs are other ones": (
        ["UPDATE specs SET spec = replace(spec::VARCHAR, '\"timeout_s\":30.0', "
         "'\"timeout_s\":31.0')"],
        {"spec": "has another hash"},
    ),
    "the sweep says another model": (
        ["UPDATE sweeps SET config = replace(config::VARCHAR, 'scripted-driver', 'other')"],
        {"spec": "is not what the sweep says in left.body.model, right.body.model"},
    ),
    "the sweep is gone": (
        ["DELETE FROM sweeps WHERE sweep_id = (SELECT sweep_id FROM sweep_trials "
         f"WHERE {OF_MIXED})"],
        {"orphan": "it is listed by a sweep that is not stored"},
    ),
    "programs decided too little and too much": (
        [f"DELETE FROM decisions WHERE {OF_MIXED} AND side = 'right' AND decision = 2",
         "INSERT INTO decisions SELECT * REPLACE (99 AS decision) FROM decisions "
         "WHERE trial_id = 'projected-order/baseline/L_4_8/rep01' AND decision = 0"],
        {"replay": "rows of decisions are missing or too many"},
    ),
    "states belong to nothing": (
        [f"INSERT INTO states SELECT * REPLACE ('x' AS trial_id) FROM states WHERE {OF_MIXED}"],
        {"orphan": "rows of states belong to no trial"},
    ),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("what", WIDER)
def test_each_wider_damage_is_found_and_nothing_else(db, what):
    statements, expected = WIDER[what]
    damage(db, *statements)
    found = audit("--db", db)
    assert found.code == 1
    assert found.kinds == set(expected)
    for kind, text in expected.items():
        texts = [finding["text"] for finding in found.findings if finding["kind"] == kind]
        assert any(text in told for told in texts), texts


# {other} is another slot.
VALID = {
    "a decision is gone": (
        ["DELETE FROM decisions WHERE {slot}", "DELETE FROM calls WHERE {slot}"],
        {"replay": "it cannot be replayed: left: no recorded reply"},
    ),
    "a decision is there twice": (
        ["INSERT INTO decisions FROM decisions WHERE {slot}"],
        {"replay": "rows of decisions are missing or too many"},
    ),
    "a decision was made at another time": (
        ["UPDATE decisions SET time_s = time_s + 0.5 WHERE {slot}"],
        {"replay": "decisions.time_s is"},
    ),
    "other actions were driven": (
        ["UPDATE decisions SET applied = [9, 0, 0, 0, 0] WHERE {slot}"],
        {"replay": "decisions.applied is [9.0, "},
    ),
    "a plan is short": (
        ["UPDATE decisions SET plan = plan[1:19] WHERE {slot}"],
        {"replay": "decisions.plan is"},
    ),
    "a valid decision has no plan": (
        ["UPDATE decisions SET plan = NULL WHERE {slot}"],
        {"replay": "decisions.plan is NULL, and ["},
    ),
    "a valid decision has a failure": (
        ["UPDATE decisions SET failure = 'no_array' WHERE {slot}"],
        {"replay": "decisions.failure is no_array, and NULL"},
    ),
    "a valid decision is a fallback": (
        ["UPDATE decisions SET fallback = true WHERE {slot}"],
        {"replay": "decisions.fallback is True, and False"},
    ),
    "a prompt has another hash": (
        ["UPDATE decisions SET prompt_hash = 'x' WHERE {slot}"],
        {"replay": "decisions.prompt_hash is x, and "},
    ),
    "a prompt is gone": (
        ["UPDATE decisions SET prompt = NULL WHERE {slot}"],
        {"replay": "decisions.prompt is "},
    ),
    "a prompt is not what was asked": (
        ["UPDATE decisions SET prompt = 'x?', prompt_hash = sha256('x?') WHERE {slot}"],
        {"replay": "decisions.prompt is "},
    ),
    "a call is gone": (
        ["DELETE FROM calls WHERE {slot}"],
        {"replay": "it cannot be replayed: left: no recorded reply"},
    ),
    "a decision has no call": (
        ["UPDATE decisions SET call_key = NULL WHERE {slot}"],
        {"replay": "decisions.call_key is NULL, and "},
    ),
    "a call has no answer": (
        ["UPDATE calls SET outcome = 'overloaded' WHERE {slot}"],
        {"replay": "calls.outcome is overloaded, and ok replayed"},
    ),
    "a refusal is a valid decision": (
        ["UPDATE calls SET outcome = 'refusal' WHERE {slot}"],
        {"replay": "calls.outcome is refusal, and ok replayed"},
    ),
    "a call has no decision": (
        ["DELETE FROM decisions WHERE {slot}"],
        {"replay": "rows of decisions are missing or too many"},
    ),
    "an attempt is gone": (
        ["UPDATE calls SET attempt = 2 WHERE {slot}"],
        {"attempt": "its attempts are numbered [2]",
         "replay": "rows of calls are missing"},
    ),
    "an attempt is there twice": (
        ["INSERT INTO calls FROM calls WHERE {slot}"],
        {"attempt": "its attempts are numbered [1, 1]",
         "replay": "rows of calls are missing"},
    ),
    "an answer was asked for again": (
        ["INSERT INTO calls SELECT * REPLACE (2 AS attempt) FROM calls WHERE {slot}"],
        {"attempt": "an answer was followed by another attempt"},
    ),
    "attempts asked for different things": (
        ["INSERT INTO calls SELECT * REPLACE (2 AS attempt, '{{}}' AS request) "
         "FROM calls WHERE {slot}"],
        {"attempt": "an answer was followed by another attempt",
         "exchanged": "the answer to another request",
         "replay": "calls.request is "},
    ),
    "another model was asked": (
        ["UPDATE calls SET model_requested = 'gpt-0' WHERE {slot}"],
        {"served": "gpt-0 -> scripted-driver: another model answered",
         "replay": "calls.model_requested is gpt-0, and scripted-driver"},
    ),
    "another model answered": (
        ["UPDATE calls SET model_served = 'gpt-0' WHERE {slot}"],
        {"served": "scripted-driver -> gpt-0: another model answered than was asked for (1 ans",
         "replay": "calls.model_served is gpt-0"},
    ),
    "another parameter was sent": (
        ["UPDATE calls SET request = replace(request::VARCHAR, '4000', '4001') WHERE {slot}"],
        {"exchanged": "the answer to another request",
         "replay": "its request and slot do not have the key"},
    ),
    "a key is another": (
        ["UPDATE calls SET call_key = repeat('f', 64) WHERE {slot}",
         "UPDATE decisions SET call_key = repeat('f', 64) WHERE {slot}"],
        {"replay": "it cannot be replayed: left: no recorded reply"},
    ),
    "a reply was given to two samples": (
        ["UPDATE calls SET reply = (SELECT reply FROM calls WHERE {other}) WHERE {slot}"],
        {"shared": "its answer, with the provider's id of it, is also that of {named}",
         "exchanged": "the answer to another request",
         "replay": "it cannot be replayed: left: no recorded reply"},
    ),
    "a call was used for two samples": (
        ["UPDATE calls SET call_key = (SELECT call_key FROM calls WHERE {other}) WHERE {slot}",
         "UPDATE decisions SET call_key = (SELECT call_key FROM calls WHERE {other}) "
         "WHERE {slot}"],
        {"shared": "its call is also that of {named}",
         "replay": "no recorded reply"},
    ),
}  # fmt: skip
INVALID = {
    "a failure has no name": (
        ["UPDATE decisions SET failure = NULL WHERE {slot}"],
        {"replay": "decisions.failure is NULL, and no_array"},
    ),
    "a failure is no fallback": (
        ["UPDATE decisions SET fallback = false WHERE {slot}"],
        {"replay": "decisions.fallback is False, and True"},
    ),
    "a failure has a plan": (
        ["UPDATE decisions SET plan = applied WHERE {slot}"],
        {"replay": "decisions.plan is ["},
    ),
    "a fallback drove something else": (
        ["UPDATE decisions SET applied = [9, 0, 0, 0, 0] WHERE {slot}"],
        {"replay": "decisions.applied is [9.0, "},
    ),
}


def places(db: Path, where: str) -> list[tuple[str, str, int]]:
    with duckdb.connect(str(db)) as connection:
        return connection.execute(
            f"SELECT trial_id, side, decision FROM decisions WHERE {where} ORDER BY ALL LIMIT 2"
        ).fetchall()


OF_A_TRIAL = "trial_id = 'emulator/A1/L_4_8/rep01' AND side = 'left' AND decision > 2"
DAMAGES = {
    **{name: (OF_A_TRIAL, *damage) for name, damage in {**TRIALS, **VALID}.items()},
    **{name: ("failure = 'no_array' AND decision > 0", *damage)
       for name, damage in INVALID.items()},
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("what", DAMAGES)
def test_each_damage_is_found_there_and_nothing_else(db, what):
    where, sqls, kinds = DAMAGES[what]
    place, other = places(db, where)
    fields = {
        "it": f"trial_id = '{place[0]}'",
        "slot": "trial_id = '{}' AND side = '{}' AND decision = {}".format(*place),
        "other": "trial_id = '{}' AND side = '{}' AND decision = {}".format(*other),
        "named": "{}, {}, decision {}".format(*other),
    }
    damage(db, *(sql.format(**fields) for sql in sqls))
    found = audit("--db", db)
    assert found.code == 1
    assert {finding["trial"] for finding in found.findings} == {place[0]}
    assert {finding["kind"] for finding in found.findings} == kinds.keys()
    for kind, text in kinds.items():
        told = [finding for finding in found.findings if finding["kind"] == kind]
        assert any(text.format(**fields) in finding["text"] for finding in told), told
        if what in VALID:
            assert place[1:] in {(finding["side"], finding["decision"]) for finding in told} or (
                "missing or too many" in text or "cannot be replayed" in text
            )


LONG = """
conditions = ["L_4_0", "R_-4_8", "N_0_0"]
repetitions = {baseline = 2}
scenario = {vehicle_length_m = 8.0, collision_rule = "rectangle"}
"""
# The view as it was when every vehicle had 4.5 m.
SHORT = "CREATE OR REPLACE VIEW geometry AS SELECT * REPLACE (4.5 AS length_m) FROM sizes"


@pytest.fixture(scope="module")
def long_vehicles(prepare, tmp_path_factory):
    """A database of vehicles of 8 m; those that keep their speed collide."""
    folder = tmp_path_factory.mktemp("long")
    (folder / "long.toml").write_text(LONG)
    for model in ("emulator", "constant"):
        assert prepare(folder, "sweep", "long.toml", "--model", model).code == 0
    return folder / "results/merge.duckdb"


def statuses(db: Path) -> dict[str, str]:
    with duckdb.connect(str(db), read_only=True) as connection:
        return dict(connection.execute("SELECT trial_id, status FROM trials").fetchall())


@pytest.mark.long
def test_a_view_with_another_vehicle_length_than_the_spec_is_found(long_vehicles, tmp_path):
    db = shutil.copy(long_vehicles, tmp_path / "copy.duckdb")
    assert audit("--db", db).code == 0
    with duckdb.connect(str(db)) as connection:
        connection.execute("CREATE TABLE sizes AS FROM geometry")
        connection.execute(SHORT)
    found = audit("--db", db)
    assert found.kinds == {"gap"}
    finished = {trial for trial, status in statuses(db).items() if status == "finished"}
    assert {finding["trial"] for finding in found.findings} == finished != set()
    for finding in found.findings:
        stated, computed = re.findall(r"(-?\d+\.\d+) m", finding["text"])
        assert float(stated) - float(computed) == pytest.approx(3.5, abs=0.002)


@pytest.mark.slow
def test_a_status_that_the_states_contradict_is_found(long_vehicles, tmp_path):
    db = shutil.copy(long_vehicles, tmp_path / "copy.duckdb")
    ended = statuses(db)
    collided = [trial for trial, status in ended.items() if status == "collided"]
    finished = [trial for trial, status in ended.items() if status == "finished"]
    # Two say something else, one goes on after its collision, one had another that it ignores.
    late, apart = f"trial_id = '{collided[1]}'", f"trial_id = '{finished[1]}'"
    damage(
        db,
        f"UPDATE trials SET status = 'finished' WHERE trial_id = '{collided[0]}'",
        f"INSERT INTO states SELECT * REPLACE (step + 1 AS step, time_s + 0.2 AS time_s) "
        f"FROM states WHERE {late} AND step = (SELECT max(step) FROM states WHERE {late})",
        f"UPDATE trials SET end_time_s = end_time_s + 0.2 WHERE {late}",
        f"UPDATE trials SET status = 'collided', merged_first = NULL WHERE trial_id = "
        f"'{finished[0]}'",
        f"UPDATE states SET position_m = 99 WHERE {apart} AND step = 20",
    )
    found = audit("--db", db)
    told = {(f["trial"], f["text"].partition(" after ")[0]) for f in found.findings}
    assert {
        (collided[0], "it is finished"),
        (collided[1], "it is collided"),
        (finished[0], "it is collided, and its last states are apart"),
        (finished[1], "it is finished"),
    } <= told


@pytest.mark.slow
def test_a_finding_names_sweep_trial_side_and_decision(db):
    damage(db, f"UPDATE decisions SET prompt_hash = 'x' WHERE {SLOT}")
    (finding,) = audit("--db", db).findings
    assert finding["sweep"].startswith("baseline-emulator+constant-")
    assert (finding["trial"], finding["side"], finding["decision"]) == (MIXED, "left", 2)


@pytest.mark.slow
def test_one_sweep_can_be_audited_alone(db):
    damage(db, f"UPDATE decisions SET prompt_hash = 'x' WHERE {SLOT}")
    for trial, kinds in ((PAIR, set()), (MIXED, {"replay"})):
        with duckdb.connect(str(db)) as connection:
            (sweep,) = connection.execute(
                "SELECT sweep_id FROM sweep_trials WHERE trial_id = ?", [trial]
            ).fetchone()
        found = audit("--db", db, "--sweep", sweep)
        assert found.kinds == kinds
        assert [told["subject"] for told in found.audits] == [sweep]


@pytest.mark.slow
def test_what_an_unfinished_sweep_lacks_is_a_note(db):
    with duckdb.connect(str(db)) as connection:
        planned = connection.execute(
            f"SELECT trial_id, spec_hash FROM sweep_trials WHERE sweep_id = {SWEEP}"
        ).fetchall()
    damage(
        db,
        *(sql.format(it=OF_PAIR) for sql in TRIALS["it is gone"][0]),
        "UPDATE sweeps SET ended_at = NULL, exit_code = NULL WHERE config::VARCHAR LIKE '%A7%'",
    )
    found = audit("--db", db)
    assert found.code == 0
    assert "unfinished: 1 of 8 trials are missing, 0 failed" in found.notes
    sweep = found.audits[0]["subject"]
    assert not audit_database(db, sweep)[0].findings
    (finding,) = audit_sweep(db, sweep, planned, finished=True).findings
    assert (finding.kind, finding.trial) == ("missing", PAIR)


@pytest.mark.slow
def test_what_another_sweep_has_played_since_is_not_missing(db):
    with duckdb.connect(str(db)) as connection:
        connection.execute(
            "INSERT INTO sweeps SELECT * REPLACE (name || '-emulator-' || "
            "strftime(started_at - INTERVAL 1 HOUR, '%Y%m%dT%H%M%S%f') AS sweep_id, "
            "started_at - INTERVAL 1 HOUR AS started_at) FROM sweeps "
            f"WHERE sweep_id = {SWEEP}"
        )
        (stopped,) = connection.execute(
            "SELECT sweep_id FROM sweeps ORDER BY started_at LIMIT 1"
        ).fetchone()
        connection.execute(f"INSERT INTO sweep_trials SELECT '{stopped}', trial_id, spec_hash "
                           f"FROM sweep_trials WHERE {OF_PAIR}")  # fmt: skip
    found = audit("--db", db)
    assert found.code == 0
    assert "7 of its trials were played by another sweep" in found.notes
    own = found.audits[1]["subject"]
    assert f"{own} goes on from {stopped}: 1 of its trials were stored before" in found.notes
    assert f"{own} and {stopped}" not in found.notes


def caching(kept: dict[str, dict], **changes: object):
    """A proxy that answers what it was asked before with the old reply, as a model's."""

    async def middle(request, handler):
        asked = await request.text()
        if asked not in kept:
            kept[asked] = json.loads((await handler(request)).body)
            kept[asked].pop(SCRIPTED_FIELD)
        return web.json_response(kept[asked] | {name: make() for name, make in changes.items()})

    return middle


@pytest.mark.slow
async def test_a_proxy_that_caches_is_found_in_repetitions_and_in_a_fresh_set_of_samples(
    merge_runner, tmp_path
):
    async with watched(caching({})) as server:
        env = {"EMULATOR_BASE_URL": f"{server.url}/v1"}
        part = ("sweep", "baseline", "--conditions", "L_4_8", "--reps")
        assert (await merge_runner(*part, 1, **env)).code == 0
        assert audit("--db", tmp_path / "results/merge.duckdb").code == 0
        for more in ((2,), (1, "--sample-set", 1)):
            run = await merge_runner(*part, *more, **env)
            assert run.code == 1, "the sweep itself finds it at its end"
            assert "faults: `merge-runner audit`" in run.err
    found = audit("--db", tmp_path / "results/merge.duckdb")
    assert found.code == 1
    assert found.kinds == {"shared", "exchanged"}
    texts = "\n".join(f"{f['trial']}: {f['text']}" for f in found.findings)
    assert "L_4_8/rep02, left, decision 0" in texts
    assert "L_4_8/rep01/set1, left, decision 0" in texts


# Ollama draws an id out of a thousand, some servers give all replies the same one, some give none.
IDS = {
    "ids that repeat": (lambda number: f"chatcmpl-{number % 30}", True),
    "one id": (lambda _: "chatcmpl-0", True),
    "no id": (lambda _: None, False),
    "an empty id": (lambda _: "", False),
}


@pytest.mark.slow
@pytest.mark.parametrize("what", IDS)
async def test_ids_that_a_server_gives_to_different_answers_are_a_note(
    merge_runner, tmp_path, what
):
    name, repeats = IDS[what]
    numbers = count()

    async def renamed(request, handler):
        body = json.loads((await handler(request)).body)
        return web.json_response(body | {"id": name(next(numbers))})

    async with watched(renamed) as server:
        run = await merge_runner(
            "sweep", "baseline", "--conditions", "L_4_8", "--reps", 3,
            EMULATOR_BASE_URL=f"{server.url}/v1",
        )  # fmt: skip
    assert run.code == 0, run.err
    assert next(numbers) > 40
    assert ("gave more than once" in run.out) == repeats
    exported = tmp_path / "sweep.parquet"
    assert (await merge_runner("recording", "export", exported)).code == 0
    for found in (audit("--db", tmp_path / "results/merge.duckdb"), audit("--recording", exported)):
        assert found.code == 0
        assert ("gave more than once" in found.notes) == repeats


@pytest.mark.slow
def test_one_id_of_two_answers_does_not_hide_one_answer_of_two_samples(db):
    slots = [f"{OF_PAIR} AND side = 'left' AND decision = {n}" for n in range(4)]
    (one, other) = (f"(SELECT reply FROM calls WHERE {slot})" for slot in slots[:2])
    damage(
        db,
        f"UPDATE calls SET reply = {one} WHERE {slots[2]}",
        f"UPDATE calls SET reply = json_merge_patch(reply, json_object('id', {other}->>'id')) "
        f"WHERE {slots[3]}",
    )
    found = audit("--db", db)
    (finding,) = (one for one in found.findings if one["kind"] == "shared")
    assert finding["decision"] == 0
    assert f"is also that of {PAIR}, left, decision 2" in finding["text"]
    assert "2 replies of scripted-driver at " in found.notes


@pytest.mark.slow
async def test_a_proxy_that_gives_old_replies_new_ids_is_a_note(merge_runner, tmp_path):
    numbers = count()
    new_ids = caching({}, id=lambda: f"new-{next(numbers)}")
    async with watched(new_ids, honest=False) as server:
        env = {"OPENAI_BASE_URL": f"{server.url}/v1", "OPENAI_API_KEY": "k"}
        part = ("--model", "o3", "--conditions", "L_4_8", "--reps", 2, "--yes", *FAST)
        assert (await merge_runner("sweep", "baseline", *part, **env)).code == 0
    found = audit("--db", tmp_path / "results/merge.duckdb")
    assert found.code == 0
    assert "word for word as before: are they samples?" in found.notes


@pytest.mark.slow
async def test_another_models_answers_end_an_audit_with_1_and_no_sweep(merge_runner):
    async def other(request, handler):
        return web.json_response(json.loads((await handler(request)).body) | {"model": "gpt-0"})

    part = ("sweep", "baseline", "--conditions", "L_4_8", "--reps", 1)
    async with watched(other) as server:
        env = {"EMULATOR_BASE_URL": f"{server.url}/v1"}
        assert (await merge_runner(*part, **env)).code == 0
        found = await merge_runner("audit")
        assert found.code == 1
        assert "served: " in found.out
        strict = await merge_runner(*part, "--strict-model", "--db", "strict.duckdb", **env)
        assert strict.code == 1
    exit_codes = (PROJECT / "docs/reference/commands.md").read_text()
    assert "Another model's answers end `merge-runner audit` with 1" in exit_codes


def test_a_database_of_humans_alone_passes_and_says_that_there_is_no_sweep(prepare, tmp_path):
    write_folder(
        tmp_path / "recordings",
        {
            f"data/experiments/experiment_4/experiment_4_iter_{i}.csv": drive(name).csv()
            for i, name in enumerate(CONDITIONS, 1)
        },
    )
    assert prepare(tmp_path, "human", "import", "recordings").code == 0
    found = audit("--db", tmp_path / "results/merge.duckdb")
    assert found.code == 0
    assert [told["counts"]["sweeps"] for told in found.audits] == [0]
    assert found.audits[0]["counts"]["human trials"] == 11


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--db", "no.duckdb"], "there is no database no.duckdb"),
        (["--recording", "no.parquet"], "there is no recording no.parquet"),
        (["--recording", "no.parquet", "--cache", "x"], "--recording is checked by itself"),
        (["--sweep", "x"], "unknown sweep 'x'; valid: baseline-"),
        (["--cache", "x"], "there is no cache in x"),
    ],
)
async def test_wrong_usage_exits_2(merge_runner, made, arguments, says):
    run = await merge_runner("audit", *arguments, cwd=made)
    assert run.code == 2
    assert says in run.err
    assert not (made / "x").exists()


def test_the_committed_recording_passes():
    found = audit("--recording", RECORDING)
    assert found.code == 0
    assert found.audits[0]["counts"]["calls"] == 2054


def export(prepare, made: Path, trial: str, file: Path) -> None:
    """Export the recording of the sweep that has a trial."""
    with duckdb.connect(str(made / "results/merge.duckdb"), read_only=True) as connection:
        (sweep,) = connection.execute(
            "SELECT sweep_id FROM sweep_trials WHERE trial_id = ?", [trial]
        ).fetchone()
    assert prepare(made, "recording", "export", file, "--sweep", sweep).code == 0


@pytest.mark.parametrize("trial", [PAIR, "emulator/baseline/R_-4_8/rep01"])
def test_recordings_of_several_variants_and_of_a_late_start_pass(prepare, made, tmp_path, trial):
    export(prepare, made, trial, tmp_path / "sweep.parquet")
    found = audit("--recording", tmp_path / "sweep.parquet")
    assert found.code == 0


@pytest.fixture(scope="module")
def exported(prepare, made, tmp_path_factory):
    """The entries of the mixed pair's recording, in order, and what it says of its origin."""
    file = tmp_path_factory.mktemp("exported") / "mixed.parquet"
    export(prepare, made, MIXED, file)
    with duckdb.connect() as connection:
        told = connection.execute(f"FROM parquet_kv_metadata('{file}')").fetchall()
    return list(read_recording(file)), {k.decode(): v.decode() for _, k, v in told}


def answered(entry: CachedCall, **changes: object) -> CachedCall:
    """The entry with something else in its answer."""
    return replace(entry, attempts=(*entry.attempts[:-1], replace(entry.attempts[-1], **changes)))


def renamed(entry: CachedCall, reply_id: str) -> CachedCall:
    """The entry with another id of its reply."""
    told = json.loads(entry.attempts[-1].reply) | {"id": reply_id}
    return answered(entry, reply=json.dumps(told))


def asked_anew(entry: CachedCall, **changes: object) -> CachedCall:
    """Another request in the same slot, or in a changed one."""
    old = entry.request
    body = json.loads(old.body)
    body["messages"][0]["content"] += "?"
    request = make_request(
        provider=old.provider, endpoint=old.endpoint, model=old.model, path=old.path,
        headers=old.headers, body=body, slot=replace(old.slot, **changes),
    )  # fmt: skip
    return answered(replace(entry, request=request), reply="{}")


RECORDINGS = {
    "nothing": (lambda e: e, None, ""),
    "a reply was given to two samples": (
        lambda e: [answered(e[0], reply=e[1].attempts[-1].reply), *e[1:]],
        "exchanged shared",
        "with the provider's id of it, is also that of N_0_0/rep01, left, decision 1",
    ),
    "the id of a reply is half a surrogate pair": (
        lambda e: [renamed(e[0], "\ud800"), *e[1:]], None, "",
    ),
    "another model answered": (
        lambda e: [answered(e[0], model_served="gpt-0"), *e[1:]],
        "served", "scripted-driver -> gpt-0: another model answered than was asked for (1 ans",
    ),
    "an attempt is gone": (
        lambda e: [answered(e[0], number=2), *e[1:]], "attempt", "its attempts are numbered [2]",
    ),
}  # fmt: skip


def recorded(folder: Path, entries: list[CachedCall], provenance: dict[str, str]) -> Path:
    """A recording of these entries."""
    cache, file = ResponseCache(folder / "cache"), folder / "changed.parquet"
    cache.put_now(entries)
    export_recording(file, cache, [e.request.key for e in entries], provenance)
    return file


@pytest.mark.parametrize("what", RECORDINGS)
def test_each_damage_of_a_recording_is_found_and_nothing_else(exported, tmp_path, what):
    entries, provenance = exported
    change, kind, text = RECORDINGS[what]
    found = audit("--recording", recorded(tmp_path, change(entries), provenance))
    assert [finding["kind"] for finding in found.findings] == (kind or "").split()
    assert not kind or text in found.findings[-1]["text"]


def test_a_reply_that_two_prompts_of_one_slot_share_is_found(exported, tmp_path):
    entries, _ = exported
    again = answered(asked_anew(entries[0]), reply=entries[0].attempts[-1].reply)
    _, finding = audit("--recording", recorded(tmp_path, [*entries, again], {})).findings
    assert finding["kind"] == "shared"
    assert "is also that of N_0_0/rep01, left, decision 0" in finding["text"]


def test_a_damaged_recording_is_a_finding(tmp_path):
    (tmp_path / "bad.parquet").write_bytes(RECORDING.read_bytes()[:-100])
    found = audit("--recording", tmp_path / "bad.parquet")
    assert found.code == 1
    assert found.kinds == {"recording"}


@pytest.fixture
def cache(made, tmp_path):
    return shutil.copytree(made / "cache/responses", tmp_path / "responses")


def test_a_cache_that_holds_every_reply_passes(db, cache):
    found = audit("--db", db, "--cache", cache)
    assert found.code == 0
    assert found.audits[-1]["counts"]["trials"] == 18


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "says"),
    [
        ("DELETE FROM Cache WHERE key = ?", "no recorded reply"),
        ("UPDATE Cache SET value = substr(value, 1, 99) WHERE key = ?", "damaged"),
    ],
)
def test_a_reply_that_a_replay_would_lack_is_found(db, cache, change, says):
    with duckdb.connect(str(db), read_only=True) as connection:
        (key,) = connection.execute(f"SELECT call_key FROM decisions WHERE {SLOT}").fetchone()
    with sqlite3.connect(cache / "cache.db") as folder:
        assert folder.execute(change, [key]).rowcount == 1
    (finding,) = audit("--db", db, "--cache", cache).findings
    assert (finding["kind"], finding["trial"], finding["decision"]) == ("cache", MIXED, 2)
    assert says in finding["text"]


def test_a_table_that_is_not_ours_is_an_error_and_no_traceback(db):
    with duckdb.connect(str(db)) as connection:
        connection.execute("ALTER TABLE states RENAME COLUMN step TO steps")
    with pytest.raises(UsageError, match='cannot be read: Binder Error: Referenced column "step"'):
        audit_database(db)


@pytest.mark.slow
def test_another_reply_in_the_cache_than_in_the_database_is_found(db, cache):
    damage(db, f"UPDATE calls SET reply = replace(reply::VARCHAR, 'stop', 'halt') WHERE {SLOT}")
    (finding, *_) = (
        f for f in audit("--db", db, "--cache", cache).findings if f["kind"] == "cache"
    )
    assert "calls.reply is " in finding["text"]


@pytest.mark.slow
async def test_each_study_of_a_database_is_derived_by_its_own_parts(merge_runner, tmp_path):
    for name in ("one", "two"):
        (tmp_path / f"{name}.toml").write_text(
            'description = "x"\nmodels = ["constant"]\nrepetitions = 1\nconditions = [{ '
            f'name = "of_{name}", projected_headway_m = 2, relative_velocity_mps = 0.5 }}]\n'
        )
        run = await merge_runner("sweep", f"{name}.toml")
        assert run.code == 0, run.err
    run = await merge_runner("audit")
    assert run.code == 0, run.err
    assert run.out.count("1 replayed") == 2
