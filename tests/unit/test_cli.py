"""The command line: its menu, its help, and what becomes of its options."""

import asyncio
import signal
import sys
from functools import partial
from importlib import invalidate_caches
from importlib.metadata import entry_points
from pathlib import Path

import pytest
import typer.main
from typer.testing import CliRunner

import merge_runner as package
from merge_runner.cli import complete_app
from merge_runner.cli.app import GROUP, app_with_one_command
from merge_runner.cli.signals import on_signal
from merge_runner.run.options import Options
from tests.support.program import every_command

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
PRINT_NO_RESULT = {
    *("init", "export", "forget", "emulate", "figures", "report", "view", "human import"),
    *("recording export", "recording import", "recording verify"),
}
STUDY = """
conditions = ["N_0_0", "L_4_8"]
repetitions = { baseline = 1, A1 = 1 }
[factors]
temperature = [0.2, 1.0]
"""
WORDS = """sweep mine.toml --first --grid h=0:1:1,dv=0:1:1 --model emulator+constant --mirror
    --only temperature=0.2 --reps 3 --variants A1 --sample-set 4 --order-seed 5 --db d --cache c
    --in-flight 6 --rpm 7 --tpm 8 --max-cost 9 --dask local:2 --batch --strict-model --keep-going
    --yes --trust --quiet --json"""


def test_the_menu_is_what_was_promised():
    command = typer.main.get_command(complete_app())
    assert set(command.commands) == COMMANDS
    assert {o for p in command.commands["sweep"].params for o in p.opts} >= SWEEP_OPTIONS
    assert set(command.commands["recording"].commands) == {"export", "import", "verify", "info"}
    assert package.__all__ == ["Study", "StudyOutcome", "__version__"]
    assert all(hasattr(package, name) for name in package.__all__)
    assert [e.value for e in entry_points(name="merge-runner")] == ["merge_runner.__main__:main"]


def test_a_command_has_its_options_where_those_of_the_others_are_left_out():
    whole = complete_app()
    for name in typer.main.get_command(whole).commands:
        for words in ([name, "-h"], ["-h"]):
            apps = app_with_one_command(name), whole
            shown, same = (CliRunner().invoke(app, words).output for app in apps)
            assert shown == same
            assert "Usage:" in shown


def test_packages_name_their_commands_by_an_entry_point(tmp_path, monkeypatch):
    (tmp_path / "mine-1.dist-info").mkdir()
    named = f"[other]\na = other\n[{GROUP}]\nb = mine_b.commands\na=mine_a : x\n\n[z]\n"
    (tmp_path / "mine-1.dist-info/entry_points.txt").write_text(named)
    (tmp_path / "mine-1.dist-info/METADATA").write_text("Name: mine\n")
    monkeypatch.syspath_prepend(tmp_path)
    complete_app()  # neither of the two modules is there
    (tmp_path / "mine_a.py").write_text("import no_such_library")
    invalidate_caches()
    with pytest.raises(ModuleNotFoundError, match="no_such_library"):
        complete_app()


def test_every_command_that_prints_a_result_prints_it_as_json():
    for path, command in every_command(typer.main.get_command(complete_app())):
        if not hasattr(command, "commands") and " ".join(path) not in PRINT_NO_RESULT:
            assert any("--json" in parameter.opts for parameter in command.params), path


def test_every_option_of_a_sweep_reaches_its_plan_or_its_run(monkeypatch, tmp_path):
    """What is played in the end is held, and not played: it would take a cluster and money."""
    monkeypatch.chdir(tmp_path)
    Path("mine.toml").write_text(STUDY)
    played = []

    async def play(plan, options, *, whole, **_):
        played.append((plan, options, whole))
        return {"messages": [], "exit_code": 0}

    monkeypatch.setattr("merge_runner.run.sweep.play", play)
    words = WORDS.split()
    monkeypatch.setattr(sys, "argv", ["merge-runner", *words])
    assert CliRunner().invoke(complete_app(), words).exit_code == 0
    options = ("--conditions", "L_4_8", "--recording", "r.parquet", "--model", "emulator", "--json")
    assert CliRunner().invoke(complete_app(), ["replay", "mine.toml", *options]).exit_code == 0
    (plan, options, whole), (replayed, replaying, _) = played
    assert whole
    assert options == Options(
        Path("d"), Path("c"), 6, 7, 8, 9, strict_model=True, keep_going=True, quiet=True,
        dask="local:2", batch=True, typed=words, ledgers=[plan.ledger],
    )  # fmt: skip
    assert (plan.first, plan.sample_set, plan.order_seed) == ("first", 4, 5)
    assert (len(plan.conditions), plan.repetitions) == (4, {"A1": 3})
    assert {(arm.model, *arm.factors.values()) for arm in plan.arms} == {
        ("emulator+constant", "0.2"),
        ("constant+emulator", "0.2"),
    }
    assert (replayed.first, replayed.conditions, len(replayed.arms)) == ("", ("L_4_8",), 4)
    assert (replaying.replay, [*replaying.recordings]) == (True, [Path("r.parquet")])


async def test_a_terminal_that_closes_twice_stops_a_run_once_and_never_kills_it(monkeypatch):
    def recorded(number, handler):
        handlers.append((number, handler))
        return set_handler(number, handler)

    handlers, set_handler, stops = [], signal.signal, []
    monkeypatch.setattr(signal, "signal", recorded)
    monkeypatch.setattr("merge_runner.cli.signals._leave_terminal", lambda: None)
    before = set_handler(signal.SIGHUP, signal.SIG_DFL)
    try:
        with on_signal(partial(stops.append, "stop"), partial(stops.append, "drop")):
            for number in (signal.SIGHUP, signal.SIGHUP, signal.SIGTERM):
                signal.raise_signal(number)
            while not stops:
                await asyncio.sleep(0)
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        set_handler(signal.SIGHUP, before)
    assert stops == ["stop"]
    assert (signal.SIGHUP, signal.SIG_DFL) not in handlers
