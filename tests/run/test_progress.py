"""What is shown while a sweep runs."""

from __future__ import annotations

import time
from collections import Counter
from types import SimpleNamespace

from merge_runner.llm.ledger import Spending
from merge_runner.llm.meter import Meter
from merge_runner.records import Attempt, Usage
from merge_runner.run.progress import Progress


def runner(*meters, running=0):
    named = {str(number): meter for number, meter in enumerate(meters)}
    return SimpleNamespace(meters=named, waits=(), running=running, workers=None)


def test_every_figure_is_that_of_the_meters():
    meters = [Meter(calls_live=30, calls_cached=12), Meter(calls_live=4)]
    meters[0].count_attempt(Attempt(1, "ok", usage=Usage(100, 0, 50), cost_usd=1.5))
    meters[1].count_attempt(Attempt(1, "timeout"))
    meters[1].mismatches["o3 -> gpt-4o"] = 2
    progress = Progress(
        title="t",
        total=10,
        expected_calls=184,
        runner=runner(*meters, running=5),
        cap_usd=20,
        ledger=SimpleNamespace(spending=Spending(spent_usd=4.0, reserved_usd=0.25)),
        done=Counter(finished=2, failed=1),
        stored_before=7,
        started=time.monotonic() - 60,
    )
    fields = dict(progress.fields())
    assert fields["trials"] == "3/10 ended (+7 stored before), 5 running"
    assert fields["failed"] == "1"
    assert fields["WARNING"] == "another model answers: o3 -> gpt-4o"
    assert fields["calls"] == "34 live, 12 from recordings"
    assert fields["rate"] == "2 requests/min, 150 tokens/min"
    assert fields["cost"] == "1.50 USD, 4.25 of 20 over all runs"
    # 3 of 10 trials have ended but only 46 of 184 calls are made: the larger share tells.
    assert fields["time"] == "60 s, about 140 s left"


def test_the_calls_tell_the_time_left_while_no_trial_has_ended():
    meter = Meter(calls_live=25)
    progress = Progress("t", 10, expected_calls=100, runner=runner(meter))
    progress.started = time.monotonic() - 10
    assert dict(progress.fields())["time"] == "10 s, about 30 s left"
    progress.runner = runner(Meter())
    assert dict(progress.fields())["time"] == "10 s"
