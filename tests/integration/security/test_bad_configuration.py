"""Whatever is wrong with a command or its files: exit code 2, and one line that says why."""

import shlex

import pytest

from tests.support import program
from tests.support.bad_configuration import BASELINE, CASES, NO_TEXT, with_line
from tests.support.harness import environment

ENVIRONMENT = environment(COLUMNS="100", EMULATOR_BASE_URL="http://127.0.0.1:9/v1")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wrong")
    (folder / "experiments").mkdir()
    (folder / "experiments/models.toml").write_text(with_line("rpm = 5"))
    (folder / "experiments/mine.toml").write_text(f"models = ['constant']\n{BASELINE}")
    (folder / "folder.toml").mkdir()
    (folder / "binary").write_bytes(bytes(range(256)) * 100)
    return folder


def refused(folder, words):
    """The lines on standard error."""
    run = program.invoke(shlex.split(words), cwd=folder, env=ENVIRONMENT)
    assert (run.code, run.out) == (2, ""), run.err
    assert "Traceback" not in run.err
    return run.err.strip().splitlines()


@pytest.mark.parametrize(("words", "says"), CASES["command"].items(), ids=CASES["command"])
def test_an_option_that_is_wrong(folder, words, says):
    (line,) = refused(folder, words)
    assert line.startswith("error: ")
    assert line.isprintable()
    assert says in line


@pytest.mark.parametrize(("words", "says"), CASES["usage"].items(), ids=CASES["usage"])
def test_what_typer_refuses_takes_a_few_lines(folder, words, says):
    lines = refused(folder, words)
    assert says in lines[-1]
    assert len(lines) <= 4


@pytest.mark.parametrize("content", [with_line("rpm = -5").encode(), *NO_TEXT], ids=range(4))
def test_the_program_says_one_line_and_with_debug_a_traceback(tmp_path, content):
    (tmp_path / "experiments").mkdir()
    (tmp_path / "experiments/models.toml").write_bytes(content)
    (line,) = refused(tmp_path, "models")
    assert line.startswith("error: experiments/models.toml")
    debug = program.invoke(("models", "--debug"), cwd=tmp_path, env=ENVIRONMENT)
    assert debug.code != 0
    assert "Traceback" in debug.err
    assert line.removeprefix("error: ") in debug.err
