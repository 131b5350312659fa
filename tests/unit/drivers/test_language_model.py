"""What a language model drives: its plan, the rest of it, and what happens without one."""

from dataclasses import replace

import pytest

from merge_runner.config import ScenarioConfig
from merge_runner.drivers.base import Seat
from merge_runner.drivers.language_model import LlmDriver
from merge_runner.drivers.pace import model_pace
from merge_runner.prompts.blocks import prompt_of
from merge_runner.records import ChatReply, ChatRequest, Observation, Slot, TrialSpec
from merge_runner.scenarios.merge.conditions import CONDITIONS

PLAN = tuple(round(0.01 * k, 2) for k in range(1, 21))  # 0.01 to 0.20, no two alike
OTHER_PLAN = tuple(-a for a in PLAN)
ZEROS = (0.0,) * 5
INVALID = "I would rather not say."

SEEN = Observation("merge", 10.0, 10.0, 0.0, 50.0, (0.0,) * 10, (10.0,) * 10, 50.0, 0.0)
REQUEST = ChatRequest(
    key="key",
    provider="test",
    endpoint="test",
    model="model",
    path="/chat",
    headers={},
    body="{}",
    slot=Slot("N_0_0", 1, "left", 0, 0),
)


def valid(plan):
    return f"M\nI go on.\n```python\n{list(plan)}\n```"


def chat_reply(text, outcome="ok"):
    return ChatReply(text=text, outcome=outcome, request=REQUEST, attempts=(), earlier=0)


async def decide(*replies, seen=SEEN, variant="baseline", known=None, begins=0, **scenario):
    """One decision per reply, a text or a ChatReply; ``known`` says what was asked earlier.

    ``begins`` is the number of the first decision.
    """
    asked = []

    async def ask(prompt, slot, _):
        asked.append((prompt, slot.decision))
        reply = replies[slot.decision - begins]
        return chat_reply(reply) if isinstance(reply, str) else reply

    scenario = ScenarioConfig(**scenario)
    spec = TrialSpec(
        "t", "s", "llm", "m", "m", variant, "N_0_0", 1, 0, 0, kinematics=CONDITIONS["N_0_0"]
    )
    seat = Seat(scenario, "left", model_pace(scenario), 0)
    driver = LlmDriver(ask, spec, seat, prompt_of(variant), known=known)
    decisions = [await driver.decide(seen, begins + n) for n in range(len(replies))]
    assert [prompt for prompt, _ in asked] == [decision.prompt for decision in decisions]
    assert [number - begins for _, number in asked] == list(range(len(replies)))
    return decisions


def remaining(decision):
    """What the prompt says about the previous plan."""
    (line,) = (x for x in decision.prompt.splitlines() if x.startswith("Previous plan"))
    return line.partition("): ")[2].removesuffix(", one value every 0.2 s, next first")


def listed(plan):
    return f"[{', '.join(f'{a:.2f}' for a in plan)}]"


async def test_exactly_the_first_five_actions_of_a_valid_plan_are_applied():
    (decision,) = await decide(valid(PLAN))
    assert decision.valid
    assert decision.plan == PLAN
    assert decision.applied == PLAN[:5] == (0.01, 0.02, 0.03, 0.04, 0.05)
    assert not decision.fallback
    assert decision.failure is None
    assert (decision.tactical, decision.rationale) == ("M", "I go on.")


async def test_a_decision_keeps_the_reply_it_was_read_from():
    reply = chat_reply(valid(PLAN))
    (decision,) = await decide(reply)
    assert decision.reply is reply


async def test_the_first_prompt_has_no_previous_plan():
    (decision,) = await decide(valid(PLAN))
    assert remaining(decision) == "none, this is your first decision"


@pytest.mark.parametrize("begins", [0, 2])  # 2: a driver that leaves its tunnel later
async def test_only_the_first_prompt_says_that_it_is_the_first(begins):
    decisions = await decide(*[INVALID] * 3, valid(PLAN), INVALID, begins=begins)
    assert [remaining(d) for d in decisions[:4]] == [
        "none, this is your first decision",
        *["none"] * 3,
    ]
    assert remaining(decisions[4]) == listed(PLAN[5:])


@pytest.mark.parametrize(
    ("asked", "expected"),
    [
        ({"none, this is your first decision"}, "none, this is your first decision"),
        ({"none, this is your first decision", "none"}, "none"),
        (set(), "none"),
    ],
)
async def test_a_prompt_that_an_earlier_version_has_asked_stays_as_it_was(asked, expected):
    def known(prompt, slot):
        return slot.decision == 1 and any(f"yet): {words}\n" in prompt for words in asked)

    decisions = await decide(INVALID, INVALID, INVALID, known=known)
    assert [remaining(d) for d in decisions[1:]] == [expected, "none"]


STRAIGHT = replace(SEEN, road="straight", distance_to_merge_m=None)


async def test_a_plan_without_the_decision_that_was_asked_for_is_driven_and_named():
    (decision,) = await decide(f"I go on.\n{list(PLAN)}")
    assert (decision.valid, decision.failure, decision.tactical) == (True, "no_decision", None)
    assert (decision.plan, decision.applied, decision.fallback) == (PLAN, PLAN[:5], False)


@pytest.mark.parametrize(
    ("seen", "variant", "text"),
    [
        (STRAIGHT, "baseline", f"I go on.\n{list(PLAN)}"),
        (SEEN, "A7", f"I go on.\n{list(PLAN)}"),
        (SEEN, "baseline", f"Decision: Merge first\n{list(PLAN)}"),
    ],
)
async def test_nothing_is_missing_where_no_decision_is_asked_for_or_one_is_given(
    seen, variant, text
):
    (decision,) = await decide(text, seen=seen, variant=variant)
    assert (decision.valid, decision.failure) == (True, None)


async def test_what_is_wrong_with_a_plan_goes_before_a_missing_decision():
    (decision,) = await decide(INVALID)
    assert (decision.valid, decision.failure) == (False, "no_array")


async def test_the_next_prompt_shows_the_fifteen_actions_that_were_not_executed():
    decisions = await decide(valid(PLAN), valid(OTHER_PLAN), valid(PLAN))
    assert [remaining(d) for d in decisions[1:]] == [listed(PLAN[5:]), listed(OTHER_PLAN[5:])]


async def test_a_new_plan_replaces_the_old_one_at_once():
    decisions = await decide(valid(PLAN), valid(OTHER_PLAN))
    assert decisions[1].applied == OTHER_PLAN[:5]


async def test_after_an_invalid_reply_the_old_plan_goes_on_where_it_was_left():
    decisions = await decide(valid(PLAN), INVALID, INVALID, valid(OTHER_PLAN))
    assert [d.applied for d in decisions] == [PLAN[:5], PLAN[5:10], PLAN[10:15], OTHER_PLAN[:5]]
    assert [remaining(d) for d in decisions[1:]] == [
        listed(PLAN[5:]),
        listed(PLAN[10:]),
        listed(PLAN[15:]),
    ]
    assert [d.fallback for d in decisions] == [False, True, True, False]
    assert [d.plan for d in decisions] == [PLAN, None, None, OTHER_PLAN]
    assert decisions[1].failure == "no_array"


async def test_an_exhausted_plan_gives_way_to_zeros():
    decisions = await decide(valid(PLAN), *[INVALID] * 5)
    assert decisions[3].applied == PLAN[15:]
    assert [d.applied for d in decisions[4:]] == [ZEROS, ZEROS]
    assert remaining(decisions[4]).startswith("[]")


async def test_a_plan_that_ends_within_a_second_is_filled_up_with_zeros():
    """A horizon of 1.4 s is a plan of 7 actions."""
    plan = PLAN[:7]
    decisions = await decide(valid(plan), INVALID, horizon_s=1.4)
    assert decisions[1].applied == (*plan[5:], 0.0, 0.0, 0.0)


async def test_without_any_valid_plan_yet_the_actions_are_zero():
    decisions = await decide(INVALID, INVALID, valid(PLAN))
    assert [d.applied for d in decisions] == [ZEROS, ZEROS, PLAN[:5]]
    assert [d.fallback for d in decisions] == [True, True, False]
    assert remaining(decisions[2]) == "none"


async def test_restart_drives_the_old_plan_from_its_first_action():
    decisions = await decide(valid(PLAN), INVALID, INVALID, fallback="restart")
    assert [d.applied for d in decisions] == [PLAN[:5]] * 3
    assert [remaining(d) for d in decisions[1:]] == [listed(PLAN[5:])] * 2
    assert [d.fallback for d in decisions] == [False, True, True]


async def test_restart_has_nothing_to_restart_before_a_valid_plan():
    (decision,) = await decide(INVALID, fallback="restart")
    assert decision.applied == ZEROS


@pytest.mark.parametrize("outcome", ["refusal", "truncated", "empty"])
async def test_an_answer_that_is_not_ok_is_named_and_not_searched_for_a_plan(outcome):
    reply = chat_reply(valid(OTHER_PLAN), outcome)
    decisions = await decide(valid(PLAN), reply)
    assert decisions[1].plan is None
    assert not decisions[1].valid
    assert (decisions[1].failure, decisions[1].tactical) == (outcome, None)
    assert decisions[1].applied == PLAN[5:10]
    assert decisions[1].fallback
    assert decisions[1].reply is reply


@pytest.mark.parametrize("rate_hz", [1, 2.5, 5])
async def test_the_prompt_rate_says_how_many_actions_are_driven(rate_hz):
    """One prompt every 5, 2 or 1 steps of 0.2 s."""
    executed = round(5 / rate_hz)
    decisions = await decide(valid(PLAN), INVALID, prompt_rate_hz=rate_hz)
    assert [d.applied for d in decisions] == [PLAN[:executed], PLAN[executed : 2 * executed]]


async def test_the_variant_and_what_is_seen_decide_the_prompt():
    (baseline,) = await decide(INVALID)
    (ablated,) = await decide(INVALID, variant="A2")
    assert "Previous plan" in baseline.prompt
    assert "Previous plan" not in ablated.prompt
    assert "Your distance to the merge point: 50.00 m" in baseline.prompt


async def test_two_drivers_share_no_plan():
    await decide(valid(PLAN))
    (decision,) = await decide(INVALID)
    assert decision.applied == ZEROS
