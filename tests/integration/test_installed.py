"""The program runs wherever it is installed, and imports nothing of the folder it is called in."""

import re
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from importlib import metadata
from pathlib import Path

import pytest
import typer.main

from merge_runner import __version__
from merge_runner.cli import complete_app
from tests.support.harness import PROGRAM, PROJECT, Run, environment

MODULE = (sys.executable, "-m", "merge_runner")
BUILD = "import sys; from hatchling import build; print(build.build_{}(sys.argv[1]))"


def run(folder: Path, *command: object, **changes: str) -> Run:
    done = subprocess.run(
        [*map(str, command)],
        cwd=folder,
        env=environment(**changes),
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
    )
    return Run(done.returncode, done.stdout, done.stderr)


def test_python_m_merge_runner_has_every_command_and_the_version(tmp_path):
    listed = run(tmp_path, *MODULE, "--help").out
    for name in typer.main.get_command(complete_app()).commands:
        assert re.search(rf"^ +{name} ", listed, re.MULTILINE)
    assert __version__ == metadata.version("merge-runner")
    assert f"\nversion: {__version__}\n" in (PROJECT / "CITATION.cff").read_text()
    for program in (MODULE, [PROGRAM]):
        assert run(tmp_path, *program, "--version").out == f"merge-runner {__version__}\n"


def test_without_the_analysis_the_program_has_the_commands_of_the_runner(tmp_path):
    (tmp_path / "merge_runner").symlink_to(PROJECT / "merge_runner")
    path = f"{tmp_path}:{sysconfig.get_path('purelib')}"
    # Without the module site no .pth file leads to the checkout.
    alone = run(tmp_path, sys.executable, "-S", "-m", "merge_runner", "-h", PYTHONPATH=path)
    assert re.search(r"^ +sweep ", alone.out, re.MULTILINE)
    assert not re.search(r"^ +tables ", alone.out, re.MULTILINE)


def test_no_command_imports_from_the_folder_it_is_called_in(tmp_path):
    """Nor does the emulator that it starts."""
    for name in ("analysis", "merge_runner", "typer", "duckdb"):
        (tmp_path / f"{name}.py").write_text(f"raise AssertionError('{name} of the folder')\n")
    small = ("sweep", "baseline", "--reps", 1, "--conditions", "N_0_0")
    for command in (small, ("tables", "gap")):
        done = run(tmp_path, PROGRAM, *command)
        assert done.code == 0, done.err


def test_a_file_of_the_users_named_analysis_and_ours_are_two_modules(tmp_path):
    (tmp_path / "analysis.py").write_text("MINE = True\n")
    both = "import analysis; from merge_runner_analysis import table; assert analysis.MINE"
    assert run(tmp_path, sys.executable, "-c", both).code == 0


@pytest.mark.parametrize(
    ("module", "command", "says"),
    [
        ("duckdb", "digest", "this needs duckdb, which is not installed: pip install duckdb"),
        ("fcntl", "ledger", "merge-runner runs on Linux and macOS; on Windows it runs within WSL"),
    ],
)
def test_a_module_that_is_not_there_is_told_in_one_line(tmp_path, module, command, says):
    (tmp_path / f"{module}.py").write_text(f"raise ModuleNotFoundError('no', name={module!r})")
    done = run(tmp_path, PROGRAM, command, PYTHONPATH=f"{tmp_path}:{PROJECT}")
    assert (done.code, done.err) == (2, f"error: {says}\n")


def built(kind: str, source: Path, to: Path) -> Path:
    done = run(source, sys.executable, "-c", BUILD.format(kind), to)
    assert done.code == 0, done.err
    return to / done.out.split()[-1]


def checkout_in(folder: Path) -> Path:
    """A copy of what a build takes, which leaves its own files there."""
    checkout = folder / "checkout"
    checkout.mkdir()
    listed = "merge_runner analysis experiments cache docs pyproject.toml README.md LICENSE"
    tracked = run(PROJECT, "git", "ls-files", *listed.split()).out.split()
    run(PROJECT, "cp", "--parents", *tracked, checkout)
    return checkout


def test_the_wheel_holds_sweeps_registry_and_recordings_also_when_built_from_the_sdist(tmp_path):
    checkout = checkout_in(tmp_path)
    sdist = built("sdist", checkout, tmp_path)
    shutil.unpack_archive(sdist, tmp_path / "sdist")
    (unpacked,) = (tmp_path / "sdist").iterdir()
    contents = []
    for source in (checkout, unpacked):
        with zipfile.ZipFile(built("wheel", source, tmp_path / source.name)) as wheel:
            contents.append({entry.filename: entry.CRC for entry in wheel.infolist()})
    (from_checkout, from_sdist) = ({n for n in names if "RECORD" not in n} for names in contents)
    assert from_checkout == from_sdist
    shipped = {
        f"merge_runner/{inside}/{file.name}"
        for inside, folder in (("experiments", "experiments"), ("recordings", "cache/recordings"))
        for file in (PROJECT / folder).iterdir()
    }
    analysis = ("py.typed", "web/glossary.md")
    shipped |= {"merge_runner/py.typed", *(f"merge_runner_analysis/{name}" for name in analysis)}
    assert shipped <= from_checkout
    assert not [n for n in from_checkout if n.startswith(("tests", "benchmarks", "analysis"))]


def test_make_says_the_exit_code_of_the_program(tmp_path):
    missed = run(
        PROJECT, "make", "replay", "MODEL=o3", "RECORDING=",
        f"ARGS=--reps 1 --conditions N_0_0 --db {tmp_path}/db --cache {tmp_path}/cache",
    )  # fmt: skip
    assert "replay] Error 4" in missed.err
    assert missed.code == 2


def test_make_opens_the_notebooks():
    asked = run(PROJECT, "make", "-n", "-B", "notebook", "ARGS=--no-browser").out
    assert asked.splitlines()[-1] == ".venv/bin/jupyter lab docs/notebooks --no-browser"
    assert ".venv/bin/python -m pip" in asked
    assert '".[notebook]"' in asked


def test_make_hands_nothing_to_an_inner_make(tmp_path):
    inner = tmp_path / "Makefile"
    inner.write_text((PROJECT / "Makefile").read_text().split("help:")[0] + "\ninner:\n\t@env\n")
    seen = run(tmp_path, "make", "inner", "MODEL=o3", "ARGS=-x").out
    assert not re.search(r"^(MAKEFLAGS|ARGS|MODEL)=", seen, re.MULTILINE)
