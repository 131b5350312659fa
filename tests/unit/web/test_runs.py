"""What a page says of a run, by what is stored of it and what its process tells."""

from datetime import datetime

import pytest

from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner_analysis.web.phrases import duration
from merge_runner_analysis.web.runs import run_of
from tests.support.cases import cases

CONFIG = {
    "model": "o3",
    "arms": [{"repetitions": 3}],
    "conditions": list(CONDITIONS),
    "typed": ["sweep", "baseline", "--model", "o3", "--db", "my results.duckdb", "--max-cost", "9"],
}
TYPED = "merge-runner sweep baseline --model o3 --db 'my results.duckdb' --max-cost 9"
BEGIN, END = (datetime(2026, 11, 21, hour) for hour in (0, 1))  # noqa: DTZ001 # as it is stored
COUNTS = ("failed", "others", "invalid", "faults", "scripted")
ROW = dict.fromkeys(COUNTS, 0) | {"sweep_id": "s", "name": "baseline", "exit_code": 0, "trials": 1,
       "ended": 33, "asked": 9, "started_at": BEGIN, "ended_at": END}  # fmt: skip


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


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(99.4, "99 s"), (100, "2 min"), (5_399, "90 min"), (5_400, "1.5 h")],
)
def test_a_time_span_is_said_in_one_unit(seconds, text):
    assert duration(seconds) == text
