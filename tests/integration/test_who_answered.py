"""A mock model is never taken for the model whose name was used."""

import re
import shutil
from dataclasses import replace
from urllib.parse import urlsplit

import duckdb
import pytest

from merge_runner.driver_names import driver_name
from merge_runner.llm.cache import ResponseCache
from merge_runner.records import SCRIPTED_FIELD, Attempt, Slot, is_scripted, make_request
from merge_runner.results.database import schema_sql
from merge_runner.results.instance import in_memory
from merge_runner.results.recording import export_recording, read_recording
from merge_runner.results.store import query, results_digest
from merge_runner.run.estimate import earlier_answers, usual_latencies_s
from merge_runner.run.plan import make_plan
from merge_runner.run.stored_replay import audit_database
from tests.support.harness import FAST, PROJECT, as_a_model, watched

SMALL = ("--reps", 1, "--conditions", "L_4_0", "--json")
# One of the registry's entries of each of the four formats.
POINTED = ("o3", "gpt-5.6-sol", "gemini-2.5-pro", "claude-sonnet-4-6")
MODELS = [word for name in POINTED for word in ("--model", name)]


def pointed_at(url):
    """The variables by which a user leads the models' calls to a server."""
    variables = dict.fromkeys(("OPENAI_API_KEY", "GEMINI_API_KEY", "ANTHROPIC_API_KEY"), "x")
    root = url.removesuffix("/v1")
    return variables | {
        "OPENAI_BASE_URL": url, "GOOGLE_GEMINI_BASE_URL": root, "ANTHROPIC_BASE_URL": root
    }  # fmt: skip


def marks(db):
    """What calls and trials say of who answered."""
    with duckdb.connect(str(db), read_only=True) as connection:
        return connection.execute(
            "SELECT DISTINCT calls.scripted, trials.scripted, http_status "
            "FROM calls JOIN trials USING (trial_id, spec_hash)"
        ).fetchall()


@pytest.fixture(scope="module")
def pointed(prepare, emulator_url, tmp_path_factory):
    """A folder in which the emulator played a trial under each model's name, and its summary."""
    folder = tmp_path_factory.mktemp("pointed")
    sweep = ("sweep", "baseline", *MODELS, *SMALL, *FAST)
    without = prepare(folder, *sweep, code=2)
    assert "_API_KEY" in without.err
    assert "`--model emulator` rehearses the study" in without.err
    unasked = prepare(folder, *sweep, **pointed_at(emulator_url))
    assert (unasked.code, "--yes" in unasked.err) == (2, True)
    run = prepare(folder, *sweep, "--yes", code=0, **pointed_at(emulator_url))
    assert run.summary["calls"]["cached"] == 0, "money was spent without a question"
    return folder, run.summary


def test_the_emulator_behind_a_models_name_is_stored_as_what_it_is(pointed, prepare, tmp_path):
    """Also where a recording lacks the flags; its replay needs neither the server nor a key."""
    folder, summary = pointed
    assert (summary["scripted"], summary["cost_usd"] > 0) == (True, True)
    assert marks(folder / "results/merge.duckdb") == [(True, True, 200)]
    assert prepare(folder, "recording", "export", tmp_path / "told.parquet").code == 0
    with_flags = list(read_recording(tmp_path / "told.parquet"))
    assert all(a.scripted for entry in with_flags for a in entry.attempts)
    stripped, untold = ResponseCache(tmp_path / "stripped"), tmp_path / "untold.parquet"
    stripped.put_now(
        replace(entry, attempts=tuple(replace(a, scripted=False) for a in entry.attempts))
        for entry in with_flags
    )
    export_recording(untold, stripped, [entry.request.key for entry in with_flags], {})
    info = prepare(tmp_path, "recording", "info", untold, "--json").summary
    assert info["scripted"] == info["calls"] == len(with_flags) == summary["calls"]["live"]
    replay = prepare(tmp_path, "replay", "baseline", *MODELS, *SMALL, "--recording", untold, code=0)
    assert replay.summary["scripted"] is True
    assert marks(tmp_path / "results/merge.duckdb") == [(True, True, 200)]
    digests = [results_digest(each / "results/merge.duckdb") for each in (folder, tmp_path)]
    assert digests[0] == digests[1]


def test_each_format_is_read_anew_as_it_was_read(pointed, tmp_path):
    folder, _ = pointed
    db = shutil.copy(folder / "results/merge.duckdb", tmp_path / "copy.duckdb")
    audits = audit_database(db, cache=folder / "cache/responses")
    assert [audit.findings for audit in audits] == [[], []]
    with duckdb.connect(str(db)) as connection:
        connection.execute("UPDATE calls SET output_tokens = output_tokens + 1 WHERE decision = 3")
    findings = [finding for audit in audit_database(db) for finding in audit.findings]
    assert {finding.text.split(" is ")[0] for finding in findings} == {"calls.output_tokens"}
    assert {finding.trial.split("/")[0] for finding in findings} == {*POINTED}


@pytest.mark.parametrize(
    ("reply", "scripted"),
    [
        (f'{{"{SCRIPTED_FIELD}": true}}', True),
        (f'[{{"error": {{}}, "{SCRIPTED_FIELD}": true}}]', True),
        (f'{{"choices": [{{"content": "{SCRIPTED_FIELD}"}}]}}', False),
        (f'{{"choices": [{{"{SCRIPTED_FIELD}": true}}]}}', False),
        (f'"{SCRIPTED_FIELD}"', False),
        (SCRIPTED_FIELD, False),
        ("[" * 100_000 + SCRIPTED_FIELD, False),
        (None, False),
    ],
)
def test_what_a_model_writes_does_not_make_it_a_stand_in(reply, scripted):
    request = make_request(provider="openai", endpoint="openai", model="o3", path="", headers={},
                           body={}, slot=Slot("L_4_0", 1, "left", 0, 0))  # fmt: skip
    attempt = Attempt(1, "ok", 200, reply=reply)
    assert is_scripted(request, attempt) is scripted
    assert is_scripted(request, replace(attempt, scripted=True))
    assert is_scripted(replace(request, provider="emulator"), attempt)


@pytest.fixture
def estimated(merge_runner):
    """What a whole sweep of o3 is estimated at, whether by earlier answers, and its minutes."""

    async def estimate(**changes):
        run = await merge_runner("sweep", "baseline", "--model", "o3", "--dry-run", "--json",
                                 code=0, **{"OPENAI_API_KEY": "x", **changes})  # fmt: skip
        return tuple(run.summary[name] for name in ("cost_usd", "measured", "minutes"))

    return estimate


async def test_a_stand_in_is_said_to_answer_and_does_not_change_what_a_model_is_estimated_at(
    merge_runner, emulator_url, estimated
):
    before = await estimated()
    pointed, host = pointed_at(emulator_url), urlsplit(emulator_url).netloc
    sweep = ("sweep", "baseline", "--model", "o3+constant", *SMALL[:-1], *FAST)
    dry = await merge_runner(*sweep, "--dry-run", **pointed)
    assert f"driver  o3 at {host}+constant\n" in dry.out
    run = await merge_runner(*sweep, "--yes", code=0, **pointed)
    assert f"o3 at {host}: a mock model answered, not o3\n" in run.out
    assert f"driver  o3 at {host}+constant\n" in run.err
    assert "WARNING: a mock model answers, not o3" in run.err
    assert await estimated() == before
    assert before[1] is False
    # Nor at the very address where it answers.
    assert not (await estimated(**pointed))[1]


async def test_answers_at_another_effort_or_place_do_not_change_it_either(
    merge_runner, estimated, tmp_path, monkeypatch
):
    async with watched(as_a_model, honest=False) as server:
        there = pointed_at(f"{server.url}/v1")
        run = await merge_runner("sweep", "baseline", "--model", "o3", *SMALL, *FAST, "--yes",
                                 **there)  # fmt: skip
    assert run.code == 0, run.err
    assert marks(tmp_path / "results/merge.duckdb") == [(False, False, 200)]
    assert (await estimated(**there))[1], "of these there is something to measure"
    assert not (await estimated())[1]
    assert (await estimated(**there))[2] < (await estimated())[2], "by the latency of these"
    for variable, url in there.items():
        monkeypatch.setenv(variable, url)
    plan, cache = make_plan("baseline", "o3"), ResponseCache(tmp_path / "cache/responses")
    db = tmp_path / "results/merge.duckdb"
    ((median_s,),) = query(db, "SELECT median(latency_s) FROM calls")[1]
    facts = earlier_answers(plan, cache)
    assert usual_latencies_s(plan, cache, facts) == {"o3": pytest.approx(median_s)}
    cache.close()
    registry = (PROJECT / "experiments/models.toml").read_text()
    (tmp_path / "experiments").mkdir()
    (tmp_path / "experiments/models.toml").write_text(registry.replace('"medium"', '"high"'))
    shutil.copy(PROJECT / "experiments/baseline.toml", tmp_path / "experiments")
    assert not (await estimated(**there))[1]


async def test_the_emulator_by_its_own_name_is_said_to_be_one(merge_runner):
    run = await merge_runner("sweep", "baseline", *SMALL[:-1])
    assert "The model `emulator` is a mock model, no language model.\n" in run.out
    assert "mock model answer" not in run.out + run.err


NAMING = in_memory({})
NAMING.execute(re.search(r"CREATE MACRO[^;]*driver_name[^;]*;", schema_sql())[0])


URLS = (
    *("https://a.b-c.d/v1", "http://localhost:8080/v1", "http://1.2.3.4:1/", "https://a/b//c: d@e"),
    *("https://[::1]:8000/v1", "http://[2001:db8::1]/", "http://a:65535/http://b/v1"),
)


@pytest.mark.parametrize("endpoint", [None, "openai", "emulator", "emulator#faults-1-{}", *URLS])
def test_the_program_and_the_database_name_a_driver_alike(endpoint):
    (named,) = NAMING.execute("SELECT driver_name('o3', ?)", [endpoint]).fetchone()
    assert driver_name("o3", endpoint) == named
    if endpoint and "://" in endpoint:
        assert named == f"o3 at {urlsplit(endpoint).netloc}"
    else:
        assert named == "o3"
