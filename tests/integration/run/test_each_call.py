"""What each further call of a trial takes: counted, since times differ from machine to machine."""

import re
import sqlite3
import sys
import threading
from collections import Counter
from pathlib import Path

import pytest

import merge_runner
from merge_runner.run.local_runner import LocalRunner
from merge_runner.run.options import Options
from merge_runner.run.plan import make_plan
from merge_runner.run.replay import Replay
from tests.support.harness import PROJECT, a_model, run_sweep

# Of a call under a cap, and of one whose reply is recorded, by what is counted.
BOUNDS = {
    "changes of file": {"live": 75, "replayed": 39.5},
    "functions": {"live": 212, "replayed": 147},
    "statements": {"live": 8, "replayed": 1},
    "on the event loop": {"live": 1, "replayed": 1},
    "commits": {"live": 1, "replayed": 0},
}
PRICE = {"input": 1.0, "output": 1.0, "source": "contract"}
FEW_S, MANY_S = 3, 8  # in each of which both drivers ask

ROOT = f"{Path(merge_runner.__file__).parent}/"
# What shows, checks, answers or stores is no part of the way of a call, nor is what it calls.
ELSEWHERE = (
    "audit/",
    "cli/",
    "emulator/",
    "planted_effect.py",
    "results/database.py",
    "results/instance.py",
    "run/progress.py",
    "run/progress_file.py",
    "run/writer.py",
)


def drawn_path(way: str) -> set[str]:
    """The files of ``llm`` on the path of a call, live or replayed, in docs/design.md."""
    _, _, text = (PROJECT / "docs/design.md").read_text().partition("## The path of a call")
    return set(re.findall(r"llm/[\w/]+\.py", text.split("```")[1 if way == "live" else 3]))


class Counts:
    """What is done while a trial is played and stored, ``of`` each kind."""

    def __init__(self) -> None:
        self.begin()
        self.under_way = False

    def begin(self) -> None:
        """Count from 0."""
        self.of: dict[str, Counter[str]] = {name: Counter() for name in BOUNDS}
        self._file: dict[int, str] = {}  # by thread, in which it is
        self._elsewhere: Counter[int] = Counter()  # how many calls deep, by thread
        self.under_way = True

    def profile(self, frame, event, _) -> None:
        """Count a function that begins or goes on, and each change to another file, or back."""
        code, thread = frame.f_code, threading.get_ident()
        file = code.co_filename.removeprefix(ROOT)
        if file == code.co_filename:
            return
        if file.startswith(ELSEWHERE):
            self._elsewhere[thread] += {"call": 1, "return": -1}.get(event, 0)
            return
        if not self.under_way or self._elsewhere[thread] > 0:
            return
        if event == "call":
            self.of["functions"][f"{file} {code.co_qualname}"] += 1
        before = self._file.get(thread, file)
        self.of["changes of file"][f"{before} -> {file}"] += before != file
        self._file[thread] = file

    def statement(self, sql: str) -> None:
        """Count a statement, or one of a trigger."""
        if not self.under_way:
            return
        sql = " ".join(sql.partition("'")[0].split())
        self.of["statements"][sql] += 1
        self.of["commits"][sql] += sql == "COMMIT"
        on_the_loop = threading.current_thread() is threading.main_thread()
        self.of["on the event loop"][sql] += on_the_loop


@pytest.fixture
def counted(monkeypatch, tmp_path):
    """Plays one trial of so many seconds, and returns the number of its calls and its counts."""
    monkeypatch.delenv("EMULATOR_BASE_URL", raising=False)
    (tmp_path / "models.toml").write_text(a_model("priced", price=PRICE))
    connect, counts = sqlite3.connect, Counts()

    def connected(*args, **kwargs):
        connection = connect(*args, **kwargs)
        connection.set_trace_callback(counts.statement)
        return connection

    def counting(play):
        async def playing(*args, **kwargs):
            counts.begin()
            return await play(*args, **kwargs)

        return playing

    async def run(seconds: int, *, replay: bool) -> tuple[int, dict[str, Counter[str]]]:
        study = tmp_path / f"{seconds}.toml"
        study.write_text(f"repetitions = {{ baseline = 1 }}\nscenario.timeout_s = {seconds}\n")
        plan = make_plan(str(study), "priced", conditions=["L_4_0"], trust=True)
        db, cache = tmp_path / f"{seconds}-{replay}.duckdb", tmp_path / f"{seconds}"
        options = Options(db, cache, max_cost_usd=100.0, quiet=True, replay=replay)
        summary = await run_sweep(plan, options, say=lambda _: None)
        counts.under_way = False
        return summary["calls"]["cached" if replay else "live"], counts.of

    monkeypatch.setattr(sqlite3, "connect", connected)
    monkeypatch.setattr(LocalRunner, "play", counting(LocalRunner.play))
    # A replay begins with the trials before the first reply, and does not play them again.
    monkeypatch.setattr(Replay, "look_ahead", counting(Replay.look_ahead))
    # Threads outlive a run.
    threading.setprofile(counts.profile)
    sys.setprofile(counts.profile)
    yield run
    sys.setprofile(None)
    threading.setprofile(None)


async def test_a_further_call_takes_no_more_than_it_did(counted):
    for way in ("live", "replayed"):
        # The first one loads what is loaded once.
        plays = [await counted(s, replay=way == "replayed") for s in (FEW_S - 1, FEW_S, MANY_S)]
        (few_calls, few), (many_calls, many) = plays[1:]
        calls = many_calls - few_calls
        assert calls == 2 * (MANY_S - FEW_S)
        found, told = {}, []
        for name in BOUNDS:
            more = Counter(many[name])
            more.subtract(few[name])
            found[name] = more.total() / calls
            told += [f"{way}, {name}: {found[name]:.1f}, at most {BOUNDS[name][way]}"]
            told += [f"{n / calls:8.1f} {each}" for each, n in more.most_common() if n]
        entered = {each.split()[0] for each in many["functions"] - few["functions"]}
        assert {file for file in entered if file.startswith("llm/")} == drawn_path(way)
        too_many = [name for name, n in found.items() if n > BOUNDS[name][way]]
        assert not too_many, "\n".join(told)
