"""A trial's account in words, and the moments that are marked."""

from __future__ import annotations

from math import inf

import pytest

from merge_runner.config import ScenarioConfig
from merge_runner.records import SIDES
from merge_runner_analysis.accounts.account import Mark, Prediction, account, changes_of_mind
from merge_runner_analysis.accounts.classes import collision_class
from tests.analysis.accounts.crashes import EXAMPLES, NO_PLAN, course_of, crash, decided, drive
from tests.analysis.studies import Drive, played

WORDS = {
    "both insisted": "Both insisted: both had sped up. At 2.0 s, when one driver alone could "
    "last have avoided it, the left vehicle was 2.5 m/s faster and the right one 2.0 "
    "m/s faster than at the start; 0.5 m/s or more count as acting.",
    "no action": "Neither acted.",
    "near miss": "It came close: the gap was 0.4 m when the first vehicle reached the merge point, "
    "and afterwards the time to collision fell to 0.9 s.",
    "long wait": "The first vehicle reached the merge point after 12.5 s; at the initial speeds it "
    "would have been there after 4.6 s. The left vehicle was slowest at 3.0 s, with 3.3 m/s, the "
    "right one at 3.0 s, with 2.5 m/s.",
}
FACTS = {"gap_m": 0.42, "min_ttc_s": 0.9, "time_to_merge_s": 12.5}


def told(name, said=None, scenario=None):
    """The account of an example."""
    condition, left, right, its_own = EXAMPLES[name]
    if name in ("near miss", "long wait"):
        record = played(drive(name))
        made = course_of(record), decided(record)
    else:
        made = crash(condition, left, right, said or its_own, *([scenario] if scenario else []))
    return account(*made, {"account": name, **FACTS})


@pytest.mark.parametrize("name", WORDS)
def test_an_account_begins_with_what_the_trial_is_an_example_of(name):
    assert told(name).sentences[0].startswith(WORDS[name])


def test_of_each_driver_it_says_what_would_have_helped_and_what_it_did_instead():
    left, right = told("both insisted").sentences[1:]
    assert left == (
        "The left driver could still have avoided it at 1.6 s, by braking at 2.0 m/s² from then "
        "on, or from the start on by keeping its speed. Instead it sped up by 1.2 m/s² on average, "
        "by the plan of decision 1."
    )
    assert right.startswith("The right driver could still have avoided it at 2.0 s")


@pytest.mark.parametrize(
    ("said", "words"),
    [
        ({1: NO_PLAN}, "by the older plan of decision 0, since decision 1 held no valid one"),
        ({0: NO_PLAN, 1: NO_PLAN}, "without any plan, since decision 1 held no valid one"),
    ],
)
def test_it_says_by_what_plan_a_vehicle_was_driven(said, words):
    (line,) = [s for s in told("both insisted", said).sentences if s.startswith("The left driver")]
    assert f"{words} (no_array)." in line


def test_under_drag_a_vehicle_that_does_nothing_rolls_on():
    drag = ScenarioConfig(resistance="human")
    assert "from the start on by rolling on" in " ".join(
        told("both insisted", scenario=drag).sentences
    )


def test_predictions_are_those_of_constant_speeds_at_each_decision():
    course, decisions = crash(*EXAMPLES["no action"][:3])
    name = collision_class(course, decisions)
    first, *_, last = account(course, decisions, {"account": name}).predictions
    start_s = (course.track.merge_point_m - course.positions_m["left"][0]) / 10
    assert first == Prediction(0.0, pytest.approx(start_s), pytest.approx(start_s))
    assert first.first == "both together"
    assert last.time_s == 3.0
    assert last.left_s == pytest.approx(start_s)
    assert last.right_s < start_s
    assert Prediction(0.0, 5.0, 4.8).first == "right, by 0.2 s"
    assert Prediction(0.0, 5.0, inf).arrivals == ["5.0", "never"]


def test_a_vehicle_that_stands_or_creeps_would_never_arrive():
    record = played(Drive("o3", "baseline", "N_0_0", 1, (-1.0,) * 4 + (0.002,) * 2, ()))
    course = course_of(record)
    assert course.arrival_s("left", course.at(4.0)) == inf
    assert 0 < course.speeds_mps["left"][course.at(5.0)] < 0.01
    assert course.arrival_s("left", course.at(5.0)) == inf


def test_a_change_of_mind_is_told_and_marked_once():
    course, decisions = crash(*EXAMPLES["both insisted"])
    for decision in decisions:
        at = decision["decision"]
        decision["tactical"] = ("Y", "M", "M")[at] if decision["side"] == "left" else "M"
    found = account(course, decisions, {"account": "both insisted"})
    assert changes_of_mind(decisions, "left") == [(0.0, "Y"), (1.0, "M")]
    assert found.sentences[1:3] == [
        "The left driver chose to yield at 0.0 s and changed its mind: merge at 1.0 s.",
        "The right driver chose to merge at 0.0 s and never changed its mind.",
    ]
    assert found.marks == [
        Mark(0.0, "left", "choice", "chooses to yield"),
        Mark(0.0, "right", "choice", "chooses to merge"),
        Mark(1.0, "left", "choice", "chooses to merge"),
        Mark(1.6, "left", "last chance", "last moment to brake"),
        Mark(2.0, "right", "last chance", "last moment to brake"),
    ]


def test_a_driver_that_keeps_changing_its_mind_is_told_shortly():
    course, _ = crash(*EXAMPLES["both insisted"])
    often = [
        {"side": "left", "decision": n, "time_s": n / 2, "tactical": "MY"[n % 2], "fallback": False}
        for n in range(6)
    ]
    sentences = account(course, often, {"account": "both insisted"}).sentences
    assert sentences[1] == (
        "The left driver chose to merge at 0.0 s and changed its mind 5 times, the last time at "
        "2.5 s, to yield."
    )


def test_humans_have_no_decisions_and_are_told_second_by_second():
    course, _ = crash(*EXAMPLES["both insisted"])
    found = account(course, [], {"account": "both insisted"})
    assert [prediction.time_s for prediction in found.predictions] == [0.0, 1.0, 2.0]
    assert not any("plan" in sentence for sentence in found.sentences)
    assert {mark.side for mark in found.marks} == set(SIDES)
