"""The command line: its outputs in every form, at a terminal and elsewhere."""

import csv
import fcntl
import io
import json
import os
import pty
import re
import shlex
import struct
import subprocess
import sys
import termios
from contextlib import suppress
from itertools import chain
from queue import Queue

import pytest
import typer.main
from typer.testing import CliRunner

from merge_runner.cli import complete_app
from merge_runner_analysis.commands import open_browser
from merge_runner_analysis.tables import TABLES
from tests.support import program
from tests.support.harness import PROGRAM, environment
from tests.support.program import every_command
from tests.support.studies import damage


@pytest.fixture
def run(golden):
    """Runs a command that reads the golden study."""

    def run(*arguments, **changes):
        return program.invoke(arguments, cwd=golden, env=environment(**changes))

    return run


DB = ("--db", "golden.duckdb")
SQL = "select condition, count(*) as n from trials group by all order by all limit 2"


def test_every_help_has_a_short_form_and_cuts_no_line():
    for path, _ in every_command(typer.main.get_command(complete_app())):
        run = CliRunner().invoke(complete_app(), [*path, "-h"], env={"COLUMNS": "80"})
        assert run.exit_code == 0, path
        for line in run.output.splitlines()[2:]:  # the usage goes first
            assert len(line) <= 80, (path, line)
            assert not line.endswith(("...", "…")), (path, line)


def groups_of(shown):
    """The titles of the groups of a help, each with its first words."""
    groups = {}
    for line in shown.splitlines():
        if title := re.fullmatch(r"(\w.*):", line):
            groups[title[1]] = words = []
        elif groups and line.startswith("  ") and line[2] != " ":
            words.append(line.split()[0])
    return groups


def test_the_menu_and_the_options_of_a_sweep_are_in_groups():
    menu = groups_of(CliRunner().invoke(complete_app(), ["-h"]).output)
    assert [*menu][-4:] == ["Play", "Look", "Keep", "Check"]
    assert {"sweep", "replay", "init", "power"} <= {*menu["Play"]}
    assert {"tables", "explain", "figures", "report", "view", "sql"} == {*menu["Look"]}
    assert {"recording", "export", "forget", "human"} == {*menu["Keep"]}
    assert {"audit", "digest", "ledger"} == {*menu["Check"]}
    options = groups_of(CliRunner().invoke(complete_app(), ["sweep", "-h"]).output)
    assert len(options) > 5
    assert "Options" not in options or options["Options"] == ["-h,"]
    assert {"--max-cost", "--dry-run", "--rpm"} <= {*options["Money and pace"]}
    replay = groups_of(CliRunner().invoke(complete_app(), ["replay", "-h"]).output)
    assert {*replay["Money and pace"]} == {"--dry-run", "--show-prompts"}
    assert {*chain(*options.values())} > {*chain(*replay.values())}


def test_every_command_has_an_example_that_it_can_read():
    for path, command in every_command(typer.main.get_command(complete_app())):
        if not hasattr(command, "commands"):
            (example,) = re.findall("^Example: (.*)$", command.help, re.MULTILINE)
            words = shlex.split(example)
            assert words[: 1 + len(path)] == ["merge-runner", *path]
            command.make_context(path[-1], words[1 + len(path) :])


def test_the_help_of_tables_names_each_of_them():
    shown = CliRunner().invoke(complete_app(), ["tables", "-h"]).output
    assert {*TABLES} <= {*re.findall(r"[\w-]+", " ".join(shown.split()))}


def test_the_json_of_tables_sql_digest_and_models_can_be_read(run):
    for words in (
        ("tables", "gap", *DB),
        ("sql", "from trials", *DB),
        ("digest", *DB),
        ("models",),
    ):
        assert json.loads(run(*words, "--json").out), words


def test_a_table_fits_the_terminal_and_is_whole_elsewhere_and_with_wide(run, golden):
    whole = run("tables", "indicators", *DB).out.splitlines()
    assert max(map(len, whole)) > 80
    assert at_a_terminal("tables", "indicators", "--wide", *DB, cwd=golden) == whole
    lines = at_a_terminal("tables", "indicators", *DB, cwd=golden)
    assert max(map(len, lines)) <= 80
    assert any("hidden: --wide" in line for line in lines)


def at_a_terminal(*words, cwd):
    """The lines that a command prints at a terminal of 80 columns."""
    ours, its = pty.openpty()
    fcntl.ioctl(its, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
    env = {name: value for name, value in environment().items() if name != "COLUMNS"}
    with open(ours, "rb", buffering=0) as terminal:
        process = subprocess.Popen([PROGRAM, *words], cwd=cwd, env=env, stdout=its)
        os.close(its)
        text = b""
        with suppress(OSError):  # its other end is closed
            while part := terminal.read(4096):
                text += part
    assert process.wait() == 0
    return text.decode().splitlines()


ENDED = """
import atexit, gc, sys
from merge_runner import cli
from merge_runner.__main__ import main

class Kept:
    def __del__(self):
        print("freed")

def run():
    atexit.register(print, "registered")
    before = gc.get_stats()[0]["collections"]
    kept.some = [[] for _ in range(50_000)]
    print("collections:", gc.get_stats()[0]["collections"] - before)
    sys.exit({code!r})

kept, cli.main = Kept(), run
main()
"""


@pytest.mark.parametrize(
    ("code", "ends"), [(3, (3, "", "")), (0, (0, "", "")), ("a text", (1, "a text\n", "freed\n"))]
)
def test_the_program_collects_no_garbage_and_ends_by_its_code_after_what_is_registered(code, ends):
    ended = subprocess.run(
        [sys.executable, "-c", ENDED.format(code=code)], capture_output=True, text=True, check=False
    )
    out = ended.stdout.removeprefix("collections: 0\nregistered\n")
    assert (ended.returncode, ended.stderr, out) == ends


def test_explain_shows_the_trials_that_a_share_counts_and_with_all_the_others(run):
    cell = ("explain", "ablation-quantitative", "smollm2/baseline:collided_percent", *DB)
    (source,) = json.loads(run(*cell, "--json").out)["sources"]
    counted = [f"* {trial}" for trial in source["numerator"]]
    others = {*source["trials"]} - {*source["numerator"]}
    lines = run(*cell).out.splitlines()
    assert lines[-len(counted) - 1 :] == [*counted, f"and {len(others)} others: --all"]
    lines = run(*cell, "--all").out.splitlines()
    assert {line.strip() for line in lines[-len(others) :]} == others


def test_explain_without_a_row_lists_rows_and_columns(run):
    of_table = ("explain", "ablation-quantitative", *DB)
    names = json.loads(run(*of_table, "--json").out)
    assert "smollm2/baseline" in names["rows"]
    assert "collided_percent" in names["columns"]
    *rows, columns = run(*of_table).out.splitlines()
    assert rows == names["rows"]
    assert columns.endswith(", ".join(names["columns"]))


def test_a_driver_is_found_by_its_name_without_the_endpoint_where_one_has_it(golden_copy):
    elsewhere = "replace(spec::VARCHAR, '\"local\"', '\"http://localhost:8123/v1\"')::JSON"
    db = golden_copy / "golden.duckdb"
    damage(db, f"UPDATE specs SET spec = {elsewhere}")
    words = ("tables", "attempts", "--format", "csv", "--db", db, "--models")
    found = program.invoke((*words, "smollm2"), cwd=golden_copy, env=environment())
    assert "\nsmollm2 at localhost:8123/baseline," in found.out, found.err
    unknown = program.invoke((*words, "smollm"), cwd=golden_copy, env=environment())
    assert (unknown.code, "smollm2 at localhost:8123" in unknown.err) == (2, True)


def test_a_browser_opens_where_there_is_a_screen_and_a_terminal_alone(monkeypatch):
    opened = Queue()
    monkeypatch.setattr("webbrowser.open", opened.put)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr("sys.platform", "linux")
    for screen, terminal in (("", True), (":0", False), (":0", True)):
        monkeypatch.setenv("DISPLAY", screen)
        monkeypatch.setattr("sys.stdout.isatty", lambda terminal=terminal: terminal)
        assert open_browser("http://127.0.0.1:1/") == bool(screen and terminal)
    assert opened.get(timeout=5) == "http://127.0.0.1:1/"
    assert opened.empty()


async def test_a_quiet_sweep_shows_no_progress(merge_runner):
    quiet = await merge_runner("sweep", "baseline", "--model", "constant", "--reps", 1, "--quiet")
    assert (quiet.code, quiet.err) == (0, "")
    assert quiet.out.startswith("trials: 11 (")


@pytest.mark.parametrize(
    ("typed", "completed"),
    [("sw", "sweep"), ("sweep baseline --ord", "--order-seed"), ("tables indi", "indicators")],
)
def test_the_shell_completes_commands_options_and_names(run, typed, completed):
    words = f"merge-runner {typed}"
    asks = {"COMP_WORDS": words, "COMP_CWORD": str(len(words.split()) - 1)}
    completing = run(_MERGE_RUNNER_COMPLETE="complete_bash", **asks)
    assert completing.out.split() == [completed]


@pytest.mark.parametrize(
    ("words", "near"),
    [
        ("tables who-frst", "who-first"),
        ("tables gap --models idmm", "idm"),
        ("explain gap idm/baseline/intercept:nn", "n"),
        ("explain gap idm/baseline/intercep", "idm/baseline/intercept"),
    ],
)
def test_a_mistyped_name_in_results_is_answered_with_the_nearest(run, words, near):
    done = run(*words.split(), *DB)
    assert done.code == 2
    assert f". Did you mean {near}" in done.err


def test_sql_prints_text_csv_and_json_alike(run):
    text = [line.split() for line in run("sql", SQL, *DB).out.splitlines()]
    assert text[0] == ["condition", "n"]
    table = run("sql", SQL, *DB, "--format", "csv").out
    assert list(csv.reader(io.StringIO(table))) == text
    records = json.loads(run("sql", SQL, *DB, "--format", "json").out)
    assert [[row["condition"], str(row["n"])] for row in records] == text[1:]
    assert len(records) == 2


def test_models_lists_keys_prices_and_shutdown_dates(run):
    out = run("models", OPENAI_API_KEY="k").out
    rows = {line.split()[0]: line.split() for line in out.splitlines() if line}
    assert rows["o3"][:7] == ["o3", "openai", "set", "2", "8", "2026-12-11", "o3-2025-04-16"]
    assert rows["gemini-2.5-pro"][2] == "missing"
    assert "k" not in out.replace("OPENAI_API_KEY", "").split()


@pytest.mark.parametrize(
    "command", [["models"], ["sweep", "baseline", "--model", "a", "--dry-run"]]
)
async def test_models_and_dry_runs_say_that_a_model_has_closed_and_what_comes_after_it(
    merge_runner, tmp_path, command
):
    given = 'provider = "openai"\nformat = "openai-chat"\nid = "m"\nmax_output_tokens = 100\n'
    (tmp_path / "models.toml").write_text(
        f'[a]\n{given}shutdown = 2020-01-31\nsuccessor = "b"\n[b]\n{given}shutdown = 9999-01-31\n'
    )
    lines = (await merge_runner(*command)).err.splitlines()
    (closed,) = [line for line in lines if line.startswith("WARNING: a ")]
    assert "a closed on 2020-01-31" in closed
    assert closed.endswith("its successor is b")
    far = any(line.startswith("note: b closes in") for line in lines)
    assert far == (command == ["models"])
