"""A trial's account in words, and the moments that are marked."""

import pytest

from merge_runner_analysis.web.trial.account import Mark, account
from tests.support.crashes import EXAMPLES, course_of, crash, decided, drive
from tests.support.studies import played

WORDS = {
    "both insisted": "Both insisted: both had sped up. At 2.0 s, the last moment at which one "
    "driver alone could have avoided it (the right one, by braking), the left "
    "vehicle was 2.5 m/s faster and the right one 2.0 m/s faster than at the start; 0.5 m/s or "
    "more count as acting.",
    "no action": "Neither acted.",
    "near miss": "It came close: the gap was 0.42 m at the first merge, then the time to collision "
    "fell to 0.90 s.",
    "long wait": "The first vehicle reached the merge point after 12.50 s: 2 times as long as at "
    "the initial speeds, or longer.",
}
FACTS = {"gap_m": 0.42, "min_ttc_s": 0.9, "time_to_merge_s": 12.5}


def told(name):
    """The account of an example."""
    condition, left, right, said = EXAMPLES[name]
    if name in ("near miss", "long wait"):
        record = played(drive(name))
        made = course_of(record), decided(record)
    else:
        made = crash(condition, left, right, said)
    return account(*made, {"account": name, **FACTS})


@pytest.mark.parametrize("name", WORDS)
def test_an_account_begins_with_what_the_trial_is_an_example_of(name):
    assert told(name).sentences[0].startswith(WORDS[name])


def test_of_each_driver_it_says_what_would_have_helped():
    left, right = told("both insisted").sentences[1:]
    assert left == (
        "Until 1.6 s the left driver could have avoided it by braking at 2.0 m/s² from then on."
    )
    assert right.startswith("Until 2.0 s the right driver could have avoided it by braking")


@pytest.mark.parametrize(
    ("side", "left", "right", "mark", "text"),
    [
        (
            "right", (-0.4, 0.4, -0.4, 0.6, 0.2), (0.4, -0.6, 0.4, 0.6, -0.6, -0.4),
            "last moment to brake harder", (1.8, "braking at 2.5 m/s² in place of 1.5"),
        ),
        (
            "left", (0.2, 0.0, -0.4, 0.0, -0.4, -0.2), (-0.2, 0.2, -0.4, -0.6, 0.6, -0.4),
            "last moment to keep its speed", (1.4, "keeping the speed that it had"),
        ),
        (
            "left", (0.2, 0.2, 0.0, -0.6, 0.2, -0.6), (-0.2, -0.4, -0.2, 0.6, 0.2, 0.0),
            "last moment to stop speeding up", (1.2, "not speeding up any further"),
        ),
    ],
)  # fmt: skip
def test_what_would_have_helped_is_said_of_how_the_vehicle_drove(side, left, right, mark, text):
    found = account(*crash("N_0_0", left, right), {"account": "one too little"})
    assert (side, mark) in [(one.side, one.text) for one in found.marks]
    at_s, doing = text
    said = f"Until {at_s} s the {side} driver could have avoided it by {doing} from then on."
    assert said in found.sentences


def test_a_last_moment_to_speed_up_is_named_and_marked_apart_from_those_to_brake():
    plans = (0.2, 0.2, 0.0, -0.6, 0.2, -0.6), (-0.2, -0.4, -0.2, 0.6, 0.2, 0.0)
    found = account(*crash("N_0_0", *plans), {"account": "one too little"})
    until = "At 6.4 s, the last moment at which one driver alone could have avoided it"
    assert f"{until} (the left one, by speeding up)," in found.sentences[0]
    assert Mark(pytest.approx(6.4), "left", "last chance", "last moment to speed up") in found.marks


def test_a_change_of_mind_is_marked_once():
    course, decisions = crash(*EXAMPLES["both insisted"])
    for decision in decisions:
        at = decision["decision"]
        decision["tactical"] = ("Y", "M", "M")[at] if decision["side"] == "left" else "M"
        decision["fallback"] = (decision["side"], at) == ("right", 1)
    found = account(course, decisions, {"account": "both insisted"})
    assert found.marks == [
        Mark(0.0, "left", "choice", "chooses to yield"),
        Mark(0.0, "right", "choice", "chooses to merge"),
        Mark(1.0, "left", "choice", "chooses to merge"),
        Mark(1.0, "right", "invalid", "no valid plan"),
        Mark(1.6, "left", "last chance", "last moment to brake"),
        Mark(2.0, "right", "last chance", "last moment to brake"),
    ]
