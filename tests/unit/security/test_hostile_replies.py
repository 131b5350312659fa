"""Whatever a model answers: a plan or a named refusal, no code, no exception, linear time."""

import math
import sys
import time
from contextlib import contextmanager

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from merge_runner.prompts.parse import parse_reply
from tests.support.cases import table

N = 20
REFUSALS = {
    *("no_array", "several_arrays", "wrong_length", "not_a_number", "not_finite"),
    "out_of_range",
}
PLAN = ", ".join(["0.05"] * N)
# Where code that is evaluated would leave a trace of itself.
EXECUTED: list[str] = []
TRAP = f"__import__('sys').modules[{__name__!r}].EXECUTED.append('reply')"


@pytest.fixture(scope="module")
def every_audit_event():
    """What the interpreter reports: compiling, executing, importing, opening, starting, ..."""
    events, watching = [], []
    sys.addaudithook(lambda event, _: watching and events.append(event))  # for good

    @contextmanager
    def watch():
        events.clear()
        watching.append(True)
        try:
            yield events
        finally:
            watching.clear()

    return watch


MODEL_LIKE = [
    f"M\n\nI am 5.2 m ahead and go first.\n\n```python\n[{PLAN}]\n```",
    f"**Decision: Y**\n\nThe other car is ahead.\n\n```python\nplan = [{PLAN}]\nprint(plan)\n```",
    f"Y\n\n### Rationale\n- I brake.\n\n```python\nimport numpy as np\nnp.array([{PLAN}])\n```",
    f"M \u2014 ich \U0001f697 zuerst.\r\n\r\n```\r\n[{PLAN.replace('0.05', '-.5e-1')}]\r\n```",
    f"(M)\nAs [0.1, 0.2] shows, I lead.\n```python\n[\n  {PLAN.replace(', ', ',  # 2.5')},\n]\n```",
    f"M\n```python\n[{PLAN}]\n```\nOr:\n```python\n[{PLAN.replace('0.05', '0.5')}]\n```",
    "M\n```python\n[round(0.1 * k, 2) for k in range(20)]\n```",
    "I cannot help with that.",
    "",
]
HOSTILE = [
    *table("hostile_replies", "pieces"),
    *("9" * 400, "0." + "1" * 400, TRAP, f"[{TRAP}]", f"[{TRAP}]*20", "\ud800", "\udfff"),
]


def check(text, actions=N):
    """Parse, and hold the result against the promise; returns the outcome's name."""
    parsed = parse_reply(text, actions)
    assert parsed.tactical in (None, "M", "Y")
    assert parsed.rationale.encode() is not None, "a table can hold it"
    if parsed.plan is None:
        assert parsed.failure in REFUSALS, text
        return parsed.failure
    assert parsed.failure is None, text
    assert len(parsed.plan) == actions, text
    assert all(type(n) is float and math.isfinite(n) and -1 <= n <= 1 for n in parsed.plan), text
    return "plan"


@settings(max_examples=60)
@given(
    st.lists(
        st.sampled_from([*HOSTILE, *MODEL_LIKE, PLAN, "[", "]", ",", "\n"]) | st.text(), max_size=12
    ).map("".join),
    st.integers(1, 30),
)
def test_any_mixture_of_hostile_pieces_gives_a_plan_or_a_named_refusal(
    every_audit_event, text, actions
):
    with every_audit_event() as happened:
        check(text, actions)
    assert happened == []
    assert EXECUTED == []


def test_the_watch_sees_code_that_runs(every_audit_event):
    """Or else no test here would show anything."""
    with every_audit_event() as happened:
        eval(TRAP, {})
    assert {"compile", "exec"} <= set(happened)
    assert EXECUTED.pop() == "reply"


# What stands before and after the unit that is repeated.
FRAMES = (("", ""), ("M ", "x"), ("[", "x]"), ("```\n[", "\n```"))
UNITS = table("hostile_replies", "units")


def seconds(frame, unit, size):
    text = (unit * (size // len(unit))).join(frame)
    started = time.thread_time()
    parse_reply(text, N)
    return time.thread_time() - started


@pytest.mark.parametrize("unit", UNITS, ids=repr)
def test_no_repetition_takes_more_than_a_moment(unit):
    """In quadratic time, each of them would take seconds."""
    assert [frame for frame in FRAMES if seconds(frame, unit, 2**15) > 0.3] == []
