"""Every command of the README and the docs, run as it stands there, by hand and by make."""

from __future__ import annotations

import asyncio
import fcntl
import json
import os
import pty
import re
import shutil
import signal
import subprocess
from pathlib import Path

import pytest
import typer.main

from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner_analysis.commands import app
from merge_runner_analysis.data.reference_data import published
from tests.support.harness import PROJECT, environment, watched
from tests.support.recordings import drive, write_folder

DOCS = PROJECT / "docs"
TUTORIAL = DOCS / "tutorial.md"
# Pages of users, in the order in which their commands are run.
# Its sweep would be the newest one of the pages that follow.
LAST = DOCS / "how-to/local-models.md"
PAGES = [
    PROJECT / "README.md",
    *sorted(PROJECT.glob("plugins/*/README.md")),
    *sorted(set(DOCS.rglob("*.md")) - {TUTORIAL, LAST}),
    LAST,
]
LINKING = [
    *PAGES,
    TUTORIAL,
    *(PROJECT / f"{name}.md" for name in ("CHANGELOG", "CONTRIBUTING", "SECURITY")),
    *(PROJECT / f"{folder}/README.md" for folder in ("benchmarks", "cache")),
]
BINARY = (".parquet", ".duckdb", ".png", ".gz")
PATH = f"{PROJECT}/.venv/bin:{os.environ['PATH']}"
# The environment is the project's own: a make in another folder must not install into it.
INSTALLED = (
    "make() { command make -o .venv/python -o .venv/runtime -o .venv/dev -o .venv/dask "
    '-o .venv-peer/installed ${RUN:+RUN="$RUN"} "$@"; }\n'
)
SERVES = re.compile(r" emulate |make view$| view$| view --port")
NEEDS_MAKE = pytest.mark.skipif(
    not (PROJECT / ".venv/runtime").exists(), reason="make has made no .venv"
)
LINKED = (
    ".venv",
    "Makefile",
    "pyproject.toml",
    "requirements.lock",
    "requirements-dask.lock",
    "requirements-dev.lock",
    "requirements-peer.lock",
    "benchmarks",
    "tests",
)


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
    write_folder(
        checkout / "recordings",
        {
            f"data/experiments/experiment_4/experiment_4_iter_{i}.csv": drive(name).csv()
            for i, name in enumerate(CONDITIONS, 1)
        },
    )
    return checkout


async def shell(command: str, folder: Path, **changes: str) -> tuple[int, str]:
    """Run a command at a terminal, and answer its question with yes."""
    if not SERVES.search(command):
        return await at_terminal(command, folder, **changes)
    # Another process of the tests may serve at the same port.
    with open(__file__) as own:
        fcntl.flock(own, fcntl.LOCK_EX)
        return await at_terminal(command, folder, **changes)


async def at_terminal(command: str, folder: Path, **changes: str) -> tuple[int, str]:
    """The same, where nobody else serves."""
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


@pytest.mark.long
@NEEDS_MAKE
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
    assert {"make sweep", "make report"} <= set(done)
    assert len(done) >= 14


RECORD = DOCS / "how-to/record-before-shutdown.md"


@pytest.mark.slow
async def test_the_page_on_recording_has_the_prices_that_a_dry_run_prints(merge_runner):
    rows = [line for line in RECORD.read_text().splitlines() if ", baseline |" in line]
    rows += [line for line in RECORD.read_text().splitlines() if ", ablations |" in line]
    assert len(rows) == 4
    for row in rows:
        what, *figures = (cell.strip() for cell in row.strip("|").split("|"))
        model, sweep = what.split(", ")
        run = await merge_runner("sweep", sweep, "--model", model, "--batch", "--dry-run", "--json")
        told = json.loads(run.out)
        costs = [f"{usd:.2f}" for usd in (told["singly_usd"], told["cost_usd"])]
        counts = [told[name] for name in ("calls", "input_tokens", "output_tokens")]
        assert figures == [*map(str, counts), costs[0], str(told["minutes"]), costs[1]]


@pytest.mark.long
@NEEDS_MAKE
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
    assert "The model `emulator` is a scripted stand-in, no language model." in said[0]
    first, second = (out.split()[-3] for out in said[-2:])
    assert first == second
    assert (folder / f"{model}.parquet").is_file()


def unspaced(text: str) -> str:
    """A text whose columns may be padded to other widths."""
    return "\n".join(" ".join(line.split()) for line in text.splitlines())


@pytest.mark.long
@NEEDS_MAKE
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


@NEEDS_MAKE
@pytest.mark.parametrize(
    ("words", "ending"),
    [
        (["test"], '.venv/bin/pytest -m "not slow and not long"\n'),
        (["test", "ARGS=-k name"], ".venv/bin/pytest -k name\n"),
        (["check"], '.venv/bin/pytest -m "not long" \n'),
    ],
)
def test_make_test_runs_the_quick_tests_or_those_that_are_named_and_make_check_all(words, ending):
    command = ["make", "--no-print-directory", "--dry-run", *words]
    run = subprocess.run(command, cwd=PROJECT, capture_output=True, text=True, check=True)
    assert run.stdout.endswith(ending)


def test_every_command_and_every_make_target_is_in_the_docs():
    text = "\n".join(page.read_text() for page in PAGES)
    command = typer.main.get_command(app)
    for name in command.commands:
        assert f"merge-runner {name}" in text or f"make {name}" in text, name
    targets = re.findall(r"^([a-z]+):.*## ", (PROJECT / "Makefile").read_text(), re.MULTILINE)
    for target in targets:
        assert f"make {target}" in text, target


def test_the_reference_of_commands_has_every_command_and_every_option_and_no_other():
    text = (DOCS / "reference/commands.md").read_text()
    whole = typer.main.get_command(app)
    options = {"--help", *(option for p in whole.params for option in p.opts)}
    for name, command in whole.commands.items():
        for part, inner in getattr(command, "commands", {"": command}).items():
            words = f"{name} {part}".strip()
            assert re.search(rf"^\| `{words}[` ]", text, re.MULTILINE), words
            shown = (p for p in inner.params if not getattr(p, "hidden", False))
            options |= {option for p in shown for option in p.opts if option[:2] == "--"}
    assert set(re.findall(r"(?<![\w-])--[a-z][a-z-]*", text)) == options


def test_every_how_to_is_in_the_list_of_them():
    listed = (DOCS / "how-to/README.md").read_text()
    for page in sorted((DOCS / "how-to").glob("*.md")):
        assert f"{page.stem}.md" in listed or page.stem == "README"


def test_the_readings_of_the_docs_are_those_of_the_report():
    text = (PROJECT / "docs/explanation/reproduction.md").read_text(encoding="utf-8")
    shown = [line for line in text.splitlines() if line.startswith("| ")][1:]
    readings = published("readings").itertuples(index=False)
    assert shown == ["| " + " | ".join(c.replace("|", r"\|") for c in r) + " |" for r in readings]


def anchors(page: Path) -> set[str]:
    """What a link into a page can name: its headings, as GitHub spells them."""
    headings = re.findall(r"^#+ (.*)", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", h).strip().lower().replace(" ", "-") for h in headings}


def test_links_of_the_docs_lead_somewhere():
    for page in LINKING:
        for target in re.findall(r"\]\((?!http)([^)]+)", page.read_text()):
            path, _, heading = target.partition("#")
            to = page.parent / path if path else page
            assert to.exists(), f"{page}: {target}"
            assert not heading or heading in anchors(to), f"{page}: {target}"


def test_the_project_names_no_path_and_no_index_of_its_maker():
    lists = subprocess.run(
        ["git", "ls-files"], cwd=PROJECT, capture_output=True, text=True, check=True
    )
    for name in lists.stdout.split():
        path = PROJECT / name
        linked = path.is_dir()  # a link to a folder whose files are listed, too
        if linked or path.suffix in BINARY or name == "tests/integration/test_docs.py":
            continue
        found = re.search(r"--(extra-)?index-url|/simple/|\.\./shared", path.read_text())
        assert not found, f"{name}: {found}"
