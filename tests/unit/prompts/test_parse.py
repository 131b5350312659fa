"""Replies as models write them: what is read, what is refused by name, and nothing is run."""

import signal

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from merge_runner.prompts.parse import parse_reply

N = 20
PLAN = tuple(round(0.05 * k - 0.5, 2) for k in range(N))
LIST = str(list(PLAN))
OTHER = str([-0.5] * N)
TIMES = str([round(0.2 * k, 1) for k in range(N)])  # out of range
REFUSALS = {
    "no_array",
    "several_arrays",
    "wrong_length",
    "not_a_number",
    "not_finite",
    "out_of_range",
}
MB = 1_000_000

law = settings(deadline=None, derandomize=True)  # the gate must not depend on luck or load


def fenced(code, tag="python"):
    return f"M\nI go first because I am ahead.\n```{tag}\n{code}\n```"


def with_first(entry):
    """A plan of the right length whose first entry is ``entry``."""
    return fenced(f"[{entry}, {', '.join(['0.0'] * (N - 1))}]")


@pytest.mark.parametrize("tag", ["python", "Python", "py", "json", "", " python "])
def test_the_language_tag_of_the_fence_does_not_matter(tag):
    assert parse_reply(fenced(LIST, tag), N).plan == PLAN


@pytest.mark.parametrize(
    "code",
    [
        f"  {LIST}  ",
        LIST.replace(",", " ,  "),
        LIST.replace(", ", ","),
        LIST.replace(", ", ",\n    "),
        LIST.replace("[", "[\n").replace("]", "\n]"),
        LIST.replace("]", ",]"),
        LIST.replace("]", ",\n]"),
        f"np.array({LIST})",
        f"import numpy as np\nplan = np.array({LIST}, dtype=float)",
        f"plan = {LIST}",
        f"[{LIST}]",
        f"# the plan, first action first\n{LIST}  # [m/s^2] / 2.5",
        LIST.replace(", ", ",  # 0.2 s later\n", 1),
        f"{LIST}\n\n{LIST}",
        LIST.replace("-0.5,", "-0.50,", 1) + "\n" + LIST,
        LIST.replace("-0.5,", "- 0.5,", 1),
        LIST.replace("-", "\u2212"),
        LIST.replace("-", "\u2013"),
        LIST.replace("0.", "."),
        LIST.replace("0.05", "5e-2"),
        LIST.replace(" 0.45", " +0.45"),
    ],
)
def test_a_sloppily_written_list_is_read(code):
    parsed = parse_reply(fenced(code), N)
    assert (parsed.plan, parsed.failure) == (PLAN, None)


@pytest.mark.parametrize(
    "reply",
    [
        LIST,
        f"M\nI go first.\n{LIST}",
        f"M\nI go first: {LIST} is my plan.",
        f"M\nI go first.\n```python\n{LIST}",
        f"M\n```\n{LIST}\n```\nI stay ahead by about 5 m [see above].",
        f"M\nThe [other] car, at [0.1, 0.2], is behind.\n```python\n{LIST}\n```",
        f"```python\n{LIST}\n```\nAgain:\n```python\n{LIST}\n```",
        f"[a safe gap] {LIST}",
        f"{fenced(LIST)}\n{fenced('[0.0]')}",
        f"{fenced('headways = [4.5, 9.1]')}\n{fenced(LIST)}",
        fenced(f"times = {TIMES}\nplan = {LIST}"),
        fenced(f"[{TIMES}, {LIST}]"),
        fenced("") + LIST,
        f"{LIST}\nIn a terminal, run\n```sh\nls [a-z]*\n```",
        # What stands in code comes before what stands in prose.
        f"An array like {list(range(20))} is asked for.\n{fenced(LIST)}",
        f"An array like {[0] * 20} would keep my speed.\n{fenced(LIST)}",
        f"{fenced(LIST)}\nI could also have braked: {OTHER}.",
    ],
)
def test_one_valid_list_is_enough_wherever_it_stands(reply):
    assert parse_reply(reply, N).plan == PLAN


def test_line_endings_change_nothing():
    reply = f"M\n\nI am ahead.\nI go first.\n```python\n{LIST}\n```\nSee you."
    assert parse_reply(reply.replace("\n", "\r\n"), N) == parse_reply(reply, N)


def test_whole_numbers_and_both_bounds_are_valid():
    assert parse_reply(with_first("-1"), N).plan == (-1.0,) + (0.0,) * (N - 1)
    assert parse_reply(with_first("1"), N).plan == (1.0,) + (0.0,) * (N - 1)


def test_the_length_that_is_wanted_is_the_callers():
    assert parse_reply("[0.1, 0.2]", 2).plan == (0.1, 0.2)
    assert parse_reply("[0.1, 0.2]", 3).failure == "wrong_length"


@pytest.mark.parametrize(
    ("reply", "failure"),
    [
        ("", "no_array"),
        ("I cannot help with that.", "no_array"),
        (fenced("0.1, 0.2"), "no_array"),
        (fenced("(" + LIST[1:-1] + ")"), "no_array"),
        (fenced(LIST[:-1]), "no_array"),  # cut off in the middle of the list
        (fenced(LIST + LIST.replace("0.45", "0.46")), "several_arrays"),
        (f"{fenced(LIST)}\n{fenced(OTHER)}", "several_arrays"),
        (f"Either {LIST} or {OTHER}.", "several_arrays"),
        (f"Either {LIST} or {OTHER}.\n{fenced('[0.0]')}", "several_arrays"),
        (f"{fenced(f'[{LIST}, {OTHER}]')}\nI take {LIST}.", "several_arrays"),
        # Of several lists that are no plan, the one that comes nearest says what is wrong.
        (fenced("[0.5] * 5 + [0.0] * 15"), "wrong_length"),
        (f"[a safe gap] {[0.0] * 19}", "wrong_length"),
        (fenced(f"[x for x in y] {[0.0] * 19} {TIMES}"), "out_of_range"),
        (f"{fenced(str([0.0] * 19))}\nAt {TIMES} s.", "out_of_range"),
        (f"[0.1] {with_first('None')}", "not_a_number"),
        (f"[0.1] {with_first('nan')} {with_first('None')}", "not_finite"),
        (fenced(str([[0.1]] * N)), "wrong_length"),
        (fenced(f"[{[0.1] * 10}, {[0.2] * 10}]"), "wrong_length"),
        (fenced("[]"), "wrong_length"),
        (fenced("[0.1]*20"), "wrong_length"),
        (fenced(str([0.0] * 19)), "wrong_length"),
        (fenced(str([0.0] * 21)), "wrong_length"),
        (with_first("nan"), "not_finite"),
        (with_first("NaN"), "not_finite"),
        (with_first("inf"), "not_finite"),
        (with_first("-Infinity"), "not_finite"),
        (with_first("np.nan"), "not_finite"),
        (with_first("math.inf"), "not_finite"),
        (with_first("float('inf')"), "not_finite"),
        (with_first('float("-nan")'), "not_finite"),
        (with_first("1e999"), "not_finite"),
        (with_first("-1e999"), "not_finite"),
        (with_first("1.0001"), "out_of_range"),
        (with_first("-1.0001"), "out_of_range"),
        (with_first("2.5"), "out_of_range"),
        (with_first("1e300"), "out_of_range"),
        (with_first("1.0000000000000002"), "out_of_range"),  # the next float above 1
        (with_first("True"), "not_a_number"),
        (with_first("None"), "not_a_number"),
        (with_first("'0.1'"), "not_a_number"),
        (with_first("0.1 m/s^2"), "not_a_number"),
        (with_first("..."), "not_a_number"),
        (with_first(""), "not_a_number"),
        (with_first("1/2"), "not_a_number"),
        (with_first("0.5 * 2"), "not_a_number"),
        (with_first("--0.5"), "not_a_number"),
        (with_first("0 .5"), "not_a_number"),
        (with_first("1_0e-2"), "not_a_number"),
        (with_first("0x1"), "not_a_number"),
        (with_first("1j"), "not_a_number"),
        (with_first("\u0967"), "not_a_number"),  # a digit, but not an ASCII one
        (with_first("__import__('os').getpid()"), "not_a_number"),
        (fenced("[0.1 for _ in range(20)]"), "not_a_number"),
        (fenced(LIST.replace(", ", "; ")), "not_a_number"),
    ],
)
def test_what_holds_not_one_plan_is_refused_by_name(reply, failure):
    parsed = parse_reply(reply, N)
    assert (parsed.plan, parsed.failure) == (None, failure)


def test_an_expression_is_never_evaluated(tmp_path):
    trace = tmp_path / "trace"
    parse_reply(with_first(f"__import__('pathlib').Path({str(trace)!r}).touch()"), N)
    assert not trace.exists()


@pytest.mark.parametrize(
    ("head", "token", "rationale"),
    [
        ("M\nI am ahead.", "M", "I am ahead."),
        ("Y\n\nI yield.", "Y", "I yield."),
        ("m\nI am ahead.", "M", "I am ahead."),
        ("**Y**\nI yield.", "Y", "I yield."),
        ("`M`\nI am ahead.", "M", "I am ahead."),
        ('"M"\nI am ahead.', "M", "I am ahead."),
        ("(Y)\nI yield.", "Y", "I yield."),
        ("M.\nI am ahead.", "M", "I am ahead."),
        ("Decision: M\nI am ahead.", "M", "I am ahead."),
        ("**Decision:** Y\nI yield.", "Y", "I yield."),
        ("**Tactical decision: M**\nI am ahead.", "M", "I am ahead."),
        ("### Tactical decision: Y\nI yield.", "Y", "I yield."),
        ("M (merge first)\nI am ahead.", "M", "I am ahead."),
        ("Y (yield)\nI am behind.", "Y", "I am behind."),
        ("Y - I yield because I am behind.", "Y", "I yield because I am behind."),
        ("**M** - I am ahead.", "M", "I am ahead."),
        ("M: I am ahead.", "M", "I am ahead."),
        ("Y, because I am behind.", "Y", "because I am behind."),
        ("M", "M", ""),
    ],
)
def test_the_token_is_read_in_its_usual_dressings_and_left_out_of_the_rationale(
    head, token, rationale
):
    parsed = parse_reply(f"{head}\n```python\n{LIST}\n```", N)
    assert (parsed.tactical, parsed.rationale, parsed.plan) == (token, rationale, PLAN)


@pytest.mark.parametrize(
    "head",
    [
        "Y \u2014 I yield because I am behind.",
        "Y\u2014I yield because I am behind.",
    ],
)
def test_an_em_dash_parts_the_token_from_the_rationale_as_a_hyphen_does(head):
    parsed = parse_reply(f"{head}\n{LIST}", N)
    assert (parsed.tactical, parsed.rationale) == ("Y", "I yield because I am behind.")


@pytest.mark.parametrize(
    "prose",
    [
        "",
        "Maybe I go first.",
        "May I go first?",
        "My car is ahead.",
        "Merging first is safe.",
        "Yes, I go first.",
        "Yielding is safe.",
        "Yield or merge?",
        "Merge first (Y)",
        "Decision: M/Y",
        "Decision: merge first or yield",
        "Decision: do not yield",
        "Decision: not M",
        '{"choice": "none"}',
        "I think.\nDecision: M\nNo.\nDecision: Y",
        "You see me ahead.",
        "Decision: Maybe",
        "M, Y",
        "M (yield)",
        "Y; no, M.",
        "Decision: M, Y",
        "Decision: M, or yield, as you like",
        "Decision: M (yield)",
        "Decision: yield; no, merge first",
        "**Decision: yield**, or merge first",
        "Decision: merge (behind the other car)",
        "Decision: merge, after the other car.",
        "Decision (M/Y): M/Y",
        "I merge first (M).",
        "The other car yields.\nM",
        "M/Y",
        "MY",
    ],
)
def test_a_word_or_a_late_letter_is_no_token_and_stays_in_the_rationale(prose):
    parsed = parse_reply(f"{prose}\n```python\n{LIST}\n```", N)
    assert (parsed.tactical, parsed.rationale, parsed.plan) == (None, prose, PLAN)


@pytest.mark.parametrize(
    ("head", "token", "rationale"),
    [
        ("Decision: Merge first\nI am ahead.", "M", "I am ahead."),
        ("**Yield**\nI am behind.", "Y", "I am behind."),
        ("Yield\nI am behind.", "Y", "I am behind."),
        ("Yield to the other car.\nI am behind.", "Y", "I am behind."),
        ("Merge first (M)\n\nI am ahead.", "M", "I am ahead."),
        ("1. Merge\nI am ahead.", "M", "I am ahead."),
        ("1. M\nI am ahead.", "M", "I am ahead."),
        ("My decision is to yield.\nI am behind.", "Y", "I am behind."),
        ("## Tactical decision\n\n**Yield**\nI am behind.", "Y", "I am behind."),
        ("## Decision\nM\nI am ahead.", "M", "I am ahead."),
        ("Decision: Y - I am behind.", "Y", "I am behind."),
        ("**Decision: yield**, I am behind.", "Y", "I am behind."),
        ("Tactical decision: merge first because I am ahead.", "M", "because I am ahead."),
        ("Decision: yield, merging behind it.", "Y", "merging behind it."),
        ("Decision: merge. After that I keep the lead.", "M", "After that I keep the lead."),
        ("Tactical decision (M/Y): Y\nI am behind.", "Y", "I am behind."),
        ("**Tactical decision (M or Y):** M\nI am ahead.", "M", "I am ahead."),
        ("Decision (M/Y): merge first, I am ahead.", "M", "I am ahead."),
        # What stands further below stays in the rationale.
        ("I am ahead.\n**Decision:** Merge first.", "M", "I am ahead.\n**Decision:** Merge first."),
        ("Decision: M\nSo: go.\nDecision: M", "M", "So: go.\nDecision: M"),
        ('{"decision": "yield"}', "Y", '{"decision": "yield"}'),
    ],
)
def test_a_decision_in_other_words_is_read(head, token, rationale):
    parsed = parse_reply(f"{head}\n```python\n{LIST}\n```", N)
    assert (parsed.tactical, parsed.rationale, parsed.plan) == (token, rationale, PLAN)


@pytest.mark.parametrize("key", ["decision", "tactical_decision", "Tactical decision", "choice"])
@pytest.mark.parametrize(("word", "token"), [("M", "M"), ("yield", "Y"), ("Merge first", "M")])
def test_a_decision_is_a_member_of_an_object(key, word, token):
    text = f'{{"{key}": "{word}", "plan": {LIST}}}'
    for reply in (text, f"```json\n{text}\n```", text.replace('"', "'")):
        parsed = parse_reply(reply, N)
        assert (parsed.tactical, parsed.plan) == (token, PLAN)


@law
@given(st.text(st.characters(blacklist_characters="[]`")), st.sampled_from("MY"))
def test_whatever_is_below_a_letter_changes_nothing_of_it(prose, letter):
    assert parse_reply(f"{letter}\n{prose}", N).tactical == letter


@pytest.mark.parametrize("minus", "\u2010\u2011\u2012\u2013\u2014\u2212\ufe63\uff0d")
@pytest.mark.parametrize("space", " \u00a0\u202f\u2009")
def test_another_character_for_the_minus_or_a_space_is_read(minus, space):
    code = LIST.replace("-", minus).replace(" ", space)
    assert parse_reply(fenced(code), N).plan == PLAN


@pytest.mark.parametrize("invisible", "\u200b\u200c\u200d\u2060\ufeff")
def test_a_character_that_nobody_sees_is_nothing_within_a_plan(invisible):
    for code in (
        LIST.replace("0.", f"{invisible}0.{invisible}"),
        LIST.replace(",", invisible + ","),
    ):
        assert parse_reply(fenced(code), N).plan == PLAN


def test_the_rationale_holds_all_prose_and_no_list():
    before, after = "I am ahead.", "I check again in a second."
    assert parse_reply(f"M\n{before}\n```\n{LIST}\n```\n{after}", N).rationale == (
        f"{before}\n{after}"
    )
    assert parse_reply(f"M\n{before}\n{LIST}", N).rationale == before


def test_token_and_rationale_survive_an_invalid_plan():
    parsed = parse_reply(fenced("[0.1]"), N)
    assert (parsed.plan, parsed.failure) == (None, "wrong_length")
    assert (parsed.tactical, parsed.rationale) == ("M", "I go first because I am ahead.")


@law
@given(st.text() | st.text("[]`#,.-+0123456789eEinfMY \r\n\"'*:"))
def test_any_text_gives_a_plan_or_a_named_refusal(text):
    parsed = parse_reply(text, 1)
    if parsed.plan is None:
        assert parsed.failure in REFUSALS
    else:
        assert parsed.failure is None
        assert len(parsed.plan) == 1
        assert -1 <= parsed.plan[0] <= 1


@law
@given(st.lists(st.floats(-1, 1), min_size=N, max_size=N))
def test_a_plan_that_is_written_out_in_full_survives_exactly(plan):
    parsed = parse_reply(fenced(repr(plan)), N)
    # By their spelling, since 0.0 == -0.0.
    assert list(map(repr, parsed.plan)) == list(map(repr, plan))


@pytest.fixture
def _watchdog():
    """A pattern that backtracks would need hours for a megabyte: fail instead of hanging."""

    def give_up(signum, frame):
        raise TimeoutError("the parser does not come to an end")

    previous = signal.signal(signal.SIGALRM, give_up)
    signal.alarm(120)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, previous)


@pytest.mark.usefixtures("_watchdog")
@pytest.mark.parametrize(
    "text",
    [
        "[" * MB,
        "]" * MB,
        "[array no.]" * (MB // 11),
        "[[" * (MB // 4) + "]]" * (MB // 4),
        "[0," * (MB // 3),
        "[" + "0.00000000," * (MB // 11) + "]",
        "```" * (MB // 3),
        "```\n[" * (MB // 5),
        "#" * MB,
        "\r\n" * (MB // 2),
        " " * MB,
        "*" * MB,
        "M" * MB,
        "M " * (MB // 2),
        "decision: " * (MB // 10),
        "decision:\n" * (MB // 10),
        ("decision: " * 7 + "\n") * (MB // 71),
        ("-" * 79 + "\n") * (MB // 80),
        '{"decision": ' * (MB // 13),
        "[" + " " * MB + "x]",
        "[-" + " " * MB + "]",
        "[" + "-" * MB + "]",
        "[0." + "1" * MB + "]",
        "[0." + "1" * MB + "x]",
        "[1e" + "1" * MB + "]",
        "[" + "1" * MB + "]",
        "[" + "1" * MB + "x]",
    ],
    ids=lambda text: f"{text[:12]!r}...{text[-3:]!r}",
)
def test_a_megabyte_of_hostile_text_is_refused(text):
    assert parse_reply(text, N).failure in REFUSALS
