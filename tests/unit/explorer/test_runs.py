"""What a page says of a run, by what is stored of it and what its process tells."""

from __future__ import annotations

from datetime import datetime

import pytest

from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner_analysis.explorer.pages.sweep import duration, run_of

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
ALL = "Finished: all 33 trials ended"


@pytest.mark.parametrize(
    ("changes", "kind", "text", "command"),
    [
        ({}, "finished", f"{ALL}, and no problems were found.", ""),
        (
            {"ended": 30},
            "stopped",
            "It had finished, but the database holds only 30 of its 33 trials.",
            "",
        ),
        (
            {"exit_code": None, "ended_at": None, "ended": 30},
            "stopped",
            "Stopped without a word: its process is gone, or frozen. 30 of 33 trials are stored.",
            TYPED,
        ),
        (
            {"exit_code": 130, "ended": 30},
            "stopped",
            "Stopped: it was interrupted (Ctrl-C). 30 of 33 trials have an outcome.",
            TYPED,
        ),
        (
            {"exit_code": 3, "ended": 30},
            "stopped",
            "Stopped: the account's quota or --max-cost was used up. 30 of 33 trials have an "
            "outcome.",
            TYPED,
        ),
        (
            {"exit_code": 4, "ended": 30, "failed": 3},
            "stopped",
            "Stopped: a replay makes no calls, and some replies are not recorded. 30 of 33 trials "
            "have an outcome, 3 failed.",
            "",
        ),
        (
            {"exit_code": 1, "ended": 31, "failed": 2},
            "stopped",
            "Ended: 31 of 33 trials have an outcome, 2 failed.",
            TYPED,
        ),
        (
            {"exit_code": 1, "ended": 31},
            "stopped",
            "Stopped by an error that it printed: 31 of 33 trials have an outcome.",
            TYPED,
        ),
        (
            {"exit_code": 1},
            "stopped",
            "Ended with faults: 33 of 33 trials have an outcome, but what is stored does not hold "
            "together. See: merge-runner audit --sweep s",
            "",
        ),
        (
            {"faults": 5, "invalid": 1},
            "finished",
            f"{ALL}; on the way: failed attempts 5, invalid replies 1.",
            "",
        ),
        (
            {"others": 7},
            "doubtful",
            f"{ALL}, and no problems were found; but another model gave 7 answers.",
            "",
        ),
        (
            {"invalid": 8},
            "doubtful",
            f"{ALL}; not judged: 8 of the 9 decisions of o3 are invalid (88.9 %, more than 20 %).",
            "",
        ),
    ],
    ids=lambda value: str(value) if isinstance(value, dict) else "",
)
def test_a_run_says_how_it_ended_and_what_goes_on_with_it(changes, kind, text, command):
    run = run_of(ROW | changes, CONFIG, None)
    assert (run["kind"], run["text"], run["command"]) == (kind, text, command)
    assert run["lasted_s"] == (3600 if run["last_word"] else None)
    assert run_of(ROW | changes, CONFIG | {"typed": []}, None)["command"] == ""
    assert run_of(ROW | changes, CONFIG, None, later="later")["command"] == ""


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(99.4, "99 s"), (100, "2 min"), (5_399, "90 min"), (5_400, "1.5 h")],
)
def test_a_time_span_is_said_in_one_unit(seconds, text):
    assert duration(seconds) == text
