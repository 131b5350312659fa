"""The benchmarks still run; how fast anything is, no test asserts."""

from collections import defaultdict
from dataclasses import replace

import pytest

from benchmarks.__main__ import CASES
from benchmarks.cases import Bench
from benchmarks.goals import GOALS, judged
from benchmarks.processes import served
from benchmarks.soak import FAULTS, soak


@pytest.fixture
def bench(tmp_path):
    with served() as server:
        yield Bench(tmp_path, server)


def test_cases_are_measured_and_every_goal_is_about_cases_that_are_run(bench):
    cases = {case.name: case for case in CASES}
    cases["recording 110 short"].measure(bench)
    for name in ("floor, cached", "replay of 110 short", "--help"):
        assert cases[name].measure(bench)["wall_s"] > 0
    anything = [defaultdict(lambda: 1.0)]
    assert [goal for goal, _ in judged(dict.fromkeys(cases, anything))] == list(GOALS)


def test_a_soak_is_killed_and_counts_what_its_server_saw(bench, monkeypatch):
    half = {fault: rate / 2 for fault, rate in FAULTS.rates.items()}
    monkeypatch.setattr("benchmarks.soak.FAULTS", replace(FAULTS, rates=half))
    figures = soak(2, lives_s=0.5)(bench)
    assert figures["kills"] > 0
    assert figures["requests"] > figures["calls_made"] > 2 * 8
    assert figures["answered_asked_again"] == figures["attempts_made_twice"] == 0
    paid = figures["spent_usd"]
    assert 0 < paid == pytest.approx(figures["quiet_billed_usd"])
    assert paid <= figures["billed_usd"] <= paid + figures["set_aside_usd"]
    assert figures["digest_differs"] == 0
