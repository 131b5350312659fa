"""The benchmarks measure what they say; how fast anything is, no test asserts."""

from __future__ import annotations

import os

import pytest

from benchmarks.__main__ import CASES, tables
from benchmarks.cases import Bench, figures_of
from benchmarks.explorer import explorer, explorer_floor
from benchmarks.goals import GOALS, judged
from benchmarks.processes import PYTHON, served, serving, started_on
from benchmarks.recorder import multiply
from benchmarks.soak import soak
from merge_runner.llm.cache import ResponseCache

pytestmark = pytest.mark.long


@pytest.fixture
def bench(tmp_path):
    with served() as server:
        yield Bench(tmp_path, server)


class Everything(dict):
    """Figures of a case, whatever they are called."""

    def __missing__(self, figure):
        return 1.0


def test_every_goal_is_about_cases_that_are_run():
    samples = {case.name: [Everything()] for case in CASES}
    assert [goal for goal, _ in judged(samples)] == list(GOALS)


def test_a_goal_that_was_not_measured_is_not_judged():
    assert list(judged({"--help": [{"wall_s": 0.2}]})) == [(GOALS[-1], 0.2)]


@pytest.mark.parametrize(("at_most", "verdict"), [(True, "met"), (False, "**missed**")])
def test_a_missed_goal_is_told(at_most, verdict):
    goal = {"what": "it", "bound": 2.0, "value": 1.5, "unit": "x", "at_most": at_most}
    goal["met"] = at_most
    assert tables({}, [goal]).splitlines()[2].endswith(f"| 1.5 x | {verdict} |")


def test_the_floor_asks_once_and_reads_back_the_second_time(bench):
    for asked in (6, 6):
        bench.floor(bench.folder, trials=3, calls=2, in_flight=2, delay_ms=1)
        assert bench.server.stats()["asked"] == asked
    assert bench.server.stats()["asked_again"] == 0


def test_the_server_knows_what_is_asked_again(bench):
    for name in "ab":
        bench.floor(bench.fresh(name), trials=1, calls=2)
    assert bench.server.stats()["asked_again"] == 2
    bench.server.reset()
    assert bench.server.stats()["asked"] == 0


def test_multiplied_recordings_are_those_of_a_sweep(bench):
    short = ("--conditions", "R_-4_8")
    folder = bench.fresh("few")
    bench.sweep(folder, *short, "--reps", "1")
    multiply(folder / "responses", 3)
    replayed = bench.sweep(folder, *short, "--replay", "--reps", "3", db="again")
    assert figures_of(replayed)["calls"] == 24
    assert replayed.summary["audit"]["findings"] == []
    cache = ResponseCache(folder / "responses")
    assert len({entry.attempts[0].reply for entry in cache.entries()}) == 24
    cache.close()


def test_the_explorer_is_asked_when_it_has_read_the_trials_and_its_floor_serves_the_same(bench):
    figures = explorer(110)(bench)
    kept = {page.name: page.read_text("utf-8") for page in (bench.folder / "pages").iterdir()}
    assert "o3/A1/N_0_0/rep01" in kept["list"]
    assert "o3/A1/N_0_0/rep01" in kept["filtered"]
    assert "I am at step 15." in kept["trial"]
    assert figures.keys() - explorer_floor(bench).keys() == {"reading_s"}


def test_a_long_case_is_run_only_where_it_is_named():
    long = [case for case in CASES if case.is_long]
    assert [case.name for case in long if case.chosen("*", "") or case.chosen("soak*", "")] == []
    assert [case.chosen(case.name, "") for case in long] == [True] * len(long) != []
    assert next(case for case in CASES if case.name == "replay").chosen("re*", "")


def test_a_soak_is_killed_and_counts_what_its_server_saw(bench, monkeypatch):
    monkeypatch.setattr("benchmarks.soak.FAULT_RATE", 0.1)
    figures = soak(2, lives_s=0.5)(bench)
    assert figures["kills"] > 0
    assert figures["requests"] > figures["calls_made"] > 2 * 8
    assert figures["handles"] > 10 < figures["peak_mb"]
    assert figures["answered_asked_again"] == figures["attempts_made_twice"] == 0
    paid, billed = figures["spent_usd"], figures["billed_usd"]
    assert 0 < paid == pytest.approx(figures["quiet_billed_usd"])
    assert paid <= billed <= paid + figures["set_aside_usd"]
    assert figures["digest_differs"] == 0


def test_a_server_that_does_not_begin_says_why():
    with (
        pytest.raises(RuntimeError, match="there is no"),
        serving([PYTHON, "-c", "raise SystemExit('there is no database')"]),
    ):
        pass


def test_what_is_measured_and_the_server_are_kept_apart():
    everywhere = os.sched_getaffinity(0)
    halves = []
    for half in (0, 1):
        with started_on(half):
            halves.append(os.sched_getaffinity(0))
    assert os.sched_getaffinity(0) == everywhere
    if len(everywhere) > 1:
        assert not halves[0] & halves[1]
