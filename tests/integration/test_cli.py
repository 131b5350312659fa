"""The command line: its menu, its errors, its outputs."""

from __future__ import annotations

import csv
import fcntl
import io
import json
import os
import pty
import struct
import subprocess
import termios
from contextlib import suppress
from importlib.metadata import entry_points
from pathlib import Path
from types import SimpleNamespace

import pytest
import typer.main
from typer.testing import CliRunner

import merge_runner as package
from merge_runner.cli import commands
from merge_runner.cli.app import alone
from merge_runner.run.plan import Options
from merge_runner_analysis.commands import app
from tests.support.harness import PROGRAM, environment

COMMANDS = {
    *("sweep", "replay", "sql", "digest", "models", "emulate", "recording", "audit"),
    *("tables", "figures", "report", "explain", "human", "ledger", "view"),
    *("init", "export", "forget", "power"),
}
# The promised options; more may be there.
SWEEP_OPTIONS = {
    *("--model", "--reps", "--conditions", "--variants", "--sample-set", "--db", "--cache"),
    *("--in-flight", "--rpm", "--tpm", "--max-cost", "--dry-run", "--yes", "--replay", "--json"),
    *("--dask", "--strict-model", "--order-seed", "--first", "--grid"),
}


def test_the_menu_is_what_was_promised():
    command = typer.main.get_command(app)
    assert set(command.commands) == COMMANDS
    options = {o for p in command.commands["sweep"].params for o in p.opts}
    assert options >= SWEEP_OPTIONS
    assert set(command.commands["recording"].commands) == {"export", "import", "verify", "info"}
    assert package.__all__ == ["Study", "StudyOutcome", "__version__"]
    assert [e.value for e in entry_points(name="merge-runner")] == ["merge_runner.__main__:main"]


def help_of(command: typer.main.TyperCommand) -> str:
    return command.get_help(command.make_context("merge-runner", [], resilient_parsing=True))


def test_a_command_has_its_options_where_those_of_the_others_are_left_out():
    whole = typer.main.get_command(app)
    for name, command in whole.commands.items():
        light = typer.main.get_command(alone(name))
        assert help_of(light.commands[name]) == help_of(command)
        assert help_of(light) == help_of(whole)


def every_command(command, path=()):
    yield path, command
    for name, inner in getattr(command, "commands", {}).items():
        yield from every_command(inner, (*path, name))


def test_every_option_of_a_sweep_reaches_its_plan_or_its_run(monkeypatch):
    planned, played = [], []
    plan = SimpleNamespace(ledger="a ledger", replays_humans=False)
    made = lambda *names, **more: planned.append((names, more)) or plan  # noqa: E731
    monkeypatch.setattr("merge_runner.run.plan.make_plan", made)
    monkeypatch.setattr(commands, "_play", lambda *given, **more: played.append((given, more)) or 0)
    words = """sweep mine --first --grid h=0:1:1,dv=0:1:1 --model o3 --only temperature=0.2 --mirror
        --reps 3 --conditions N_0_0,L_4_8 --variants A1 --sample-set 4 --order-seed 5 --db d
        --cache c --in-flight 6 --rpm 7 --tpm 8 --max-cost 9 --dask local:2 --batch --strict-model
        --keep-going --yes --trust --quiet --json"""
    assert CliRunner().invoke(app, words.split()).exit_code == 0
    assert CliRunner().invoke(app, ["replay", "mine", "--recording", "r.parquet"]).exit_code == 0
    first, second = planned
    assert first == (
        ("mine", ["o3"], 3, ["N_0_0", "L_4_8"], ["A1"]),
        {
            "sample_set": 4, "order_seed": 5, "only": {"temperature": ["0.2"]}, "db": Path("d"),
            "mirror": True, "first": True, "grid": "h=0:1:1,dv=0:1:1", "trust": True,
        },
    )  # fmt: skip
    assert second[0] == ("mine", (), None, None, None)
    (given, how), (replayed, _) = played
    assert how == {"whole": True, "dry_run": False, "yes": True, "as_json": True}
    common = {"typed": given[1].typed}
    assert given == (plan, Options(
        Path("d"), Path("c"), 6, 7, 8, 9, strict_model=True, keep_going=True, quiet=True,
        dask="local:2", batch=True, **common,
    ))  # fmt: skip
    assert (replayed[1].replay, replayed[1].recordings) == (True, [Path("r.parquet")])


@pytest.mark.parametrize("columns", [80, 100])
def test_every_help_has_a_short_form_and_cuts_no_line(columns):
    for path, _ in every_command(typer.main.get_command(app)):
        run = CliRunner().invoke(app, [*path, "-h"], env={"COLUMNS": str(columns)})
        assert run.exit_code == 0, path
        for line in run.output.splitlines()[1:]:
            assert len(line) <= columns, (path, line)
            assert not line.endswith("..."), (path, line)


def test_every_command_that_prints_a_result_prints_it_as_json():
    silent = {"init", "export", "forget", "emulate", "figures", "report", "view"}
    silent |= {"recording export", "recording import", "recording verify"}
    silent.add("human import")
    for path, command in every_command(typer.main.get_command(app)):
        if hasattr(command, "commands") or " ".join(path) in silent:
            continue
        assert any("--json" in parameter.opts for parameter in command.params), path


async def test_the_json_of_tables_sql_digest_and_models_can_be_read(merge_runner):
    assert (await merge_runner("sweep", "baseline", "--model", "constant", "--reps", 1)).code == 0
    for arguments in (["tables", "gap"], ["sql", "from trials"], ["digest"], ["models"]):
        assert json.loads((await merge_runner(*arguments, "--json")).out), arguments


def on_a_terminal(folder, *command):
    """What a command prints on a terminal of 80 columns."""
    ours, its = pty.openpty()
    fcntl.ioctl(its, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
    env = {name: value for name, value in environment().items() if name != "COLUMNS"}
    with open(ours, "rb", buffering=0) as terminal:
        process = subprocess.Popen([PROGRAM, *command], cwd=folder, env=env, stdout=its)
        os.close(its)
        text = b""
        with suppress(OSError):  # its other end is closed
            while part := terminal.read(4096):
                text += part
    assert process.wait() == 0
    return text.decode().splitlines()


@pytest.mark.slow
async def test_a_table_fits_the_terminal_and_is_whole_elsewhere(merge_runner, tmp_path):
    assert (await merge_runner("sweep", "baseline", "--model", "constant", "--reps", 1)).code == 0
    whole = (await merge_runner("tables", "indicators")).out.splitlines()
    assert max(map(len, whole)) > 80
    lines = on_a_terminal(tmp_path, "tables", "indicators")
    assert max(map(len, lines)) <= 80
    assert any("so without" in line for line in lines)


async def test_a_quiet_sweep_shows_no_progress(merge_runner):
    arguments = ("sweep", "baseline", "--model", "constant", "--reps", 1)
    quiet = await merge_runner(*arguments, "--quiet")
    assert (quiet.code, quiet.err) == (0, "")
    assert "audited: 11 trials" in quiet.out


@pytest.mark.parametrize(
    ("typed", "completed"),
    [
        ("sw", "sweep"),
        ("sweep baseline --ord", "--order-seed"),
        ("tables indi", "indicators"),
    ],
)
async def test_the_shell_completes_commands_options_and_names(merge_runner, typed, completed):
    words = f"merge-runner {typed}"
    asks = {"COMP_WORDS": words, "COMP_CWORD": str(len(words.split()) - 1)}
    run = await merge_runner(_MERGE_RUNNER_COMPLETE="complete_bash", **asks)
    assert run.out.split() == [completed]


async def test_a_mistyped_name_is_answered_with_the_nearest(merge_runner):
    assert (await merge_runner("sweep", "baseline", "--model", "constant", "--reps", 1)).code == 0
    for arguments, near in (
        (["sweep", "basline"], "baseline"),
        (["sweep", "baseline", "--model", "emulater"], "emulator"),
        (["sweep", "baseline", "--conditions", "N_0_1"], "N_0_0"),
        (["sweep", "baseline", "--variants", "basline"], "baseline"),
        (["tables", "who-frst"], "who-first"),
        (["tables", "gap", "--models", "constnt"], "constant"),
        (["explain", "gap", "constant/baseline/intercept:nn"], "n"),
        (["explain", "gap", "constant/baseline/intercep"], "constant/baseline/intercept"),
    ):
        run = await merge_runner(*arguments)
        assert run.code == 2
        assert f". Did you mean {near}" in run.err


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["swep"], "Did you mean 'sweep'?"),
        (["sweep"], "Missing argument 'NAME...'"),
        (["sweep", "baseline", "--reps", "x"], "--reps"),
        (["sweep", "baseline", "--reps", "0"], "--reps is a whole number from 1"),
        (["sweep", "nope"], "valid: ablations, baseline"),
        (["sweep", "none.toml"], "none.toml cannot be read: No such file"),
        (["sweep", "baseline", "--model", "gpt9"], "valid: emulator, random, o3"),
        (["sweep", "baseline", "--model", "o3+gpt9"], "unknown model 'gpt9'"),
        (["sweep", "baseline", "--conditions", "X"], "valid: R_-4_-8"),
        (["sweep", "baseline", "--variants", "A1"], "With --reps N"),
        (["sweep", "baseline", "--in-flight", "0"], "--in-flight"),
        (["sweep", "baseline", "--in-flight", "99999999"], "ulimit"),
        (["sweep", "baseline", "--rpm", "0"], "--rpm"),
        (["sweep", "baseline", "--sample-set", "-1"], "--sample-set"),
        (["sweep", "baseline", "--recording", "x.parquet"], "recording import"),
        (["replay", "baseline", "--recording", "x.parquet"], "there is no recording x.parquet"),
        (["sql", "select 1"], "there is no database results/merge.duckdb"),
        (["digest", "--db", "no.duckdb"], "there is no database no.duckdb"),
        (["sql", "select 1", "--format", "xml"], "csv"),
        (["recording", "export", "x.parquet"], "there is no database"),
        (["ledger", "--cache", "none"], "there is no cache in none"),
        (["tables"], "there is no database"),
        (["tables", "--format", "xml"], "latex"),
        (["report"], "there is no database"),
        (["figures", "--db", "no.duckdb"], "there is no database no.duckdb"),
        (["explain", "gap"], "Missing argument 'ROW'"),
    ],
)
async def test_bad_input_exits_2_with_a_clear_line_and_no_traceback(merge_runner, arguments, says):
    run = await merge_runner(*arguments)
    assert run.code == 2
    assert says in run.err
    assert "Traceback" not in run.err
    assert len(run.err.strip().splitlines()) <= 4


async def test_debug_shows_the_traceback(merge_runner):
    run = await merge_runner("sweep", "nope", "--debug")
    assert run.code != 0
    assert "Traceback" in run.err


async def test_sql_prints_text_csv_and_json_alike(merge_runner):
    assert (await merge_runner("sweep", "baseline", "--model", "constant", "--reps", 1)).code == 0
    sql = "select condition, count(*) as n from trials group by all order by all limit 2"
    text = (await merge_runner("sql", sql)).out
    assert [line.split() for line in text.splitlines()] == [
        ["condition", "n"], ["L_0_-8", "1"], ["L_2_-8", "1"],
    ]  # fmt: skip
    table = list(csv.reader(io.StringIO((await merge_runner("sql", sql, "--format", "csv")).out)))
    assert table == [["condition", "n"], ["L_0_-8", "1"], ["L_2_-8", "1"]]
    records = json.loads((await merge_runner("sql", sql, "--format", "json")).out)
    assert records == [{"condition": "L_0_-8", "n": 1}, {"condition": "L_2_-8", "n": 1}]


async def test_models_lists_keys_prices_and_shutdown_dates(merge_runner):
    out = (await merge_runner("models", OPENAI_API_KEY="k")).out
    o3 = next(line for line in out.splitlines() if line.startswith("o3 ")).split()
    assert o3[:7] == ["o3", "openai", "set", "2", "8", "2026-12-11", "o3-2025-04-16"]
    gemini = next(line for line in out.splitlines() if line.startswith("gemini-2.5-pro ")).split()
    assert gemini[2] == "missing"
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
