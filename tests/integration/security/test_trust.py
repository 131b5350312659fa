"""A study's folder runs no code, and sends no key where its user did not send it, unasked."""

import errno
import os
import re
import shutil
import sys
from pathlib import Path

import pytest

from merge_runner import Study
from merge_runner.config import state_folder
from merge_runner.errors import UsageError
from merge_runner.study.file import write_folder
from merge_runner.study.parts import load_study
from tests.support.cases import table
from tests.support.harness import PROJECT, watched

STUDY = 'repetitions = 1\nconditions = ["N_0_0"]\n'
CODE = STUDY + '[plugins]\nfiles = ["driver.py"]\n'
SECRET = "sk-secret-0123456789"
ENTRY = 'format = "openai-chat"\nid = "scripted-driver"\nmax_output_tokens = 100\nprice = "free"\n'
AT = "http://models.example/v1"


@pytest.fixture
def state(tmp_path, monkeypatch):
    """Where agreements are kept, beside no study."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    return tmp_path / "state"


@pytest.fixture
def stranger(tmp_path, monkeypatch):
    """A folder with a study whose code leaves a mark; another folder is the working one."""
    folder, working = tmp_path / "stranger", tmp_path / "working"
    folder.mkdir()
    working.mkdir()
    monkeypatch.chdir(working)
    (folder / "study.toml").write_text(CODE)
    (folder / "driver.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'a').write('x')\n")
    return folder


@pytest.fixture
def study(stranger):
    return str(stranger / "study.toml")


@pytest.fixture
def terminal(monkeypatch):
    """Puts a terminal in the place of standard input, at which these answers are typed."""
    opened = []

    def answering(*answers):
        screen, keyboard = os.openpty()
        os.write(screen, "".join(f"{answer}\n" for answer in answers).encode())
        opened.append((screen, os.fdopen(keyboard)))
        monkeypatch.setattr(sys, "stdin", opened[-1][1])

    yield answering
    for screen, keyboard in opened:
        keyboard.close()
        os.close(screen)


def models_file(folder, name, **keys):
    lines = "".join(f'{key} = "{value}"\n' for key, value in keys.items())
    (folder / "models.toml").write_text(f"[{name}]\n{lines}{ENTRY}")
    (folder / "study.toml").write_text(f'models = ["{name}"]\n{STUDY}')


@pytest.mark.parametrize(
    ("name", "keys", "variable"),
    [
        ("nice", {"provider": "local", "key_env": "AWS_SECRET"}, "AWS_SECRET"),
        ("o3", {"provider": "openai"}, "OPENAI_API_KEY"),
    ],
)
async def test_a_models_file_beside_a_study_sends_a_key_elsewhere_only_with_an_agreement(
    merge_runner, stranger, name, keys, variable
):
    async with watched() as server:
        models_file(stranger, name, **keys, base_url=f"{server.url}/v1")
        sweep = ("sweep", stranger / "study.toml", "--yes")
        refused = await merge_runner(*sweep, code=2, **{variable: SECRET})
        assert refused.err.count("\n") == 1
        assert f"sends {variable} to {server.url} for the model {name}" in refused.err
        assert server.requests == 0
        await merge_runner(*sweep, "--trust", code=0, **{variable: SECRET})
    assert server.headers[0]["authorization"] == f"Bearer {SECRET}"


@pytest.mark.parametrize(
    "command",
    [
        *("sweep {}", "sweep {} --dry-run", "replay {}", "sweep {} --first", "power {}"),
        *(f"{name} --study {{}}" for name in ("tables", "report", "view", "audit")),
    ],
)
async def test_no_command_runs_a_studys_code_unasked(merge_runner, stranger, study, command):
    done = await merge_runner(*command.format(study).split())
    assert (done.code, done.out, done.err.count("\n")) == (2, "", 1)
    assert f"{study} runs code (driver.py)" in done.err
    assert "--trust" in done.err
    assert not (stranger.parent / "ran").exists()


def test_a_notebook_runs_a_studys_code_where_it_is_told_to(state, stranger):
    with pytest.raises(UsageError, match=r"runs code \(driver.py\).*trust=True"):
        Study(stranger / "study.toml").plan()
    assert not (stranger.parent / "ran").exists()
    assert Study(stranger / "study.toml", trust=True).plan().trials == 1
    assert (stranger.parent / "ran").exists()


def test_the_question_shows_the_code_and_comes_once_for_each_content(
    state, stranger, study, terminal, capsys
):
    code = stranger / "driver.py"
    terminal("n", "y", "n")
    with pytest.raises(UsageError, match="nothing was run"):
        load_study(study)
    asked = capsys.readouterr().err
    assert code.read_text() in asked
    assert f"{study} runs code (driver.py)" in asked
    load_study(study)
    assert capsys.readouterr().err == asked
    load_study(study)
    moved = shutil.copytree(stranger, stranger.with_name("moved"))
    load_study(str(moved / "study.toml"))
    assert capsys.readouterr().err == ""
    code.write_text(code.read_text() + "# edited\n")
    with pytest.raises(UsageError, match="nothing was run"):
        load_study(study)


async def test_several_studies_run_their_code_once_each(merge_runner, stranger, study):
    (stranger / "second.toml").write_text(CODE)
    places = ("--db", stranger / "m.duckdb", "--cache", stranger / "cache")
    both = ("sweep", study, stranger / "second.toml", "--model", "constant", *places)
    await merge_runner(*both, "--trust", code=0)
    assert (stranger.parent / "ran").read_text() == "xx"


def test_an_agreement_to_a_folder_is_none_to_the_registry_of_the_working_folder(
    state, stranger, tmp_path, study
):
    load_study(study, trust=True)
    models_file(tmp_path / "working", "nice", provider="openai", base_url=AT)
    with pytest.raises(UsageError, match="sends OPENAI_API_KEY to http:"):
        load_study(study, ["nice"])


def test_a_folder_cannot_bring_the_agreement_to_itself(state, stranger, study, monkeypatch):
    load_study(study, trust=True)
    (kept,) = state.rglob("agreements")
    for place in (".", "state", ".local/state"):
        (stranger / place / "merge-runner").mkdir(parents=True)
        shutil.copy(kept, stranger / place / "merge-runner" / "agreements")
    monkeypatch.chdir(stranger)
    monkeypatch.setenv("HOME", str(stranger.parent / "home"))
    for folder in (".", "state", "", str(stranger.parent / "elsewhere")):
        monkeypatch.setenv("XDG_STATE_HOME", folder)
        with pytest.raises(UsageError, match="runs code"):
            load_study(study)
    with pytest.raises(UsageError, match="HOME names no folder"):
        state_folder({"HOME": ".", "XDG_STATE_HOME": "state"})


def test_a_script_may_agree_where_nothing_can_be_kept_but_a_person_is_told(
    study, terminal, monkeypatch
):
    monkeypatch.setenv("XDG_STATE_HOME", os.devnull)
    load_study(study, trust=True)
    terminal("y")
    with pytest.raises(UsageError, match=r"the agreement cannot be stored in .*XDG_STATE_HOME"):
        load_study(study)


def test_a_stored_agreement_is_read_where_nothing_can_be_written(state, study, monkeypatch):
    load_study(study, trust=True)
    opened = Path.open

    def read_only(path, mode="r", *rest, **more):
        if "a" in mode:
            raise OSError(errno.EROFS, "Read-only file system")
        return opened(path, mode, *rest, **more)

    monkeypatch.setattr(Path, "open", read_only)
    load_study(study)


def test_the_study_of_init_is_its_users_own_until_its_code_is_edited(state, tmp_path):
    write_folder(tmp_path / "mine")
    study = str(tmp_path / "mine/study.toml")
    load_study(study, [])
    with (tmp_path / "mine/plugin.py").open("a") as code:
        code.write("# edited\n")
    with pytest.raises(UsageError, match=r"runs code \(plugin.py\)"):
        load_study(study, [])


@pytest.mark.parametrize("file", ["../driver.py", "{}", "link.py", "in/../../driver.py"])
def test_a_plug_in_outside_of_the_studys_folder_is_refused(state, stranger, file):
    outside = stranger.parent / "driver.py"
    outside.write_text("")
    (stranger / "link.py").symlink_to(outside)
    file = file.format(outside)
    (stranger / "study.toml").write_text(CODE.replace("driver.py", file))
    with pytest.raises(UsageError, match=f"{file} lies outside of the study's folder"):
        load_study(str(stranger / "study.toml"), trust=True)


@pytest.mark.parametrize(("keys", "words"), table("endpoints", "sends"))
def test_what_a_registry_sends_and_where_is_said(state, stranger, keys, words):
    models_file(stranger, "nice", **keys)
    with pytest.raises(UsageError, match=re.escape(words)):
        load_study(str(stranger / "study.toml"), [])


@pytest.mark.parametrize("keys", table("endpoints", "unasked"))
def test_a_providers_key_goes_to_the_provider_and_any_call_to_loopback_unasked(
    state, stranger, keys
):
    models_file(stranger, "nice", **keys)
    load_study(str(stranger / "study.toml"), [])


def test_a_registry_may_change_limits_of_a_shipped_model_and_hold_what_is_not_asked(
    state, stranger
):
    registry = (PROJECT / "experiments/models.toml").read_text()
    (stranger / "study.toml").write_text(f'models = ["o3"]\n{STUDY}')
    for old, new in (("", ""), ("rpm = 500", "rpm = 5"), ('effort = "medium"', 'effort = "high"')):
        assert old in registry
        (stranger / "models.toml").write_text(registry.replace(old, new))
        load_study(str(stranger / "study.toml"), [])
    for old, new in (("o3-2025-04-16", "o4"), ('"o3"]\n', '"o3"]\nprice = "free"\n')):
        (stranger / "models.toml").write_text(registry.replace(old, new, 1))
        load_study(str(stranger / "study.toml"), ["gemini-2.5-pro"])
        with pytest.raises(UsageError, match="o3, in place of merge-runner's own"):
            load_study(str(stranger / "study.toml"), [])


def test_an_opponent_and_both_of_a_pair_are_asked_about_too(state, stranger):
    models_file(stranger, "nice", provider="local", base_url=AT)
    with pytest.raises(UsageError, match="sends LOCAL_API_KEY"):
        load_study(str(stranger / "study.toml"), ["emulator+nice"])
    (stranger / "study.toml").write_text(f'{STUDY}[factors]\nopponent = ["nice"]\n')
    with pytest.raises(UsageError, match="sends LOCAL_API_KEY"):
        load_study(str(stranger / "study.toml"), ["emulator"])
