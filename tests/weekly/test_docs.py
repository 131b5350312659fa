"""Every command of the README and the docs, run as it stands there, by hand and by make."""

import asyncio
import os
import pty
import re
import shutil
import signal
from pathlib import Path

import pytest

from merge_runner.scenarios.merge.conditions import CONDITIONS
from tests.support.harness import PROJECT, environment, watched
from tests.support.recordings import drive, write_folder

DOCS = PROJECT / "docs"
TUTORIAL = DOCS / "tutorial.md"
# Its sweep would be the newest one of the pages that follow.
LAST = DOCS / "models.md"
# Pages of users, in the order in which their commands are run.
PAGES = [PROJECT / "README.md", *sorted(PROJECT.glob("analysis/research/*/README.md"))]
PAGES += [PROJECT / "benchmarks/README.md"]
PAGES += [*sorted(set(DOCS.rglob("*.md")) - {TUTORIAL, LAST}), LAST]
PATH = f"{PROJECT}/.venv/bin:{os.environ['PATH']}"
# The environment is the project's own: a make in another folder must not install into it.
INSTALLED = (
    "make() { command make -o .venv/python -o .venv/runtime -o .venv/dev -o .venv/dask "
    '-o .venv-peer/installed ${RUN:+RUN="$RUN"} "$@"; }\n'
)
PUBLISHES = "merge-runner recording export study.parquet --study"
SERVES = re.compile(r" emulate |make view$| view$| view --port")
LINKED = (".venv", "Makefile", "pyproject.toml", "requirements", "analysis", "benchmarks", "tests")


def lines_of(block: str) -> list[str]:
    """The commands of an sh block that do something, comments cut off."""
    lines = [line.split("  #")[0].strip() for line in block.splitlines()]
    return [line for line in lines if line and not line.startswith(("#", "export "))]


def commands(page: Path) -> list[str]:
    """The commands of a page."""
    blocks = re.findall(r"^```sh\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL)
    return [line for block in blocks for line in lines_of(block)]


@pytest.fixture
def checkout(tmp_path):
    """The project as it is checked out, with its environment and without results."""
    for name in LINKED:
        (tmp_path / name).symlink_to(PROJECT / name)
    shutil.copytree(PROJECT / "experiments", tmp_path / "experiments")
    shutil.copytree(PROJECT / "cache/recordings", tmp_path / "cache/recordings")
    return tmp_path


@pytest.fixture
def folder(checkout):
    """A checkout with short sweeps, and recordings of humans."""
    for sweep in (checkout / "experiments").glob("*.toml"):
        # One repetition each; and no account's limits, which would make the sweeps take minutes.
        change = (r"^[rt]pm = .*$", "") if sweep.stem == "models" else (r" = \d+$", " = 1")
        text = re.sub(*change, sweep.read_text(), flags=re.MULTILINE)
        few = 'conditions = ["L_4_0", "N_0_0"]\n' if sweep.stem == "ablations" else ""
        sweep.write_text(few + text)
    humans = "data/experiments/experiment_4/experiment_4_iter_{}.csv"
    files = {humans.format(i): drive(name).csv() for i, name in enumerate(CONDITIONS, 1)}
    write_folder(checkout / "recordings", files)
    return checkout


async def shell(command: str, folder: Path, **changes: str) -> tuple[int, str]:
    """Run a command at a terminal, and answer its question with yes."""
    screen, terminal = pty.openpty()
    process = await asyncio.create_subprocess_shell(
        INSTALLED + command,
        cwd=folder,
        env=environment(**{"PATH": PATH, **changes}),
        stdin=terminal,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.STDOUT,
        start_new_session=True,
    )
    os.write(screen, b"y\n")
    if SERVES.search(command):  # runs until it is stopped: its first line is all there is
        out = await process.stdout.readline()
        os.killpg(process.pid, signal.SIGTERM)
        await process.communicate()  # until nobody writes any more: its port is free
        assert out.startswith(b"http://"), out
        code = 0
    else:
        out, _ = await process.communicate()
        code = process.returncode
    os.close(screen)
    os.close(terminal)
    return code, out.decode()


async def test_every_command_of_the_docs_does_what_it_says(folder):
    """What stands on the pages twice is run once, where the later pages need nothing of it."""
    done: list[str] = []
    async with watched() as server:
        at = f"{server.url}/v1"
        account = {"OPENAI_API_KEY": "k", "OPENAI_BASE_URL": at, "LOCAL_BASE_URL": at}
        for page in PAGES:
            for command in commands(page):
                if command in {"make test", "make check", *done}:
                    continue
                code, out = await shell(command, folder, **account)
                assert code == 0, f"{page.name}: {command}\n{out}"
                assert "Traceback" not in out
                done.append(command)
                if command.startswith(PUBLISHES):
                    exported = out
            if page.name == "README.md" and page.parent == PROJECT:
                assert out.strip() in exported  # the digest of the study, and of its replay
    assert {"make sweep", "make report"} <= set(done)
    assert len(done) >= 14


RECORD = DOCS / "recordings.md"


@pytest.mark.parametrize(
    ("model", "base_url", "version"),
    [("o3", "OPENAI_BASE_URL", "/v1"), ("gemini-2.5-pro", "GOOGLE_GEMINI_BASE_URL", "")],
)
async def test_the_page_on_recording_leads_to_a_file_that_replays(folder, model, base_url, version):
    registry = folder / "experiments/models.toml"
    registry.write_text(re.sub("typical_latency_s = .*", "", registry.read_text()))
    blocks = re.findall(r"^   ```sh\n(.*?)^   ```", RECORD.read_text(), re.MULTILINE | re.DOTALL)
    told = [line for block in blocks for line in lines_of(block)]
    said = []
    async with watched() as server:
        account = {"OPENAI_API_KEY": "k", "GEMINI_API_KEY": "k", base_url: server.url + version}
        for command in (line.replace("o3", model) for line in told):
            code, out = await shell(command, folder, **account)
            assert code == 0, f"{command}\n{out}"
            said.append(out)
    assert "The model `emulator` is a mock model, no language model." in said[0]
    first, second = (out.split()[-3] for out in said[-2:])
    assert first == second
    assert (folder / f"{model}.parquet").is_file()


def unspaced(text: str) -> str:
    """A text whose columns may be padded to other widths."""
    return "\n".join(" ".join(line.split()) for line in text.splitlines())


async def test_the_tutorial_shows_what_its_commands_say(checkout):
    said = ""
    blocks = re.findall(r"^```(sh|text)\n(.*?)^```", TUTORIAL.read_text(), re.MULTILINE | re.DOTALL)
    for kind, block in blocks:
        if kind == "text":
            for line in unspaced(block).splitlines():
                # The page leaves out the last columns of wide tables.
                assert any(told.startswith(line) for told in unspaced(said).splitlines()), line
            said = ""
            continue
        for command in lines_of(block):
            code, out = await shell(command, checkout)
            assert code == 0, f"{command}\n{out}"
            said += out
    assert (checkout / "results/figures/figure2.pdf").exists()
