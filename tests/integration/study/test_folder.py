"""The folder that `merge-runner init` writes: what it has runs there, and is refused elsewhere."""

import ast
import json
import re
import shutil
import tomllib
from pathlib import Path

import pytest

from merge_runner import Study
from merge_runner.paths import DEFAULT_DB, home_of
from merge_runner.providers import ModelEntry
from merge_runner.results.store import query, results_digest
from merge_runner.study.file import TEMPLATE, write_folder
from tests.support.harness import PROJECT, a_model


@pytest.fixture
def study(tmp_path):
    """A new study."""
    folder = tmp_path / "mine"
    write_folder(folder)
    return folder


PART = ("--only", "hurry=yes", "--conditions", "L_4_0", "--reps", "1")


@pytest.fixture(scope="module")
def played(prepare, tmp_path_factory):
    """A new study of which a part was played, from outside of its folder."""
    above = tmp_path_factory.mktemp("above")
    write_folder(above / "mine")
    prepare(above, "sweep", "mine/study.toml", *PART, code=0)
    assert [path.name for path in above.iterdir()] == ["mine"]
    return above / "mine"


async def test_a_new_study_is_replayed_and_shown(merge_runner, played):
    again = await merge_runner("replay", "study.toml", *PART, "--db", "again.duckdb", cwd=played)
    assert again.code == 0, again.err
    digest = results_digest(played / "results/merge.duckdb")
    assert results_digest(played / "again.duckdb") == digest
    tables = await merge_runner("tables", "attempts", cwd=played)
    assert "emulator+hesitant/persona=taxi hurry=yes" in tables.out


async def test_an_export_names_the_plug_ins_that_it_carries_and_has_no_command_line(
    merge_runner, played, tmp_path
):
    db = played / "results/merge.duckdb"
    places = ("--db", db, "--cache", played / "cache/responses")
    export = await merge_runner("recording", "export", "mine.parquet", *places)
    assert "the whole source of the study's plug-ins: plugin.py" in export.err
    told = await merge_runner("recording", "info", "mine.parquet", "--json")
    info = json.loads(told.out)
    assert info["plugins"] == ["plugin.py"]
    assert str(tmp_path) not in told.out
    assert str(tmp_path).encode() not in (tmp_path / "mine.parquet").read_bytes()
    config = json.loads(info["provenance"]["config"])
    [(stored,)] = query(db, "SELECT config FROM sweeps")[1]
    assert json.loads(stored).keys() - config.keys() == {"typed"}


async def test_a_recording_alone_replays_its_study_in_an_empty_folder_once_its_code_is_trusted(
    merge_runner, played, tmp_path
):
    mine = shutil.copytree(played, tmp_path / "mine")
    db = mine / "results/merge.duckdb"
    places = ("--db", db, "--cache", mine / "cache/responses")
    (mine / "plugin.py").write_text((mine / "plugin.py").read_text() + "\n# changed\n")
    await merge_runner("sweep", "study.toml", *PART, "--trust", cwd=mine, code=0)
    file = tmp_path / "study.parquet"
    assert (await merge_runner("recording", "export", file, *places)).code == 0
    empty = tmp_path / "empty"
    empty.mkdir()
    refused = await merge_runner("replay", file, cwd=empty)
    assert (refused.code, f"{file} runs code (plugin.py)" in refused.err) == (2, True)
    await merge_runner("replay", file, "--trust", cwd=empty, code=0)
    assert results_digest(empty / "results/merge.duckdb") == results_digest(db)
    for words, said in (
        (("replay", file, "--reps", 1), "replayed as it was played"),
        (("sweep", file), f"merge-runner replay {file}"),
    ):
        run = await merge_runner(*words, cwd=empty)
        assert (run.code, said in run.err) == (2, True), run.err


async def test_the_summary_of_a_recording_says_study_models_trials_calls_dates_and_a_hash(
    merge_runner, tmp_path
):
    recording = PROJECT / "cache/recordings/smollm2-baseline.parquet"
    told = (await merge_runner("recording", "info", recording)).out
    facts = {line.split()[0]: line.split(maxsplit=1)[1] for line in told.splitlines()}
    assert facts["study"] == "baseline"
    assert facts["trials"] == "22 of smollm2"
    assert facts["played"] == "2026-11-22 16:02 to 2026-11-22 16:07 UTC"
    assert facts["model"] == "SmolLM2-135M-Instruct-Q4_1: 192 calls"
    assert facts["calls"] == "192 (189 ok, 3 truncated), 193 attempts, 0.00 USD"
    whole = json.loads((await merge_runner("recording", "info", recording, "--json")).out)
    assert facts["hash"].split()[0] == whole["provenance"]["content_sha256"]
    assert len(told.splitlines()) < 10
    assert facts["again"] == f"merge-runner replay {recording}"
    # It was made before recordings held their study: this is one of the program's own.
    run = await merge_runner("replay", recording, "--json")
    assert (run.code, run.summary["trials"]["planned"]) == (0, 22), run.err


async def test_an_export_leaves_out_newer_runs_of_programs_alone(merge_runner):
    part = ("--conditions", "L_4_0", "--reps", 1, "--quiet")
    await merge_runner("sweep", "baseline", "--model", "idm", *part)
    nothing = await merge_runner("recording", "export", "a.parquet")
    assert "made no call: there is nothing to record" in nothing.err
    asked = (await merge_runner("sweep", "baseline", *part, "--json")).summary["sweep_id"]
    await merge_runner("sweep", "reference", "--model", "constant", *part)
    other = await merge_runner("recording", "export", "a.parquet")
    assert (other.code, f" calls of {asked} are in a.parquet" in other.err) == (0, True), other.err


async def test_results_lie_beside_the_study_wherever_it_is_started(merge_runner, played, tmp_path):
    file = played / "study.toml"
    inside = await merge_runner("sweep", file.name, *PART, "--json", cwd=played)
    assert inside.summary["trials"]["stored_before"] == inside.summary["trials"]["planned"] > 0
    made = Study(file)
    assert (made.db, made.cache) == (played / "results/merge.duckdb", played / "cache/responses")
    tables = await merge_runner("tables", "attempts", "--study", file)
    assert "hesitant" in tables.out
    named = await merge_runner("tables", "--study", file, "--db", DEFAULT_DB)
    assert "there is no database results/merge.duckdb" in named.err


async def test_an_error_names_the_study_s_own_file_of_models(merge_runner, tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/study.toml").write_text("models = ['small']\n[repetitions]\nbaseline = 1\n")
    (tmp_path / "mine/models.toml").write_text(a_model("small"))
    run = await merge_runner("sweep", "mine/study.toml", "--tpm", 1, code=2)
    assert "lower max_output_tokens of [small] in mine/models.toml" in run.err.splitlines()[-1]


def test_a_study_of_a_folder_experiments_has_its_results_beside_that_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert home_of("baseline") == home_of("experiments/mine.toml") == Path()
    assert home_of(str(tmp_path.parent / "experiments/mine.toml")) == tmp_path.parent


async def test_init_says_what_to_type_and_refuses_a_folder_that_is_not_empty(
    merge_runner, tmp_path
):
    made = await merge_runner("init", "my study")
    assert (made.code, made.out) == (0, "go on: cd 'my study' && merge-runner sweep study.toml\n")
    names = {path.name for path in (tmp_path / "my study").iterdir()}
    files = ("study.toml", "models.toml", "plugin.py", "README.md", "CITATION.cff", "Makefile")
    assert names == {*files, ".gitignore"}
    again = await merge_runner("init", "my study")
    assert (again.code, again.err) == (2, "error: my study is not empty: name a new folder\n")
    (tmp_path / "file").touch()
    assert "file cannot be written" in (await merge_runner("init", "file")).err


def test_a_plug_in_is_short_and_every_commented_line_of_the_registry_can_be_used():
    plugin = (TEMPLATE / "plugin.py").read_text()
    assert len(plugin.splitlines()) < 40
    assert ast.parse(plugin)
    lines = (TEMPLATE / "models.toml").read_text().splitlines()
    used = [line.removeprefix("# ") if re.match(r"# (\[|\w+ = )", line) else line for line in lines]
    entries = tomllib.loads("\n".join(used))
    assert set(entries) == {"emulator-priced", "my-local"}
    for entry in entries.values():
        ModelEntry.model_validate(entry)


async def test_the_commented_lines_of_the_study_can_be_used(merge_runner, study):
    text = (study / "study.toml").read_text()
    used = re.sub(r"^# (?=\[|total_usd|persona = |opponent = )", "", text, flags=re.MULTILINE)
    (study / "study.toml").write_text(used)
    run = await merge_runner("sweep", "study.toml", "--dry-run", cwd=study, code=0)
    assert re.search(r"trials +110 ", run.out)
