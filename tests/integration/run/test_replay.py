"""Sealed replay and portable recordings."""

import hashlib
import json
import re
import shutil
import sqlite3
import subprocess
import sys
from contextlib import closing
from dataclasses import replace

import pytest

from merge_runner.errors import RecordingError
from merge_runner.llm.cache import ResponseCache
from merge_runner.results.recorded_sweeps import carried_plugins, provenance_of
from merge_runner.results.recording import export_recording, import_recording, read_recording
from merge_runner.results.recording_summary import summarise
from merge_runner.results.store import results_digest
from tests.support.harness import FAST, PROJECT, RECORDING, environment
from tests.support.mock_server import FaultPlan, served
from tests.support.recording_files import rewritten
from tests.support.studies import damage

# The digests of the committed recordings: results, and so these texts, never change by themselves.
GOLDEN = {
    model: (PROJECT / f"tests/golden/{model}-baseline.digest").read_text()
    for model in ("emulator", "smollm2", "smollm2-free")
}
# An archive: the bytes of a recording are never converted, whatever program reads them.
ARCHIVED = {
    "emulator": "05a244b0d396a0a994e388c877dba2cdeb5161f2083a703544cc0bbb4d1cd23d",
    "smollm2": "254f9ad68590c423818d3f640c9ba0388e368df7c789219cd5c30fc9d0ca4647",
    "smollm2-free": "c164b61d2c9a04e56232db244b79a65d2e2c76e1400fbcf533acec4edf6557cf",
}
OF_O3 = ("baseline", "--reps", 1, "--conditions", "L_4_0", "--model", "o3")
SEALED = """
import socket, sys
real = socket.socket
class Sealed(real):
    def __init__(self, family=-1, *rest, **more):
        assert family == socket.AF_UNIX, "a network socket was opened"
        super().__init__(family, *rest, **more)
socket.socket = Sealed
sys.argv = ["merge-runner", *sys.argv[1:]]
from merge_runner.cli import main
try:
    main()
finally:
    unused = ("httpx", "aiohttp", "pandas", "statsmodels", "tenacity", "numpy", "rich")
    assert not {*unused} & {*sys.modules}
"""


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """The first repetition of the committed recording: eleven trials."""
    folder = tmp_path_factory.mktemp("small")
    entries = [e for e in read_recording(RECORDING) if e.request.slot.repetition == 1]
    cache = ResponseCache(folder / "cache")
    cache.put_now(entries)
    keys = [entry.request.key for entry in entries]
    export_recording(folder / "small.parquet", cache, keys, {"experiment": "baseline"})
    cache.close()
    return folder / "small.parquet"


def test_the_recordings_that_ship_are_as_they_were_made():
    for model, sha256 in ARCHIVED.items():
        file = RECORDING.with_name(f"{model}-baseline.parquet")
        assert hashlib.sha256(file.read_bytes()).hexdigest() == sha256, model


async def test_the_committed_recording_replays_to_its_digest_as_the_readme_shows(merge_runner):
    shown = re.search(r"```text\n(.*?)```", (PROJECT / "README.md").read_text(), re.DOTALL)[1]
    run = await merge_runner("replay", "baseline", code=0)
    parts = [part for line in shown.splitlines() for part in line.split("...") if part]
    assert len(parts) >= 5
    asked = "calls: 2054 asked"
    shown = [part.replace(asked, "calls: 2054 from recordings") for part in parts]
    assert [part for part in shown if part not in run.out] == []
    assert (await merge_runner("digest")).out == GOLDEN["emulator"]


@pytest.mark.parametrize("model", ["smollm2", "smollm2-free"])
async def test_the_recordings_of_a_real_small_model_replay_to_what_their_page_says(
    merge_runner, model
):
    run = await merge_runner("replay", "baseline", "--model", model, "--json")
    assert (run.code, run.summary["calls"]["live"]) == (0, 0), run.err
    trials, decisions = run.summary["trials"], run.summary["decisions"]
    figures = (trials["planned"], trials["collided"], decisions, run.summary["invalid_decisions"])
    row = " | ".join([f"| `{model}`", *map(str, figures)])
    assert f"{row} |" in (PROJECT / "docs/models.md").read_text()
    assert (await merge_runner("digest")).out == GOLDEN[model]


async def test_without_replies_of_its_own_a_replay_takes_the_recording_that_ships_and_mixes_none(
    merge_runner, tmp_path
):
    part = ("baseline", "--reps", 1, "--json", "--conditions")
    for _ in range(2):  # the first one makes the cache folder, which says nothing of replies
        run = await merge_runner("replay", *part, "N_0_0", "--db", "shipped", code=0)
        shipped = tmp_path.joinpath(run.err.split("ships with merge-runner: ")[1].split("\n")[0])
        assert shipped.samefile(RECORDING)
    (tmp_path / "own.toml").write_text("repetitions = { baseline = 1 }")
    assert (await merge_runner("replay", "own.toml", *part[3:], "N_0_0")).code == 4
    assert (await merge_runner("sweep", *part, "N_0_0,L_4_0")).code == 0
    assert (await merge_runner("replay", *part, "L_4_8", "--db", "other")).code == 4
    with sqlite3.connect(tmp_path / "cache/responses/cache.db") as database:
        database.execute(
            "UPDATE Cache SET value = substr(value, 1, 100) "
            'WHERE value LIKE \'%"condition":"N_0_0"%"decision":4%\''
        )
    run = await merge_runner("replay", *part, "N_0_0,L_4_0", "--db", "replay.duckdb")
    assert (run.code, run.summary["trials"]["failed"]) == (1, 1)
    assert "the recorded reply is damaged" in run.summary["failed"]["emulator/baseline/N_0_0/rep01"]
    assert ("Traceback" in run.err, "ships with" in run.err) == (False, False)


def test_a_replay_opens_no_network_socket_and_is_what_the_emulator_answers_today(
    small, tmp_path, quiet
):
    done = subprocess.run(
        [sys.executable, "-c", SEALED, "replay", "baseline", "--recording", small, "--reps", "1",
         "--json"],
        cwd=tmp_path, env=environment(), capture_output=True, check=True,
    )  # fmt: skip
    assert json.loads(done.stdout)["calls"]["live"] == 0
    assert results_digest(tmp_path / "results/merge.duckdb") == quiet


async def test_missing_replies_are_counted_with_what_differs_and_the_rest_finishes(
    merge_runner, small
):
    part = ("--recording", small, "--json", "--conditions", "N_0_0,L_4_8", "--reps", 2)
    run = await merge_runner("replay", "baseline", *part)
    assert (run.code, run.summary["trials"]["failed"]) == (4, 2)
    assert run.summary["trials"]["finished"] + run.summary["trials"]["collided"] == 2
    (told,) = run.summary["messages"]
    assert re.fullmatch(
        r"emulator/baseline/\w+-?\d_-?\d/rep02, left, decision 0: the nearest recorded request "
        r"differs in repetition \(recorded 1, wanted 2\); 4 calls of 2 trials differ like this",
        told,
    )


async def test_one_changed_letter_of_a_prompt_is_one_explanation(merge_runner, small, tmp_path):
    for folder in ("merge_runner", "experiments"):
        shutil.copytree(PROJECT / folder, tmp_path / "edited" / folder)
    texts = tmp_path / "edited/merge_runner/prompts/texts.py"
    texts.write_text(texts.read_text().replace("- Your speed:", "- Your spead:"))
    part = ("--recording", small, "--reps", 1, "--conditions", "N_0_0", "--json")
    run = await merge_runner("replay", "baseline", *part, PYTHONPATH=str(tmp_path / "edited"))
    told, held = run.summary["messages"]
    assert (run.code, "small.parquet holds 206 calls of scripted-driver" in held) == (4, True)
    assert re.search("recorded '- Your speed: 1.*wanted '- Your spead: 1", told)
    assert told.endswith("; 2 calls of 1 trials differ like this")


async def test_a_replay_that_finds_nothing_stores_nothing_and_says_what_is_recorded(
    merge_runner, small, tmp_path
):
    part = ("--reps", 1, "--conditions", "N_0_0")
    nothing = "nothing of this replay is recorded, and nothing is stored: "
    for asked, said in (
        (("baseline", "--sample-set", 3, "--recording", small),
         f"{nothing}{small} holds 206 calls of scripted-driver"),
        (("ablations",), "the cache holds no call at all"),
    ):  # fmt: skip
        run = await merge_runner("replay", *asked, *part)
        assert (run.code, said in run.err) == (4, True), run.err
    assert not (tmp_path / "results").exists()


async def test_exported_sweeps_go_round_through_files_and_are_played_as_far_as_they_go(
    merge_runner, tmp_path
):
    sweeps = []
    for name, condition in (("a", "N_0_0"), ("b", "R_-4_8")):
        part = ("--reps", 1, "--json", "--conditions", condition)
        sweeps.append((await merge_runner("sweep", "baseline", *part)).summary["sweep_id"])
        assert (await merge_runner("recording", "export", f"{name}.parquet")).code == 0
    digest = results_digest(tmp_path / "results/merge.duckdb")
    assert digest[1] == 2
    both = ("--sweep", sweeps[0], "--sweep", sweeps[1])
    export = await merge_runner("recording", "export", "both.parquet", *both)
    assert f"their digest, and that of a replay: {digest[0]}  2 trials\n" in export.err
    for command in (
        ("recording", "verify", "both.parquet"),
        ("audit", "--recording", "both.parquet"),
    ):
        assert (await merge_runner(*command)).code == 0
    told = json.loads(summarise(tmp_path / "both.parquet")["provenance"]["sweeps"])
    assert [row["sweep_id"] for row in told] == sweeps
    info = json.loads((await merge_runner("recording", "info", "a.parquet", "--json")).out)
    assert info["endpoints"] == {"emulator": info["calls"]}
    assert json.loads(info["provenance"]["config"])["repetitions"] == {"baseline": 1}
    for added in (info["calls"], 0):
        run = await merge_runner("recording", "import", "a.parquet", "--cache", "new")
        assert f"{added} calls added" in run.err
    replay = ("replay", "baseline", "--json", "--cache")
    named = [word for file in ("a", "both", "b") for word in ("--recording", f"{file}.parquet")]
    run = await merge_runner(*replay, "none", *named, "--db", "again.duckdb")
    assert (run.code, run.summary["trials"]["planned"]) == (0, 2), run.err
    assert "holds 2 of the plan's 110 trials" in run.err
    assert results_digest(tmp_path / "again.duckdb") == digest
    lacking = ("--db", "again.duckdb", "--cache", "none")
    nothing = await merge_runner("recording", "export", "x.parquet", *lacking)
    assert nothing.code == 1
    assert "is not in the cache none: its run replayed a recording, which holds it" in nothing.err
    part = ("--conditions", "N_0_0", "--db", "part.duckdb", "--reps")
    cached = await merge_runner(*replay, "new", *part, 1)
    assert (await merge_runner(*replay, "none", *named, *part[2:4])).code == 0
    newest = await merge_runner("recording", "export", "x.parquet", *part[2:4], "--cache", "new")
    assert (newest.code, f" calls of {cached.summary['sweep_id']} are in" in newest.err) == (
        0,
        True,
    )
    asked = await merge_runner(*replay, "none", *named, *part, 2)
    assert (asked.code, asked.summary["trials"]["planned"]) == (4, 2), "what is asked is played"
    unknown = await merge_runner("recording", "export", "x.parquet", "--sweep", "nobody", code=2)
    assert f"unknown sweep 'nobody'; valid: {', '.join(sweeps)}" in unknown.err


@pytest.fixture(scope="module")
def answered(prepare, tmp_path_factory):
    """A folder with what a server answered, in its database, its cache and a recording."""
    folder = tmp_path_factory.mktemp("answered")
    with served(FaultPlan()) as url:
        env = {"OPENAI_API_KEY": "x", "OPENAI_BASE_URL": f"{url}/v1"}
        assert prepare(folder, "sweep", *OF_O3, "--yes", *FAST, **env).code == 0
        assert prepare(folder, "recording", "export", "good.parquet", **env).code == 0
    return folder


async def test_recordings_that_contradict_are_refused_and_a_named_one_comes_before_the_cache(
    merge_runner, answered, tmp_path
):
    good, entries = answered / "good.parquet", []
    for entry in read_recording(good):
        reply = json.loads(entry.attempts[-1].reply)
        reply["choices"][0]["message"]["content"] = "No plan."
        attempt = replace(entry.attempts[-1], reply=json.dumps(reply))
        entries.append(replace(entry, attempts=(attempt,)))
    cache, keys = ResponseCache(tmp_path / "other"), [entry.request.key for entry in entries]
    cache.put_now(entries)
    export_recording(tmp_path / "other.parquet", cache, keys, {})
    replay = ("replay", *OF_O3, "--recording", good)
    run = await merge_runner(*replay, "--recording", "other.parquet", code=1)
    assert any(f"other.parquet holds another reply to the call {key}" in run.err for key in keys)
    assert (await merge_runner(*replay, "--cache", "other", "--db", "r.duckdb")).code == 0
    digest = results_digest(answered / "results/merge.duckdb")
    assert results_digest(tmp_path / "r.duckdb") == digest


@pytest.mark.parametrize(
    "config", [{}, [], {"study": None}, {"study": {"plugins": 1}}, {"typed": ["x"]}, "no JSON"]
)
def test_what_a_recording_says_of_its_plug_ins_may_be_anything(config):
    """It may come from anybody."""
    study = {"config": json.dumps({"study": {"plugins": {"b.py": "1", "a.py": "2"}}})}
    other = {"config": config if config == "no JSON" else json.dumps(config)}
    told = provenance_of([other])
    assert (carried_plugins(told), "typed" in json.dumps(told)) == ([], False)
    for sweeps in ([study], [study, study]):
        assert carried_plugins(provenance_of(sweeps)) == ["a.py", "b.py"]
    assert carried_plugins({"sweeps": "[1, null, {}]"}) == []


async def test_a_recording_that_says_something_else_of_its_origin_is_refused(
    merge_runner, answered, tmp_path
):
    told = shutil.copy(answered / "good.parquet", tmp_path / "good.parquet")
    origin = summarise(told)["provenance"]
    assert summarise(rewritten(told))["provenance"] == origin
    for name in ("config", "exit_code", "sweep_id", "provenance_sha256", "added"):
        assert name in origin or name == "added"
        bad = rewritten(told, **{name: origin.get(name, "") + " "})
        with pytest.raises(RecordingError, match="what it says of where it comes from"):
            summarise(bad)
    with closing(ResponseCache(tmp_path / "cache")) as cache:
        with pytest.raises(RecordingError):
            import_recording(bad, cache)
        assert list(cache.entries()) == []
    for number in (1, 3):
        other = rewritten(told, format=f"merge-runner recording {number}")
        run = await merge_runner("recording", "info", other)
        (line,) = run.err.splitlines()
        assert f"has the format 'merge-runner recording {number}' with keys of" in line


async def test_a_replay_into_stored_trials_names_each_column_that_differs(
    merge_runner, small, tmp_path
):
    part = ("--recording", small, "--reps", 1, "--conditions", "N_0_0,L_4_0")
    for _ in range(2):
        assert (await merge_runner("replay", "baseline", *part)).code == 0
    damage(
        tmp_path / "results/merge.duckdb",
        "UPDATE states SET acceleration_mps2 = acceleration_mps2 + 0.001 "
        "WHERE trial_id LIKE '%N_0_0%' AND step = 7",
        "UPDATE decisions SET rationale = 'no' WHERE trial_id LIKE '%L_4_0%'",
    )
    again = await merge_runner("replay", "baseline", *part, code=1)
    (line,) = (line for line in again.err.splitlines() if "stored otherwise" in line)
    for told in (
        "2 trials are stored otherwise in results/merge.duckdb",
        "emulator/baseline/N_0_0/rep01 (states.acceleration_mps2)",
        "emulator/baseline/L_4_0/rep01 (decisions.rationale)",
    ):
        assert told in line
