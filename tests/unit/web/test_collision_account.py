"""A trial's account in words, and the moments that are marked."""

import pytest

from merge_runner.config import ScenarioConfig
from merge_runner_analysis.web.trial.account import Mark, account, collision_class
from tests.support.crashes import EXAMPLES, course_of, crash, decided, drive
from tests.support.studies import played

WORDS = {
    "nobody braked, both sped up": "Nobody braked, both sped up: the left driver sped up and never "
    "braked, the right one sped up and never braked. Accelerations beyond 0.2 m/s² count.",
    "one braked": "One braked: the left driver sped up and never braked, the right one sped up, "
    "and first braked at 2.0 s. Accelerations beyond 0.2 m/s² count.",
    "both braked": "Both braked: the left driver first braked at 0.0 s, the right one first braked",
    "nobody braked, one sped up": "Nobody braked, one sped up: the left driver neither braked nor "
    "sped up, the right one sped up and never braked.",
    "nobody braked or sped up": "Nobody braked or sped up: the left driver neither braked nor sped",
    "no valid plan": "A driver drove without a valid plan when its braking could last have helped: "
    "the left driver sped up and never braked, the right one",
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
    left, right = told("nobody braked, both sped up").sentences[1:]
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
    found = account(*crash("N_0_0", left, right), {"account": "both braked"})
    assert (side, mark) in [(one.side, one.text) for one in found.marks]
    at_s, doing = text
    said = f"Until {at_s} s the {side} driver could have avoided it by {doing} from then on."
    assert said in found.sentences


def test_a_last_moment_to_speed_up_is_named_and_marked_apart_from_those_to_brake():
    plans = (0.2, 0.2, 0.0, -0.6, 0.2, -0.6), (-0.2, -0.4, -0.2, 0.6, 0.2, 0.0)
    found = account(*crash("N_0_0", *plans), {"account": "both braked"})
    by = "the left driver could have avoided it by speeding up as hard as it could."
    assert found.sentences[-1] == f"Until 6.4 s {by}"
    assert Mark(pytest.approx(6.4), "left", "last chance", "last moment to speed up") in found.marks


def test_a_change_of_mind_is_marked_once():
    course, decisions = crash(*EXAMPLES["nobody braked, both sped up"])
    for decision in decisions:
        at = decision["decision"]
        decision["tactical"] = ("Y", "M", "M")[at] if decision["side"] == "left" else "M"
        decision["fallback"] = (decision["side"], at) == ("right", 1)
    found = account(course, decisions, {"account": "nobody braked, both sped up"})
    assert found.marks == [
        Mark(0.0, "left", "choice", "chooses to yield"),
        Mark(0.0, "right", "choice", "chooses to merge"),
        Mark(1.0, "left", "choice", "chooses to merge"),
        Mark(1.0, "right", "invalid", "no valid plan"),
        Mark(1.6, "left", "last chance", "last moment to brake"),
        Mark(2.0, "right", "last chance", "last moment to brake"),
    ]


def test_a_vehicle_that_only_rolls_does_not_brake_and_may_roll_on():
    drag = ScenarioConfig(resistance="human")
    rolling = crash("N_0_0", (0.0,) * 12, (0.0,) * 12, scenario=drag)
    assert rolling[0].driven_mps2("left", 0) == pytest.approx(-1.0)
    assert collision_class(*rolling) == "nobody braked or sped up"
    # Less than the resistance of 1 m/s² keeps a vehicle from speeding up.
    slower = crash("N_0_0", (0.2,) * 12, (0.2, 0.2, -0.09) + (0.2,) * 9, scenario=drag)
    assert collision_class(*slower) == "one braked"
    plans = (0.6, 0.0, 0.2, 0.0, 0.2), (0.0, 0.6, -0.2, -0.4, 0.2)
    found = account(*crash("N_0_0", *plans, scenario=drag), {"account": "one braked"})
    assert "could have avoided it by letting the vehicle roll from then on" in found.sentences[2]
