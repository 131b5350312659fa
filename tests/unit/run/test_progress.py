"""What is shown while a sweep runs."""

import re
from collections import Counter
from datetime import UTC, datetime, timedelta

import pytest

from merge_runner.llm.attempts import Meter
from merge_runner.llm.call import Wait
from merge_runner.run.estimate import Estimate
from merge_runner.run.estimate_lines import estimate_lines
from merge_runner.run.plan import make_plan
from merge_runner.run.progress import Log
from tests.support.snapshots import progress, runner


def ago(seconds):
    return datetime.now(UTC) - timedelta(seconds=seconds)


def times(text):
    """The seconds that have passed, and those that are left; a busy machine looks later."""
    found = re.fullmatch(r"(\d+) s, about (\d+) s left", text)
    return int(found[1]), int(found[2])


def rows(shown):
    return shown.snapshot("").rows


def test_every_figure_is_that_of_the_meters():
    first = Meter(calls_live=30, calls_cached=20, calls_shared=8, calls_recorded=5, cost_usd=1.5)
    meters = [first, Meter(calls_live=4, cost_unknown=1)]
    meters[0].outcomes["ok"] = meters[1].outcomes["timeout"] = 1
    meters[1].mismatches["o3 -> gpt-4o"] = 2
    shown = progress(runner(*meters, running_trials=5), began_at=ago(60))
    shown.session.stored += [None] * 7
    shown.outcome_counts.update(finished=2, failed=1, suspended=1)
    shown.done.update(baseline=3)
    fields = dict(rows(shown))
    assert fields["trials"] == "3/10 ended (+7 stored before), 5 running"
    assert fields["failed"] == "1"
    assert fields["WARNING"] == "another model answers: o3 -> gpt-4o"
    assert fields["calls"] == (
        "34 asked, 5 from recordings, 7 from the cache, 8 shared with another trial"
    )
    assert fields["cost"] == "1.50 USD, 4.25 of 20 over all runs"
    # 3 of 10 trials have ended but only 46 of 210 calls are made: the larger share tells.
    spent_s, left_s = times(fields["time"])
    assert left_s == pytest.approx(spent_s * 7 / 3, abs=3)
    snapshot = shown.snapshot("s")
    assert (snapshot.ended, snapshot.failed) == (9, 1)  # of 17, with those stored before


def test_the_calls_tell_the_time_left_while_no_trial_has_ended():
    shown = progress(runner(Meter(calls_live=70)), began_at=ago(10))
    spent_s, left_s = times(dict(rows(shown))["time"])
    assert left_s == pytest.approx(2 * spent_s, abs=3)
    shown.runner = runner(Meter())
    assert re.fullmatch(r"\d+ s", dict(rows(shown))["time"])


def test_each_model_of_several_shows_its_share_of_the_decisions():
    plan = make_plan("baseline", ["emulator", "random"])
    of_each = {"emulator": Meter(calls_live=231), "random": Meter(calls_cached=9999)}
    shown = progress(runner(), todo=Counter(spec.arm for spec in plan.trial_specs()))
    shown.session.plan, shown.runner.meters = plan, of_each
    assert [text for name, text in rows(shown) if name == "decided"] == [
        "emulator: about 10% of the decisions",
        "random: about 99% of the decisions",
    ]
    shown.outcome_counts.update(finished=plan.trials)
    assert "decided" not in dict(rows(shown))


def test_the_time_left_is_that_of_the_slowest_model_that_has_trials_left():
    plan = make_plan("baseline", ["emulator", "random", "constant"])
    todo = Counter(spec.arm for spec in plan.trial_specs())
    calls = 2 * 10.5 * plan.trials / 3  # of a model
    fast = {"emulator": Meter(calls_live=2 * round(calls)), "random": Meter(calls_live=calls // 4)}
    shown = progress(runner(), began_at=ago(100), todo=todo)
    shown.session.plan, shown.runner.meters = plan, fast

    def left_s():
        spent_s, left_s = times(dict(rows(shown))["time"])
        return left_s * 100 / spent_s

    shown.done.update(emulator=todo["emulator"] - 1)
    shown.outcome_counts.update(finished=todo["emulator"] - 1)
    assert left_s() == pytest.approx(300, rel=0.05)
    # A model whose trials have ended with fewer calls than usual is not waited for.
    fast["emulator"].calls_live = 1
    shown.done["emulator"] += 1
    assert left_s() == pytest.approx(300, rel=0.05)
    fast["random"].calls_live = 0
    assert "left" not in dict(rows(shown))["time"]
    # Programs alone are left: their trials tell.
    shown.done["random"] = todo["random"]
    shown.outcome_counts["finished"] = todo["emulator"] + todo["random"]
    assert left_s() == pytest.approx(50, rel=0.05)


def test_trials_that_wait_for_money_are_not_running():
    waiting = dict(rows(progress(runner(running_trials=105, waiting_for_money=103))))
    assert waiting["trials"] == "0/10 ended, 2 running, 103 wait for money"


def test_a_log_says_in_short_what_is_new_and_its_last_line_once(capsys):
    waits = [Wait("for money " + "for ever " * 20), Wait("for another"), Wait("for another")]
    shown = progress(runner(running_trials=3, waits=waits), began_at=ago(10))
    shown.runner.meters = {"emulator": Meter(calls_live=70)}
    log = Log()
    log.show(shown)
    assert re.fullmatch(
        r"trials: 0/10 ended; \d+ s, about \d+ s left; waiting: 2 for another\n",
        capsys.readouterr().err,
    )
    shown.runner.meters["emulator"].cost_usd = 1.5
    shown.runner.waits = waits[:1]
    log.show(shown)
    line = capsys.readouterr().err
    assert re.match(
        r"trials: 0/10 ended; cost: 1\.50 USD, 4\.25 of 20 over all runs; "
        r"\d+ s, about \d+ s left; waiting: 1 for money",
        line,
    )
    assert 100 < len(line) <= 121
    assert line.endswith(" ...\n")
    shown.outcome_counts.update(finished=9, failed=1)
    shown.doing = "checking"
    for _ in range(3):
        log.show(shown)
    assert re.fullmatch(
        r"trials: 10/10 ended; failed: 1; cost: 1.50 USD, .*; \d+ s.*\n", capsys.readouterr().err
    )


def test_a_log_has_a_warning_once_in_a_line_of_its_own(capsys):
    shown, log = progress(runner(Meter())), Log()
    shown.batches = lambda: ["round 1"]
    for number in (3, 4):
        shown.unstored = lambda number=number: f"{number} trials wait to be stored"
        log.show(shown)
    warning, close, first, second = capsys.readouterr().err.splitlines()
    assert warning == "WARNING: 3 trials wait to be stored"
    assert close == "waiting: you may close this: the same command goes on"
    assert [re.sub(r"\d+ s", "", line) for line in (first, second)] == [
        "trials: 0/10 ended; ; waiting: round 1"
    ] * 2


def test_batches_are_shown_and_that_nobody_need_wait():
    texts = [f"round 4 of at most 30: 220 calls of o3 in batch {number}" for number in range(5)]
    shown = progress(runner(Meter(calls_live=70)), batches=lambda: texts)
    assert [text for name, text in rows(shown) if name == "waiting"] == [
        *texts[:3],
        "2 others",
        "you may close this: the same command goes on",
    ]
    assert "left" not in dict(rows(shown))["time"]  # nobody knows how long a batch takes


def test_replies_that_cost_more_than_is_counted_are_a_warning():
    meter = Meter(calls_live=3)
    meter.underpriced["priority"] = 2
    warning = dict(rows(progress(runner(meter))))["WARNING"]
    assert warning.startswith("emulator: replies are of the service tier 'priority'")
    assert "tiers = { priority = 2.0 }" in warning


def expected(trials, **more):
    return Estimate(
        "o3", trials, 18 * trials, 0, 0, 1.5, None, 0.1 * trials, 0, True, False, **more
    )


def test_a_dry_run_says_how_many_trials_are_left():
    assert [*estimate_lines(expected(3))][:2] == ["driver  o3", "trials  3 to play"]
    assert [*estimate_lines(expected(0, planned=110, stored=110))] == [
        "Nothing left to play: all 110 trials are stored."
    ]
    assert [*estimate_lines(expected(0, planned=110, stored=100))] == [
        "Nothing left to ask: 100 trials are stored, and 10 are played from recorded replies."
    ]


def test_an_estimate_says_where_replies_are_cut_off():
    def cut(**caps):
        return [each for each in estimate_lines(expected(3, output_caps=caps)) if "cut off" in each]

    assert cut() == []
    assert cut(o3=500, o4=500) == [
        "        a reply is cut off at 500 output tokens (max_output_tokens)"
    ]
    assert "at 500 with o3, 9 with o4 output tokens" in cut(o3=500, o4=9)[0]


def test_an_estimate_says_how_far_a_cap_that_it_exceeds_goes():
    def stops(left_usd):
        capped = expected(3, left_usd=left_usd, cap_source="[budget] of mine")
        return [line for line in estimate_lines(capped) if "stops" in line]

    assert (stops(None), stops(1.5)) == ([], [])
    (line,) = stops(0.3)
    assert line.strip() == "stops at 0.30 USD, about 20 % of it: what [budget] of mine leaves"


def test_an_estimate_says_what_each_of_several_models_costs():
    lines = [*estimate_lines(expected(3, usd_by_model={"o3": 1.25, "o4": None}))]
    assert lines[lines.index("cost    about 1.50 USD") + 1 :][:2] == [
        "        o3: about 1.25 USD",
        "        o4: an unknown price",
    ]
    assert not any("o3:" in line for line in estimate_lines(expected(3, usd_by_model={"o3": 1.5})))
