"""The audit of a database, a recording and a cache: what is whole passes, each damage is named."""

import json
import re
import shutil
import sqlite3
import tomllib
from dataclasses import replace
from datetime import datetime
from itertools import count
from pathlib import Path
from types import SimpleNamespace

import duckdb
import pytest
from aiohttp import web

from merge_runner.audit import checks
from merge_runner.audit.checks import audited_database, check_sweep
from merge_runner.llm.cache import ResponseCache
from merge_runner.llm.store import CachedCall
from merge_runner.records import SCRIPTED_FIELD, make_request
from merge_runner.results.recording import export_recording, read_recording
from merge_runner.results.store import query
from merge_runner.run.stored_replay import audit_database
from tests.support.harness import FAST, PROJECT, RECORDING, environment, watched
from tests.support.mock_server import FaultPlan, served
from tests.support.program import invoke
from tests.support.studies import damage

FAULTS = FaultPlan(seed=4, delay_s=0.01, rates={"rate_limit": 0.05, "malformed": 0.15})
TWO = ("--conditions", "N_0_0,L_4_8")
MODELS = ("--model", "emulator+constant", "--model", "projected-order")
RESTARTS = """
[repetitions]
baseline = 1
[scenario]
fallback = "restart"
control_start = "own_exit"
"""
# Two prompt variants with bad answers and retries; a mixed pair and programs alone; and the
# other rules of when control starts and what is driven after a bad answer.
SWEEPS = (
    ("baseline", "--variants", "baseline,A7", "--reps", "2", *TWO),
    ("baseline", *MODELS, "--reps", "1", "--conditions", "N_0_0"),
    ("restarts.toml", "--conditions", "R_-4_8"),
)
PAIR = "emulator/baseline/N_0_0/rep01"
MIXED = "emulator+constant/baseline/N_0_0/rep01"
OF_PAIR = f"trial_id = '{PAIR}'"
SLOT = f"trial_id = '{MIXED}' AND side = 'left' AND decision = 2"
OTHER_HASH = f"UPDATE decisions SET prompt_hash = 'x' WHERE {SLOT}"
SWEEP = f"(SELECT sweep_id FROM sweep_trials WHERE {OF_PAIR})"
CASES = tomllib.loads((PROJECT / "tests/cases/damages.toml").read_text())
WIDER = CASES.pop("wider")
DAMAGES = [(kind, name) for kind in CASES for name in CASES[kind]]


def audit(*arguments: object) -> SimpleNamespace:
    """What the command found."""
    run = invoke(["audit", *arguments, "--json"], cwd=PROJECT, env=environment())
    told = json.loads(run.out)
    findings, notes = ([x for of in told["audits"] for x in of[n]] for n in ("findings", "notes"))
    assert told["ok"] == (run.code == 0) == (not findings)
    return SimpleNamespace(
        code=run.code, audits=told["audits"], findings=findings, notes="\n".join(notes),
        kinds={finding["kind"] for finding in findings},
    )  # fmt: skip


@pytest.fixture(scope="module")
def made(tmp_path_factory, prepare):
    """A folder in which the program ran these sweeps."""
    folder = tmp_path_factory.mktemp("made")
    (folder / "restarts.toml").write_text(RESTARTS)
    with served(FAULTS) as url, served(FaultPlan(rates={"malformed": 0.5})) as worse:
        for sweep in SWEEPS:
            base = {SWEEPS[0]: url, SWEEPS[-1]: worse}.get(sweep)
            faulty = {"EMULATOR_BASE_URL": f"{base}/v1"} if base else {}
            assert prepare(folder, "sweep", *sweep, **faulty).code == 0
    return folder


@pytest.fixture
def db(made, tmp_path):
    """A copy of the database, to be damaged."""
    return shutil.copy(made / "results/merge.duckdb", tmp_path / "copy.duckdb")


def test_whole_sweeps_pass_and_what_was_checked_is_counted(made):
    found = audit("--db", made / "results/merge.duckdb")
    assert found.code == 0
    assert [told["counts"]["trials"] for told in found.audits] == [8, 2, 1, 11]
    counts = found.audits[0]["counts"]
    assert counts["invalid"] > 0, "no bad answer was audited"
    assert counts["attempts"] > counts["calls"], "no retry was audited"
    assert counts["decisions"] >= counts["calls"] == counts["reply ids"] > 100
    assert found.audits[2]["counts"]["invalid"] > 0
    judged = [note for note in found.notes.splitlines() if "not judged" in note]
    for note in judged:
        assert re.search(r"not judged: \d+ of the \d+ decisions of emulator are invalid \(", note)
    assert judged, "none of the models was unreliable"


def test_the_audit_at_the_end_of_a_run_reads_that_run_s_replies(made):
    db = made / "results/merge.duckdb"
    _, rows = query(
        db,
        "SELECT sweep_id, count(DISTINCT call_key) FROM sweep_trials "
        "JOIN calls USING (trial_id, spec_hash) GROUP BY ALL",
    )
    assert len(rows) == 3
    for sweep, replies in rows:
        with audited_database(db, sweep) as connection:
            found = check_sweep(connection, sweep, [], finished=True)
        assert (found.findings, found.counts["reply ids"]) == ([], replies)


async def test_the_command_says_what_it_checked_and_fails_with_the_findings(merge_runner, made, db):
    whole = await merge_runner("audit", "--db", made / "results/merge.duckdb")
    assert whole.code == 0
    assert "all holds\n  checked: 8 trials, 8 stored, 0 missing" in whole.out
    assert re.search("note: emulator/A7 and emulator/baseline share [1-9]", whole.out)
    damage(db, OTHER_HASH)
    damaged = await merge_runner("audit", "--db", db)
    assert damaged.code == 1
    assert f", {MIXED}, left, decision 2: decisions.prompt_hash is x" in damaged.out


@pytest.mark.parametrize("together", WIDER)
def test_wider_damages_are_found_and_nothing_else(db, together):
    damage(db, *WIDER[together]["sql"])
    found = audit("--db", db)
    assert found.code == 1
    assert found.kinds == set(WIDER[together]["finds"])
    for kind, said in WIDER[together]["finds"].items():
        texts = "\n".join(told["text"] for told in found.findings if told["kind"] == kind)
        assert [text for text in said if text not in texts] == []


@pytest.fixture(scope="module")
def damaged(prepare, made, tmp_path_factory):
    """What is found where each damage has a trial of its own, and where each of them is.

    Of bad answers they are in a copy of what was made, and the others where all are valid.
    """
    folder = tmp_path_factory.mktemp("damaged")
    replay = ("replay", "baseline", "--reps", 4, "--recording", RECORDING)
    assert prepare(folder, *replay, "--db", "valid").code == 0
    shutil.copy(made / "results/merge.duckdb", folder / "invalid")
    places, findings = {}, []
    for db, kinds, where in (
        ("valid", ("trial", "decision"), "side = 'left' AND decision > 2"),
        ("invalid", ("invalid",), "failure = 'no_array' AND decision > 0"),
    ):
        free: dict[str, list[tuple]] = {}
        sql = f"SELECT trial_id, side, decision FROM decisions WHERE {where} ORDER BY ALL"
        for row in query(folder / db, sql)[1]:
            free.setdefault(row[0], []).append(row)
        for kind, name in (each for each in DAMAGES if each[0] in kinds):
            trial = next(trial for trial, rows in free.items() if len(rows) > 1)
            place, other, *_ = free.pop(trial)
            slot = "trial_id = '{}' AND side = '{}' AND decision = {}"
            fields = {
                "it": f"trial_id = '{trial}'",
                "slot": slot.format(*place),
                "other": slot.format(*other),
                "named": "{}, {}, decision {}".format(*other),
            }
            damage(folder / db, *(sql.format(**fields) for sql in CASES[kind][name]["sql"]))
            places[kind, name] = (place, fields)
        found = [finding for each in audit_database(folder / db) for finding in each.findings]
        assert not free.keys() & {finding.trial for finding in found}
        findings += found
    return places, findings


@pytest.mark.parametrize(("kind", "name"), DAMAGES)
def test_each_damage_is_found_there_and_nothing_else(damaged, kind, name):
    places, findings = damaged
    place, fields = places[kind, name]
    finds = CASES[kind][name]["finds"]
    found = [finding for finding in findings if finding.trial == place[0]]
    assert {finding.kind for finding in found} == finds.keys()
    for each, text in finds.items():
        told = [finding for finding in found if finding.kind == each]
        assert any(text.format(**fields) in finding.text for finding in told), told
        if kind == "decision":
            assert place[1:] in {(finding.side, finding.decision) for finding in told} or (
                "missing or too many" in text or "cannot be replayed" in text
            )


def sweep_of(db: Path, trial: str) -> str:
    sql = f"SELECT sweep_id FROM sweep_trials WHERE trial_id = '{trial}'"
    ((sweep,),) = query(db, sql)[1]
    return sweep


def test_one_sweep_can_be_audited_alone_and_a_finding_names_its_place(db):
    damage(db, OTHER_HASH)
    whole = audit("--db", db, "--sweep", sweep_of(db, PAIR))
    assert (whole.findings, len(whole.audits)) == ([], 1)
    sweep = sweep_of(db, MIXED)
    assert sweep.startswith("baseline-emulator+constant,projected-order-")
    ((finding,), (told,)) = (found := audit("--db", db, "--sweep", sweep)).findings, found.audits
    assert (told["subject"], finding["sweep"], finding["kind"]) == (sweep, sweep, "replay")
    assert (finding["trial"], finding["side"], finding["decision"]) == (MIXED, "left", 2)


def test_what_an_unfinished_sweep_lacks_is_a_note(db):
    sweep = sweep_of(db, PAIR)
    sql = f"SELECT trial_id, spec_hash FROM sweep_trials WHERE sweep_id = '{sweep}'"
    planned = query(db, sql)[1]
    damage(
        db,
        *(sql.format(it=OF_PAIR) for sql in CASES["trial"]["it is gone"]["sql"]),
        "UPDATE sweeps SET ended_at = NULL, exit_code = NULL WHERE config::VARCHAR LIKE '%A7%'",
    )
    found = audit("--db", db)
    assert found.code == 0
    assert "unfinished: 1 of 8 trials are missing, 0 failed" in found.notes
    with audited_database(db, sweep) as connection:
        (finding,) = check_sweep(connection, sweep, planned, finished=True).findings
    assert (finding.kind, finding.trial) == ("missing", PAIR)


def test_what_another_sweep_has_played_since_is_not_missing(db):
    ((stopped,),) = query(
        db,
        "SELECT name || '-emulator-' || strftime(started_at - INTERVAL 1 HOUR, "
        f"'%Y%m%dT%H%M%S%f') FROM sweeps WHERE sweep_id = {SWEEP}",
    )[1]
    damage(
        db,
        f"INSERT INTO sweeps SELECT * REPLACE ('{stopped}' AS sweep_id, "
        f"started_at - INTERVAL 1 HOUR AS started_at) FROM sweeps WHERE sweep_id = {SWEEP}",
        f"INSERT INTO sweep_trials SELECT '{stopped}', trial_id, spec_hash FROM sweep_trials "
        f"WHERE {OF_PAIR}",
    )
    found = audit("--db", db)
    assert found.findings == []
    assert "7 of its trials were played by another sweep" in found.notes
    began = datetime.strptime(stopped.rsplit("-", 1)[1], "%Y%m%dT%H%M%S%f")  # noqa: DTZ007 # UTC
    note = f"goes on from the run of {began:%Y-%m-%d %H:%M}: 1 of its trials were stored before"
    assert note in found.notes
    assert f"{found.audits[1]['subject']} and {stopped}" not in found.notes
    checked = "1 of its trials are checked with a later sweep that has them too"
    assert checked not in found.notes
    other = stopped.replace("baseline-", "other-")
    damage(
        db,
        f"UPDATE sweeps SET sweep_id = '{other}', name = 'other' WHERE sweep_id = '{stopped}'",
        f"UPDATE sweep_trials SET sweep_id = '{other}' WHERE sweep_id = '{stopped}'",
    )
    assert checked in audit("--db", db).notes


def caching(kept: dict[str, dict], **changes: object):
    """A proxy that answers what it was asked before with the old reply, as a model's."""

    async def middle(request, handler):
        asked = await request.text()
        if asked not in kept:
            kept[asked] = json.loads((await handler(request)).body)
            kept[asked].pop(SCRIPTED_FIELD, None)
        return web.json_response(kept[asked] | {name: make() for name, make in changes.items()})

    return middle


async def test_a_proxy_that_caches_is_found_in_repetitions_and_in_a_fresh_set_of_samples(
    merge_runner, tmp_path
):
    async with watched(caching({})) as server:
        part = ("sweep", "baseline", "--conditions", "L_4_8", "--reps")
        for more in ((2,), (1, "--sample-set", 1)):
            run = await merge_runner(*part, *more, **server.env)
            assert run.code == 1, "the sweep itself finds it at its end"
            assert "faults: `merge-runner audit`" in run.err
    found = audit("--db", tmp_path / "results/merge.duckdb")
    assert found.kinds == {"shared", "exchanged"}
    texts = "\n".join(f"{f['trial']}: {f['text']}" for f in found.findings)
    assert "L_4_8/rep02, left, decision 0" in texts
    assert "L_4_8/rep01/set1, left, decision 0" in texts


# Ollama draws an id out of a thousand, some servers give all replies the same one, some give none.
@pytest.mark.parametrize(
    ("name", "repeats"),
    [("'chatcmpl-' || rowid % 30", True), ("if(rowid % 2 = 0, NULL, '')", False)],
)
def test_ids_that_a_server_gives_to_different_answers_are_a_note(db, name, repeats):
    damage(db, f"UPDATE calls SET reply = json_merge_patch(reply, json_object('id', {name})) "
               "WHERE outcome = 'ok'")  # fmt: skip
    found = audit("--db", db, "--sweep", sweep_of(db, PAIR))
    assert (found.code, "gave more than once" in found.notes) == (0, repeats)


async def test_equal_answers_under_repeating_ids_of_a_local_server_are_a_note(
    merge_runner, tmp_path
):
    numbers, said = count(), f"M\n\nI keep my speed.\n\n{[0] * 20}"
    choice = {"message": {"role": "assistant", "content": said}, "finish_reason": "stop"}
    ids = {"id": lambda: f"chatcmpl-{next(numbers) % 7}"}
    terse = caching({}, choices=lambda: [choice], **ids)
    async with watched(terse, honest=False) as server:
        part = ("--model", "local", "--reps", 1, *TWO)
        run = await merge_runner("sweep", "baseline", *part, LOCAL_BASE_URL=f"{server.url}/v1")
    assert run.code == 0, run.err
    assert "gave more than once" in run.out
    assert (await merge_runner("recording", "export", "sweep.parquet")).code == 0
    found = audit("--recording", tmp_path / "sweep.parquet")
    assert (found.code, "gave more than once" in found.notes) == (0, True)


def test_one_id_of_two_answers_does_not_hide_one_answer_of_two_samples(db, monkeypatch):
    monkeypatch.setattr(checks, "REPLIES_AT_ONCE", 3)  # of four
    slots = [f"{OF_PAIR} AND side = 'left' AND decision = {n}" for n in range(4)]
    (one, other) = (f"(SELECT reply FROM calls WHERE {slot})" for slot in slots[:2])
    damage(
        db,
        f"UPDATE calls SET reply = {one} WHERE {slots[2]}",
        f"UPDATE calls SET reply = json_merge_patch(reply, json_object('id', {other}->>'id')) "
        f"WHERE {slots[3]}",
    )
    found = audit("--db", db, "--sweep", sweep_of(db, PAIR))
    (finding,) = (one for one in found.findings if one["kind"] == "shared")
    assert finding["decision"] == 0
    assert f"with {PAIR}, left, decision 2" in finding["text"]
    assert "2 replies of scripted-driver at " in found.notes


async def test_a_proxy_that_gives_old_replies_new_ids_is_a_note(merge_runner, tmp_path):
    numbers = count()
    new_ids = caching({}, id=lambda: f"new-{next(numbers)}")
    async with watched(new_ids, honest=False) as server:
        part = ("--model", "o3", "--conditions", "L_4_8", "--reps", 2, "--yes", *FAST)
        await merge_runner("sweep", "baseline", *part, code=0, **server.account)
    found = audit("--db", tmp_path / "results/merge.duckdb")
    assert found.code == 0
    assert "word for word as before: are they samples?" in found.notes


def test_humans_alone_pass_and_it_says_that_there_is_no_sweep(golden_copy):
    db = golden_copy / "golden.duckdb"
    with duckdb.connect(str(db)) as connection:
        for table in ("states", "decisions", "calls", "trials"):
            connection.execute(
                f"DELETE FROM {table} WHERE trial_id NOT IN "
                "(SELECT trial_id FROM trials WHERE source = 'human')"
            )
        for table in ("sweep_trials", "trial_factors", "sweeps"):
            connection.execute(f"DELETE FROM {table}")
        connection.execute(
            "DELETE FROM specs WHERE spec_hash NOT IN (SELECT spec_hash FROM trials)"
        )
    (told,) = (found := audit("--db", db)).audits
    assert (found.code, told["counts"]["sweeps"], told["counts"]["human trials"]) == (0, 0, 33)


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
    assert (run.code, says in run.err) == (2, True), run.err
    assert not (made / "x").exists()


def test_the_committed_recording_passes():
    found = audit("--recording", RECORDING)
    assert (found.code, found.audits[0]["counts"]["calls"]) == (0, 2054)


def export(prepare, made: Path, trial: str, file: Path) -> None:
    """Export the recording of the sweep that has a trial."""
    sweep = sweep_of(made / "results/merge.duckdb", trial)
    assert prepare(made, "recording", "export", file, "--sweep", sweep).code == 0


@pytest.mark.parametrize("trial", [PAIR, "emulator/baseline/R_-4_8/rep01"])
def test_recordings_of_several_variants_and_of_a_late_start_pass(prepare, made, tmp_path, trial):
    export(prepare, made, trial, tmp_path / "sweep.parquet")
    assert audit("--recording", tmp_path / "sweep.parquet").code == 0


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


def asked_anew(entry: CachedCall) -> CachedCall:
    """The entry with another request in the same slot."""
    old = entry.request
    body = json.loads(old.body)
    body["messages"][0]["content"] += "?"
    request = make_request(
        provider=old.provider, endpoint=old.endpoint, model=old.model, path=old.path,
        headers=old.headers, body=body, slot=old.slot,
    )  # fmt: skip
    return replace(entry, request=request)


RECORDINGS = {
    "nothing": (lambda e: e, "", ""),
    "a reply was given to two samples": (
        lambda e: [answered(e[0], reply=e[1].attempts[-1].reply), *e[1:]],
        "exchanged shared",
        "and the provider's id of it, with N_0_0/rep01, left, decision 1",
    ),
    "two prompts of one slot share a reply": (
        lambda e: [*e, asked_anew(e[0])],
        "exchanged shared",
        "with N_0_0/rep01, left, decision 0",
    ),
    "the id of a reply is half a surrogate pair": (
        lambda e: [renamed(e[0], "\ud800"), *e[1:]], "", "",
    ),
    "another model answered": (
        lambda e: [answered(e[0], model_served="gpt-0"), *e[1:]],
        "served", "scripted-driver -> gpt-0: another model answered than was asked for (1 rep",
    ),
    "an attempt is gone": (
        lambda e: [answered(e[0], number=2), *e[1:]], "attempt", "its attempts are numbered [2]",
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", RECORDINGS)
def test_each_damage_of_a_recording_is_found_and_nothing_else(exported, tmp_path, what):
    entries, provenance = exported
    change, kinds, text = RECORDINGS[what]
    changed, file = change(entries), tmp_path / "changed.parquet"
    cache = ResponseCache(tmp_path / "cache")
    cache.put_now(changed)
    export_recording(file, cache, [entry.request.key for entry in changed], provenance)
    found = audit("--recording", file).findings
    assert [finding["kind"] for finding in found] == kinds.split()
    assert not kinds or text in found[-1]["text"]


def test_a_damaged_recording_is_a_finding(tmp_path):
    (tmp_path / "bad.parquet").write_bytes(RECORDING.read_bytes()[:-100])
    found = audit("--recording", tmp_path / "bad.parquet")
    assert (found.code, found.kinds) == (1, {"recording"})


@pytest.fixture
def cache(made, tmp_path):
    return shutil.copytree(made / "cache/responses", tmp_path / "responses")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ("DELETE FROM Cache WHERE key = ?", "no recorded reply"),
        ("UPDATE Cache SET value = substr(value, 1, 99) WHERE key = ?", "damaged"),
    ],
)
def test_a_reply_that_a_replay_would_lack_is_found(db, cache, change, says):
    ((key,),) = query(db, f"SELECT call_key FROM decisions WHERE {SLOT}")[1]
    with sqlite3.connect(cache / "cache.db") as folder:
        assert folder.execute(change, [key]).rowcount == 1
    (finding, *_) = audit("--db", db, "--cache", cache, "--sweep", sweep_of(db, MIXED)).findings
    assert (finding["kind"], finding["trial"], finding["decision"]) == ("cache", MIXED, 2)
    assert says in finding["text"]


async def test_each_study_of_a_database_is_derived_by_its_own_parts(merge_runner, tmp_path):
    for name in ("one", "two"):
        (tmp_path / f"{name}.toml").write_text(
            'description = "x"\nmodels = ["constant"]\nrepetitions = 1\nconditions = [{ '
            f'name = "of_{name}", projected_headway_m = 2, relative_velocity_mps = 0.5 }}]\n'
        )
        assert (await merge_runner("sweep", f"{name}.toml")).code == 0
    run = await merge_runner("audit")
    assert (run.code, run.out.count("1 replayed")) == (0, 2), run.err
