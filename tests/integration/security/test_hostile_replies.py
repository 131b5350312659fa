"""Whatever a model answers: a plan or a named refusal, no code, no exception, linear time."""

from __future__ import annotations

import math
import random
import sys
import time
from collections import Counter
from contextlib import contextmanager
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from merge_runner.config import ScenarioConfig
from merge_runner.emulator.driver import answer
from merge_runner.prompts.blocks import prompt_of, render_prompt
from merge_runner.prompts.parse import parse_reply
from merge_runner.records import Slot
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner.scenarios.merge.world import World

N = 20
REPLIES = 100_000
REFUSALS = {
    *("no_array", "several_arrays", "wrong_length", "not_a_number", "not_finite"),
    "out_of_range",
}
PLAN = ", ".join(["0.05"] * N)
# Where code that is evaluated would leave a trace of itself.
EXECUTED: list[str] = []
TRAP = f"__import__('sys').modules[{__name__!r}].EXECUTED.append('reply')"


class Watch:
    """What the interpreter reports: compiling, executing, importing, opening, starting, ..."""

    def __init__(self):
        self.events = []
        self.open = False
        sys.addaudithook(self.note)  # for good: a hook cannot be taken away

    def note(self, event, _):
        if self.open:
            self.events.append(event)

    @contextmanager
    def __call__(self):
        self.events.clear()
        self.open = True
        try:
            yield self.events
        finally:
            self.open = False


@pytest.fixture(scope="module")
def every_audit_event():
    return Watch()


def emulated():
    """Real replies of the emulator, in every condition, with and without the tactical token."""
    scenario = ScenarioConfig()
    for name, condition in CONDITIONS.items():
        for variant in ("baseline", "A1"):
            seen = World(scenario, condition, TRACK).observe("left")
            prompt = render_prompt(seen, None, prompt=prompt_of(variant), scenario=scenario)
            yield answer(prompt, Slot(name, 1, "left", 0, 0))


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
    *("1e999999", "-1e999999", "1e-999999", "9" * 400, "0." + "1" * 400, "nan", "-inf", "1_0"),
    *("0x1p3", "1j", "\u0661", "\u2212", "\u221e", "True", "None", "[]", "{}", "[[", "]]", "()"),
    *("__import__('os')", "__import__('os').system('true')", TRAP, f"[{TRAP}]", f"[{TRAP}]*20"),
    *("eval('1')", "exec('1')", "open('/etc/passwd')", "(lambda: 0)()", "np.array([0.1]*20)"),
    *("np.zeros(20).tolist()", "np.linspace(-1,1,20)", "float('1e5')", "float('nan')"),
    *("{{7*7}}", "${x}", "%s%n", "'; DROP TABLE trials;--", "<script>", "\x00", "\x1b[2J"),
    *("```", "````", "``", "```python", "```\n```", "#", "# [", "\\", "\r", "\r\n", "\u2028"),
    *("\ud800", "\udfff", "\ufeff", "\u202e", "\U0010ffff", "e\u0301" * 9, "M", "Y", "M/Y", "-- "),
]


def mutated(chance, replies):
    """A reply with up to six things wrong in it."""
    text = chance.choice(replies)
    for _ in range(chance.randrange(1, 7)):
        text = chance.choice(MUTATIONS)(chance, text, replies)[:4_000]
    return text


def flip(chance, text, _):
    raw = bytearray(text.encode(errors="surrogatepass"))
    for _ in range(chance.randrange(1, 4) if raw else 0):
        raw[chance.randrange(len(raw))] ^= 1 << chance.randrange(8)
    return raw.decode(errors=chance.choice(("replace", "ignore", "surrogateescape")))


def splice(chance, text, replies):
    other = chance.choice(replies)
    return text[: place(chance, text)] + other[place(chance, other) :]


def insert(chance, text, _):
    at = place(chance, text)
    return text[:at] + chance.choice(HOSTILE) * chance.choice((1, 1, 1, 2, 30)) + text[at:]


def delete(chance, text, _):
    at = place(chance, text)
    return text[:at] + text[at + chance.choice((1, 1, 2, 10, 100)) :]


def repeat(chance, text, _):
    at, end = sorted((place(chance, text), place(chance, text)))
    return text[:end] + text[at:end] * chance.choice((1, 2, 5)) + text[end:]


def nest(chance, text, _):
    opening, closing = chance.choice(("[]", "()", ["```\n", "\n```"], ["[" * 50, "]" * 50]))
    return opening + text + closing


def number(chance, text, _):
    """Another entry in the place of one."""
    entry = chance.choice((*HOSTILE, "0.1", "-1", "1.0000001", ".5", "+.5", "-0", "1e0", "00.5"))
    entries = text.split(", ")
    entries[chance.randrange(len(entries))] = entry
    return ", ".join(entries)


def place(chance, text):
    return chance.randrange(len(text) + 1)


MUTATIONS = (flip, splice, insert, delete, repeat, nest, number)


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


@pytest.mark.long
def test_a_hundred_thousand_mutated_replies_give_plans_or_named_refusals_and_run_nothing(
    every_audit_event,
):
    chance = random.Random(20260409)
    replies = [*emulated(), *MODEL_LIKE]
    outcomes = Counter()
    for _ in range(REPLIES // 1000):
        texts = [mutated(chance, replies) for _ in range(1000)]
        with every_audit_event() as happened:
            outcomes.update(check(text) for text in texts)
        assert happened == []
    assert EXECUTED == []
    assert outcomes.total() == REPLIES
    # Every outcome is met often, so that none is tested by name alone.
    assert outcomes.keys() == {"plan", *REFUSALS}
    assert min(outcomes.values()) > REPLIES / 1000, outcomes


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
        parsed = parse_reply(text, actions)
    assert happened == []
    assert (parsed.plan is None) == (parsed.failure in REFUSALS)
    check(text, actions)


def test_the_watch_sees_code_that_runs(every_audit_event):
    with every_audit_event() as happened:
        eval("1 + 1")
    assert {"compile", "exec"} <= set(happened)
    eval(TRAP, {})
    assert EXECUTED.pop() == "reply"


# What stands before and after the unit that is repeated.
FRAMES = (("", ""), ("M ", "x"), ("[", "x]"), ("```\n[", "\n```"))
UNITS = (
    *(
        "[",
        "]",
        "[]",
        "[[",
        "[1,",
        "[1],",
        "1,",
        "1",
        "0.",
        "1.1,",
        "1e",
        "e+",
        "-",
        "- ",
        "+ ",
        ".,",
    ),
    *("```", "``", "`", "```\n[", "```\n[1]\n```\n", "#", "# ", "#\n", "# [", "*", "_", "* "),
    *("M ", "M", "Y\n", "(M)", "tactical ", "tactical decision: ", "decision", "plan_", "merge "),
    *(
        " ",
        "\n",
        "\r\n",
        "\t ",
        "\r",
        "\u2212",
        "\u2013 ",
        "a",
        "a ",
        "\u00e9",
        "\U0001f697",
        "\x00",
    ),
    *("nan,", "np.", "float('", "infinity", "[0.1]*", "'", '"', ":", ")", "\u2014", "yield "),
)
SIZES = (2**10, 2**12, 2**14, 2**16, 2**18, 2**20)
# Four times the text takes about 4 times as long in linear and 16 times in quadratic time.
MOST_GROWTH = 9
NOTICEABLE_S = 0.02


def seconds(frame, unit, size):
    text = (unit * (size // len(unit))).join(frame)
    started = time.thread_time()
    parse_reply(text, N)
    return time.thread_time() - started


def grows_too_fast(frame, unit):
    """Whether four times the text takes much more than four times as long.

    What takes no noticeable time is not compared. Sizes grow step by step, so that quadratic time
    shows long before it becomes a wait. One measurement may be disturbed: five are not.
    """
    before = seconds(frame, unit, SIZES[0])
    for smaller, size in pairwise(SIZES):
        took = seconds(frame, unit, size)
        for _ in range(4):
            if took < max(NOTICEABLE_S, MOST_GROWTH * before):
                break
            took = min(took, seconds(frame, unit, size))
            before = max(before, seconds(frame, unit, smaller))
        else:
            return True
        before = took
    return False


@pytest.mark.long
@pytest.mark.parametrize("unit", UNITS, ids=repr)
def test_a_megabyte_takes_time_in_proportion_to_its_length(unit):
    assert [frame for frame in FRAMES if grows_too_fast(frame, unit)] == []
