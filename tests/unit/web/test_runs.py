"""What a page says of a run, by what is stored of it and what its process tells."""

from datetime import datetime
from pathlib import Path

import pytest

from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner_analysis.web.phrases import duration
from merge_runner_analysis.web.runs import origin_of, run_of, without, words_here
from tests.support.cases import cases

CONFIG = {
    "model": "o3",
    "arms": [{"repetitions": 3}],
    "conditions": list(CONDITIONS),
    "typed": ["sweep", "baseline", "--model", "o3", "--db", "my results.duckdb", "--max-cost", "9"],
}
TYPED = "merge-runner sweep baseline --model o3 --max-cost 9 --db 'my results.duckdb'"
BEGIN, END = (datetime(2026, 11, 21, hour) for hour in (0, 1))  # noqa: DTZ001 # as it is stored
COUNTS = ("failed", "others", "invalid", "faults", "scripted")
ROW = dict.fromkeys(COUNTS, 0) | {"sweep_id": "s", "name": "baseline", "exit_code": 0, "trials": 1,
       "ended": 33, "asked": 9, "started_at": BEGIN, "ended_at": END,
       "db": Path("my results.duckdb")}  # fmt: skip


@pytest.mark.parametrize("case", cases("runs", "ended"))
def test_a_run_says_how_it_ended_and_what_goes_on_with_it(case):
    row = ROW | {name: value for name, value in case.items() if name in ROW}
    row |= dict.fromkeys(case.get("lacks", ()))
    run = run_of(row, CONFIG, None)
    command = TYPED if case.get("goes_on") else ""
    assert (run["kind"], run["text"], run["command"]) == (case["kind"], case["text"], command)
    assert run["lasted_s"] == (3600 if run["last_word"] else None)
    assert run_of(row, CONFIG | {"typed": []}, None)["command"] == ""
    assert run_of(row, CONFIG, None, later="later")["command"] == ""


def test_the_origin_of_a_run_says_only_what_is_stored():
    row = {"git_commit": None, "git_dirty": None, "versions": "{}"}
    models = {"o3": {"id": "o3"}, "own": {"id": "m", "provider": "local", "parameters": {"k": 2}}}
    assert origin_of({"row": row, "config": {"models": models}}) == [
        ("program", "unknown"), ("o3", "o3"), ("own", "m, local, k = 2")
    ]  # fmt: skip


def test_an_option_is_left_out_of_a_command_however_it_was_typed():
    words = ["sweep", "a.toml", "--db", "x", "--reps=2", "--db=y", "--grid", "h=-6:6:2", "--batch"]
    left = ["sweep", "a.toml", "--reps=2", "--grid", "h=-6:6:2", "--batch"]
    assert without("--db", words) == left
    assert without("--d", left) == left


@pytest.mark.parametrize(
    ("typed", "db", "words"),
    [
        ("study.toml", "mine/results/merge.duckdb", "mine/study.toml"),
        ("mine/study.toml", "results/merge.duckdb", "study.toml"),
        ("study.toml --db r.duckdb", "mine/r.duckdb", "study.toml --db mine/r.duckdb"),
        ("a.toml", "mine/results/merge.duckdb", "mine/experiments/a.toml"),
        ("gone.toml", "mine/r.duckdb", "gone.toml --db mine/r.duckdb"),
        ("baseline", "results/merge.duckdb", "baseline"),
        ("baseline", "mine/results/merge.duckdb", "baseline --db mine/results/merge.duckdb"),
    ],
)
def test_a_command_names_the_study_and_the_database_as_they_are_found_from_here(
    tmp_path, monkeypatch, typed, db, words
):
    monkeypatch.chdir(tmp_path)
    for name in ("study.toml", "mine/study.toml", "mine/experiments/a.toml"):
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Path(name).touch()
    assert words_here(["sweep", *typed.split()], Path(db)) == ["sweep", *words.split()]


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(99.4, "99 s"), (100, "2 min"), (5_399, "90 min"), (5_400, "1.5 h")],
)
def test_a_time_span_is_said_in_one_unit(seconds, text):
    assert duration(seconds) == text
