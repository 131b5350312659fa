"""What a language model drives: its plan, the rest of it, and what happens without one."""

from dataclasses import replace

import pytest

from merge_runner.config import ScenarioConfig
from merge_runner.drivers.base import make_context
from merge_runner.drivers.language_model import LlmDriver
from merge_runner.drivers.pace import model_pace
from merge_runner.prompts.blocks import prompt_of
from merge_runner.records import ChatReply, ChatRequest, Observation, Slot
from tests.support.driven_trials import spec

PLAN = tuple(round(0.01 * k, 2) for k in range(1, 21))  # 0.01 to 0.20, no two alike
OTHER_PLAN = tuple(-a for a in PLAN)
ZEROS = (0.0,) * 5
INVALID = "I would rather not say."

SEEN = Observation("merge", 10.0, 10.0, 0.0, 50.0, (0.0,) * 10, (10.0,) * 10, 50.0, 0.0)
SLOT = Slot("N_0_0", 1, "left", 0, 0)
REQUEST = ChatRequest("key", "test", "test", "model", "/chat", {}, "{}", SLOT)
STRAIGHT = replace(SEEN, road="straight", distance_to_merge_m=None)
GO_ON = f"I go on.\n{list(PLAN)}"


def valid(plan):
    return f"M\nI go on.\n```python\n{list(plan)}\n```"


def chat_reply(text, outcome="ok"):
    return ChatReply(text=text, outcome=outcome, request=REQUEST, attempts=(), cached_attempts=0)


def ask(*replies, seen=SEEN, variant="baseline", begins=0, **scenario):
    """One question and decision per reply, from number ``begins`` on."""
    scenario = ScenarioConfig(**scenario)
    trial = spec("N_0_0")
    context = make_context(scenario, trial, "left", model_pace(scenario))
    driver = LlmDriver("model", trial, context, prompt_of(variant))
    for number, reply in enumerate(replies, begins):
        question = driver.ask(seen, number)
        assert (question.model, question.slot) == ("model", replace(SLOT, decision=number))
        answer = chat_reply(reply) if isinstance(reply, str) else reply
        yield question, question.decision(question.prompt, answer)


def decide(*replies, **how):
    """One decision per reply."""
    return [decision for _, decision in ask(*replies, **how)]


def remaining(decision):
    """What the prompt says about the previous plan."""
    (line,) = (x for x in decision.prompt.splitlines() if x.startswith("Previous plan"))
    return line.partition("): ")[2].removesuffix(", one value every 0.2 s, next first")


def listed(plan):
    return f"[{', '.join(f'{a:.2f}' for a in plan)}]"


def test_exactly_the_first_five_actions_of_a_valid_plan_are_applied():
    reply = chat_reply(valid(PLAN))
    (decision,) = decide(reply)
    assert (decision.plan, decision.applied) == (PLAN, (0.01, 0.02, 0.03, 0.04, 0.05))
    assert (decision.valid, decision.fallback, decision.failure) == (True, False, None)
    assert (decision.tactical, decision.rationale) == ("M", "I go on.")
    assert decision.reply is reply


@pytest.mark.parametrize("begins", [0, 2])  # 2: a driver that leaves its tunnel later
def test_only_the_first_prompt_says_that_it_is_the_first(begins):
    decisions = decide(*[INVALID] * 3, valid(PLAN), INVALID, begins=begins)
    first = "none, this is your first decision"
    assert [remaining(d) for d in decisions] == [first, *["none"] * 3, listed(PLAN[5:])]


def test_what_an_earlier_version_would_have_asked_is_known_until_there_is_a_plan():
    """It told a driver without a valid plan at each decision that it was its first one."""
    questions = [question for question, _ in ask(INVALID, INVALID, valid(PLAN), INVALID)]
    first = questions[0].prompt
    assert [question.older for question in questions] == [None, first, first, None]


def test_a_plan_without_the_decision_that_was_asked_for_is_driven_and_named():
    (decision,) = decide(GO_ON)
    assert (decision.valid, decision.failure, decision.tactical) == (True, "no_decision", None)
    assert (decision.plan, decision.applied, decision.fallback) == (PLAN, PLAN[:5], False)


@pytest.mark.parametrize(
    ("seen", "variant", "text"),
    [
        (STRAIGHT, "baseline", GO_ON),
        (SEEN, "A7", GO_ON),
        (SEEN, "baseline", f"Decision: Merge first\n{list(PLAN)}"),
    ],
)
def test_nothing_is_missing_where_none_is_asked_for_or_one_is_given(seen, variant, text):
    (decision,) = decide(text, seen=seen, variant=variant)
    assert (decision.valid, decision.failure) == (True, None)


@pytest.mark.parametrize(
    ("replies", "scenario", "applied"),
    [
        # Without a valid plan yet, the actions are zero.
        ((INVALID, INVALID, PLAN), {}, (ZEROS, ZEROS, PLAN[:5])),
        ((INVALID,), {"fallback": "restart"}, (ZEROS,)),
        # After an invalid reply the old plan goes on where it was left, and ends in zeros.
        (
            (PLAN, INVALID, INVALID, OTHER_PLAN),
            {},
            (PLAN[:5], PLAN[5:10], PLAN[10:15], OTHER_PLAN[:5]),
        ),
        ((PLAN, *[INVALID] * 3), {}, (PLAN[:5], PLAN[5:10], PLAN[10:15], PLAN[15:])),
        ((PLAN, *[INVALID] * 2), {"fallback": "restart"}, (PLAN[:5],) * 3),
        (
            (PLAN[:7], INVALID, INVALID),
            {"horizon_s": 1.4},
            (PLAN[:5], (*PLAN[5:7], *ZEROS[2:]), ZEROS),
        ),
        # The prompt rate says how many actions are driven: one prompt every 5, 2 or 1 steps.
        ((PLAN, INVALID), {"prompt_rate_hz": 2.5}, (PLAN[:2], PLAN[2:4])),
        ((PLAN, INVALID), {"prompt_rate_hz": 5}, (PLAN[:1], PLAN[1:2])),
    ],
)
def test_what_is_driven_is_the_newest_plan_from_where_it_was_left(replies, scenario, applied):
    texts = [reply if reply is INVALID else valid(reply) for reply in replies]
    decisions = decide(*texts, **scenario)
    assert tuple(d.applied for d in decisions) == applied
    assert [d.plan for d in decisions] == [None if x is INVALID else x for x in replies]
    assert [d.fallback for d in decisions] == [x is INVALID for x in replies]
    assert {d.failure for d in decisions if d.fallback} <= {"no_array"}


@pytest.mark.parametrize(
    ("replies", "scenario", "rest"),
    [
        ((valid(PLAN), valid(OTHER_PLAN), INVALID), {}, (PLAN[5:], OTHER_PLAN[5:])),
        ((valid(PLAN), *[INVALID] * 4), {}, (PLAN[5:], PLAN[10:], PLAN[15:], ())),
        ((valid(PLAN), *[INVALID] * 2), {"fallback": "restart"}, (PLAN[5:], PLAN[5:])),
    ],
)
def test_the_next_prompt_shows_the_actions_that_were_not_executed(replies, scenario, rest):
    decisions = decide(*replies, **scenario)
    assert [remaining(d) for d in decisions[1:]] == [*map(listed, rest)]


@pytest.mark.parametrize("outcome", ["refusal", "truncated", "empty"])
def test_an_answer_that_is_not_ok_is_named_and_not_searched_for_a_plan(outcome):
    reply = chat_reply(valid(OTHER_PLAN), outcome)
    decisions = decide(valid(PLAN), reply)
    found = decisions[1]
    assert (found.valid, found.plan, found.failure, found.tactical) == (False, None, outcome, None)
    assert (found.applied, found.fallback) == (PLAN[5:10], True)
    assert found.reply is reply


def test_the_variant_and_what_is_seen_decide_the_prompt():
    (baseline,), (ablated,) = decide(INVALID), decide(INVALID, variant="A2")
    assert ("Previous plan" in baseline.prompt, "Previous plan" in ablated.prompt) == (True, False)
    assert "Your distance to the merge point: 50.00 m" in baseline.prompt
