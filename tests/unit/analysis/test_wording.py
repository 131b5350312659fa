"""The sentences that verdicts are told in, of rows made by hand."""

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from merge_runner_analysis.headlines import (
    TOO_FEW,
    crashes,
    difference_sentence,
    headline,
    sentence,
)
from merge_runner_analysis.two_drivers import apart, is_constant
from merge_runner_analysis.web.marks import SHAPES
from merge_runner_analysis.wording import (
    LANGUAGE_MODEL,
    MEASURES,
    OPEN,
    PLAYED_RULES,
    PROGRAM,
    RULES_MEAN,
    SHOWN,
    STRONGER,
    UNLIKE,
    WEAKER,
    crash_text,
    differs,
    money,
    shown_state,
    verdict_word,
)

PEOPLE = {"headway": "675 of 704", "velocity": "158 of 173", "collisions": "28 of 990"}
# What says that a driver differs from people, and in which direction.
DIRECTION = re.compile(
    r"\b(more|less|fewer|larger|smaller|otherwise)\b|does not (yield|decide|add)|moves|"
    "differs? from people:"
)


def row(measure, state="shown", *, n=110, p_holm=0.5, estimate=1.0, ci=(0.5, 1.5), **others):
    return {"measure": measure, "state": state, "n": n, "p_holm": p_holm, "estimate": estimate,
            "ci": ci, "human": 2.0, "human_ci": None, "difference": -1.0,
            "kind": LANGUAGE_MODEL, **others}  # fmt: skip


def driver(finished=110, *, collided=0, undecided=None, **states):
    """The rows of a driver by measure, which have these states or are as in humans."""
    n = finished + collided
    rows = {
        "headway": row("headway", n=n, counted="75 of 78"),
        "velocity": row("velocity", n=n, counted="16 of 19"),
        "collisions": row("collisions", "inconclusive", n=n, k=collided, undecided=undecided),
        "gap": row("gap", "inconclusive", n=finished),
    }
    raw = f"{collided + (undecided or 0)} of {n + (undecided or 0)}"
    rows["collisions"] |= {"counted": raw, "counted_by": "the rule of centres"}
    for name, people in PEOPLE.items():
        rows[name] |= {"human_counted": people}
    for place, (name, state) in enumerate(states.items(), 1):
        rows[name] |= {"state": state, "p_holm": place / 1000}
    return rows


WILD = driver(86, collisions="unlike", gap="unlike", collided=24)


@pytest.mark.parametrize(
    ("drivers", "claim", "because"),
    [
        ({}, "No language model drove here.", ""),
        (
            {"gpt": {"gap": row("gap", None)}},
            "No language model can be compared with people yet.",
            "",
        ),
        (
            {"wild": WILD},
            "wild differs from people: it crashed in 24 of 110 trials, people in 28 of 990.",
            "",
        ),
        ({"o3": driver()}, "No difference from people is shown for o3.", ""),
        (
            {"o3": driver(headway="weaker", gap="unlike")},
            "o3 differs from people: with it the one ahead went first in 75 of 78 trials, with "
            "people in 675 of 704.",
            "",
        ),
        (
            {"o3": driver(gap="unlike", undecided=33)},
            "o3 differs from people: it left a gap of 1.00 [0.50, 1.50] m (mean of its trials), "
            "people of 2.00 m.",
            "o3 crashed in 33 of 143 trials by the rule of centres, in 0 to 33 by people's rule; "
            "people in 28 of 990.",
        ),
        (
            {"o3": driver(), "wild": WILD},
            "wild differs from people: it crashed in 24 of 110 trials, people in 28 of 990.",
            "No difference from people is shown for o3.",
        ),
    ],
)
def test_a_headline_says_what_a_person_sees_at_once_in_counts_and_metres(drivers, claim, because):
    assert headline(drivers) == (claim, because)


def of_kind(kind, **states):
    """The rows of a driver that is no judged model."""
    return {name: row(name, state, kind=kind, n=40) for name, state in states.items()}


UNJUDGED = {"": {"kind": LANGUAGE_MODEL, "note": "not judged: why"}}
OPEN_GAP, SHOWN_HEADWAY = of_kind("mock", gap=OPEN), of_kind(PROGRAM, headway=SHOWN)
NONE = "No language model drove here."


@pytest.mark.parametrize(
    ("drivers", "says"),
    [
        ([UNJUDGED, OPEN_GAP], ["No language model is judged here.", ""]),
        ([OPEN_GAP], [NONE, ""]),
        (
            [OPEN_GAP, SHOWN_HEADWAY],
            [
                "1 of 1 drivers with enough trials let the one ahead go first, as people do. "
                "Cannot tell: the gap. No verdict on crashes and who goes first side by side.",
                NONE,
            ],
        ),
        (
            [of_kind(PROGRAM, headway="unlike"), of_kind(PROGRAM, collisions="unlike")],
            [
                "None of 1 drivers with enough trials crash as often as people; none of 1 let "
                "the one ahead go first, as people do. No verdict on who goes "
                "first side by side and the gap.",
                NONE,
            ],
        ),
        (
            [
                {"headway": row("headway", kind=PROGRAM, from_humans="yes")}
                | of_kind(PROGRAM, gap=OPEN),
                of_kind(PROGRAM, headway=SHOWN, gap="unlike"),
                {"collisions": row("collisions", n=11, kind=PROGRAM, counted="11 of 11")},
                {"collisions": row("collisions", OPEN, n=21, kind=PROGRAM, counted="9 of 21")},
            ],
            [
                "Of the 3 programs with enough trials d0 (it was made from the human data) is most "
                "like people: it agrees with them in 1 of 4 measures, and is shown to differ in "
                "none. Most crashes: d3 crashed in 9 of 21 trials.",
                "2 of 2 drivers with enough trials let the one ahead go first, as people do; 1 "
                "of 2 differs from people in the gap (cannot tell: 1). Cannot tell: crashes. No "
                "verdict on who goes first side by side. Without a verdict: d2 crashed in 11 of 11 "
                f"trials. {NONE}",
            ],
        ),
        (
            [{name: row(name, n=19, kind="mock")} for name in ("gap", "headway")],
            ["For 2 drivers no verdict on likeness to people is possible.", NONE],
        ),
        (
            [of_kind(PROGRAM, gap=OPEN)
             | {"collisions": row("collisions", OPEN, n=n, counted=f"{k} of {n}")}
             for k, n in ((21, 21), (2, 20), (1, 21), (0, 29), (9, 9))],
            ["Cannot tell: crashes and the gap. No verdict on who goes first with one ahead and "
             "who goes first side by side.",
             "Crashes range from 0 of 29 trials (d3) to 21 of 21 trials (d0). Without a verdict: "
             f"d4 crashed in 9 of 9 trials. {NONE}"],
        ),
    ],
)  # fmt: skip
def test_where_no_language_model_drove_the_headline_counts_drivers_and_says_who_did(drivers, says):
    assert [*headline({f"d{place}": of for place, of in enumerate(drivers)})] == says


def test_two_drivers_are_told_apart_with_names_and_numbers():
    crashed = {"k": 42, "n": 110, "k_reference": 84, "n_reference": 110, "p_corrected": 0.001,
               "difference": -38.64, "ci": (-50.0, -27.0)}  # fmt: skip
    gap = {"measure": "gap (m)", "value": 3.1, "value_reference": 4.2, "p_corrected": 0.01,
           "difference": -1.1}  # fmt: skip
    first = {"measure": "goes first (%)", "p_corrected": 0.5, "difference": 1.0}
    rows = {"collided_percent": crashed, "gap_m": gap, "left_first_percent": first}
    claim, rest = apart("a", "b", rows, of_left=True)
    assert claim == (
        "a crashed in 42 of 110 trials, b in 84 of 110. In the same situations a crashed less "
        "often, by 38.64 points [27.00, 50.00]; corrected p = 0.001."
    )
    smaller = (
        "Compared with b, with situations weighted alike for both, a leaves a smaller gap (3.10 "
        "against 4.20 m)."
    )
    assert rest == f"{smaller} No difference is shown in how often the left vehicle goes first."
    assert "how often it goes first." in apart("a", "b", rows, of_left=False)[1]
    claim, _ = apart("a", "b", rows | {"collided_percent": crashed | {"p_corrected": 0.4}},
                     of_left=True)  # fmt: skip
    assert "of 110. No difference is shown: −38.64 points [−50.00, −27.00]; corrected" in claim


@pytest.mark.parametrize("k", [0, 40])
def test_a_count_that_cannot_differ_is_not_compared(k):
    same = {"k": k, "n": 40, "k_reference": k, "n_reference": 40, "p_corrected": 1.0,
            "difference": 0.0, "ci": (-9.0, 9.0)}  # fmt: skip
    rows = {"collided_percent": same, "joint_percent": same | {"measure": "joint (%)"}}
    assert is_constant(same)
    assert not is_constant(same | {"k": 39})
    assert apart("a", "b", rows, of_left=True) == (
        f"a crashed in {k} of 40 trials, b in {k} of 40.",
        "",
    )


def test_a_crash_is_explained_by_the_rules_that_were_played():
    assert crash_text([("rectangle", [0.05, 0.2])]) == (
        "the vehicles' outlines overlap, checked every simulation step, 0.05 or 0.2 s"
    )
    both = crash_text([(rule, [0.2]) for rule in RULES_MEAN])
    assert " or, by the scenario of the trial, " in both
    assert PLAYED_RULES.keys() == RULES_MEAN.keys()


@pytest.mark.parametrize(
    ("of", "counts"),
    [
        (driver(0, undecided=11), "0 of 11"),
        (driver(1), "1 of 1"),
        (driver(7, undecided=15), "7 of 22"),
        (driver(19), "19 of 19"),
        (driver(7, undecided=12, collided=3), "7 of 22"),
        (driver(50, undecided=60, gap="unlike"), "50 of 110"),
        (driver(19, collided=91, gap="unlike"), "19 of 110"),
    ],
)
def test_of_few_outcomes_a_headline_says_the_counts_alone(of, counts):
    claim, because = headline({"gpt": of})
    assert claim == f"{TOO_FEW}: {counts}."
    assert because == f"gpt {crashes(of['collisions'])}."
    claim, because = headline({"wild": WILD, "gpt": of})
    assert claim == headline({"wild": WILD})[0]
    assert because == (f"{TOO_FEW}: gpt {counts}. gpt {crashes(of['collisions'])}.")


@pytest.mark.parametrize("of", [(20, 0), (16, 4), (0, 20)])
def test_who_collides_has_an_outcome_too(of):
    claim, _ = headline({"gpt": driver(of[0], collided=of[1], collisions="unlike")})
    assert claim.startswith("gpt differs from people: it crashed in")


def test_crashes_that_another_rule_decides_are_said_by_both():
    of = row("collisions", "inconclusive", n=10, k=2, counted="2 of 10", human_counted="5 of 90")
    assert crashes(of) == "crashed in 2 of 10 trials; people in 5 of 90"
    cut_off = of | {"undecided": 4, "counted": "6 of 14", "counted_by": PLAYED_RULES["euclid2d"]}
    assert crashes(cut_off) == (
        "crashed in 6 of 14 trials by the rule of centres, in 2 to 6 by people's rule; people in 5 "
        "of 90"
    )


@pytest.mark.parametrize(
    ("n", "says"),
    [(19, "fewer than 20 trials"), (20, "too few finished"), (28, "smaller than people's")],
)
def test_a_cell_has_no_verdict_where_the_headline_has_none(n, says):
    values = driver(n, collided=55 - n, gap="unlike")
    assert verdict_word(values["gap"] | {"ended": 55}) == says
    assert headline({"gpt": values})[0].startswith(TOO_FEW) is (n < 28)


def test_several_drivers_are_told_together():
    few = {"gpt": driver(7, undecided=15), "o4": driver(2)}
    assert headline(few)[0] == f"{TOO_FEW}: gpt 7 of 22 and o4 2 of 2."
    both = {"a": WILD, "b": WILD}
    crashed = "crashed in 24 of 110 trials, people in 28 of 990"
    told = f"differ from people: a {crashed}; b {crashed}."
    assert headline(both)[0] == f"Both language models here {told}"
    assert headline({**both, **few})[0] == f"a and b {told}"
    assert headline({**both, "o3": driver()})[0] == f"a and b {told}"
    four = dict.fromkeys("abcd", WILD)
    most = f"differ from people: most visibly a {crashed}; b {crashed}; c {crashed}."
    assert headline(four)[0] == f"All 4 language models here {most}"


@pytest.mark.parametrize(
    ("of", "says"),
    [
        (driver(95, collided=15), "crashed in 15 of 110 trials; people in 28 of 990"),
        (
            driver(7, collided=3, undecided=12),
            "crashed in 15 of 22 trials by the rule of centres, in 3 to 15 by people's rule; "
            "people in 28 of 990",
        ),
        (
            driver(109, collided=1, collisions="unlike"),
            "crashed in 1 of 110 trials, less often than people (28 of 990)",
        ),
        (driver(0), ""),
    ],
)
def test_crashes_are_said_raw_then_by_the_humans_rule(of, says):
    assert crashes(of["collisions"]) == says


@pytest.mark.parametrize("measure", ["gap-velocity", "held"])
@pytest.mark.parametrize(
    ("level", "said"),
    [(98.75, "98.75"), (100 * (1 - 0.05 / 7), "99.29"), (90.0, "90"), (95.0, None), (None, None)],
)
def test_an_interval_beside_a_margin_names_its_level_where_that_is_not_95_percent(
    measure, level, said
):
    text = difference_sentence(row(measure, n=14, level=level), "it")
    assert ("%:" in text) == bool(said)
    assert not said or f"1.00 [{said} %: 0.50, 1.50]" in text
    assert text.startswith(f"in another measure ({MEASURES[measure].label}), ")
    assert "%:" not in difference_sentence(row("gap", n=14, level=level), "it")


@pytest.mark.parametrize(
    ("of", "says"),
    [
        (
            driver(),
            "Crashed in 0 of 110 trials; people in 28 of 990. The one ahead goes first, as with "
            "people (the one ahead in 75 of 78 trials, people in 675 of 704). The faster one "
            "yields, as with people (side by side, the slower one in 16 of 19 trials, people in "
            "158 of 173). Cannot tell: crashes; mean gap.",
        ),
        (
            driver(headway="weaker"),
            "Who goes first depends less on who is ahead than with people (the one ahead in 75 of",
        ),
        (
            driver(velocity="unlike"),
            "The faster one tends to go first, with people the slower one (side by side,",
        ),
        (driver(gap="unlike"), "Leaves a gap of 1.00 m, smaller than people (2.00 m)"),
        (driver(50, collided=50, collisions="unlike"), "Crashed in 50 of 100 trials, less often"),
        ({"": {"note": "not judged: why"}}, "Not judged: why."),
    ],
)
def test_a_sentence_tells_the_states_of_the_rows(of, says):
    assert says in sentence(of)


@st.composite
def any_driver(draw):
    """The rows of a driver with states as their corrected p and their own tests set them."""
    finished, collided = draw(st.integers(0, 90)), draw(st.integers(0, 90))
    rows = driver(finished, collided=collided, undecided=draw(st.integers(0, 30)) or None)
    for name, measure in MEASURES.items():
        p_holm = draw(st.floats(0, 1))
        own = [SHOWN] if measure.trait.endswith(")") else [OPEN]
        states = [STRONGER, UNLIKE, WEAKER] if p_holm < 0.05 else [*own, OPEN]
        if name in {"collisions", "gap"}:
            states = ["unlike"] if p_holm < 0.05 else [OPEN]
        values = rows.get(name, row(name, n=finished))
        of = {"p_holm": p_holm, "state": draw(st.sampled_from(states))}
        of |= {"estimate": draw(st.floats(-5, 5)), "difference": draw(st.floats(-5, 5))}
        rows[name] = {**values, **of}
    return rows


@given(any_driver())
def test_no_sentence_claims_a_direction_that_the_corrected_p_does_not_carry(of):
    carried = [name for name, values in of.items() if values["p_holm"] < 0.05]
    texts = [sentence(of), " ".join(headline({"gpt": of}))]
    if not carried:
        assert not any(map(DIRECTION.search, texts)), texts
    assert "log-odds" not in " ".join(texts)
    for name in {*of} - {*carried}:
        alone = {**of, **{one: {**of[one], "state": OPEN, "p_holm": 1.0} for one in carried}}
        assert not DIRECTION.search(sentence({**alone, name: of[name]}))


@pytest.mark.parametrize(
    ("measure", "ci", "says"),
    [
        ("collisions", (-4.0, 5.0), "like people"),
        ("collisions", (-9.0, -5.1), "fewer than people's"),
        ("gap", (-1.0, -0.5), "like people"),
        ("gap", (-1.1, -0.5), "smaller than people's"),
        ("headway", (-0.1, -0.01), "weaker than people's"),
        ("held", (0.1, 0.2), "unlike people's"),
    ],
)
def test_within_a_margin_a_driver_is_like_people_wherever_that_is_said(measure, ci, says):
    of = row(measure, "unlike", difference=sum(ci) / 2, difference_ci=ci, p_holm=0.01)
    assert verdict_word(of) == says
    assert differs(of) is (says != "like people")


@pytest.mark.parametrize(
    ("measure", "estimate", "ci", "word", "says"),
    [
        ("gap-headway", 0.05, (0.01, 0.09), "weaker than people's",
         "Each metre that one is ahead adds less to its gap than to people's"),
        ("gap-headway", 0.5, (0.4, 0.6), "stronger than people's",
         "Each metre that one is ahead adds more to its gap than to people's"),
        ("gap-headway", -0.31, (-0.62, 0.003), "unlike people's, in no clear direction",
         "Each metre that one is ahead changes its gap in no clear direction (−0.31 m), and makes "
         "people's larger (0.17 m)"),
        ("gap-headway", -0.31, (-0.62, -0.003), "opposite to people's",
         "Each metre that one is ahead makes its gap smaller (−0.31 m), people's larger (0.17 m)"),
        ("headway", -1.0, (-2.0, -0.1), "opposite to people's",
         "The one behind tends to go first, with people the one ahead"),
        ("headway", -1.0, (-2.0, 0.0), "unlike people's, in no clear direction",
         "Neither the one ahead nor the one behind clearly tends to go first"),
        ("velocity", 1.0, (0.1, 2.0), "opposite to people's",
         "The faster one tends to go first, with people the slower one"),
        ("velocity", 0.1, (-0.5, 0.5), "unlike people's, in no clear direction",
         "Neither the slower nor the faster one clearly tends to go first"),
        ("velocity", -0.1, (-0.5, -0.01), "weaker than people's",
         "Who goes first depends less on who is slower than with people"),
    ],
)  # fmt: skip
def test_a_slope_unlike_people_s_has_their_direction_the_opposite_or_none(
    measure, estimate, ci, word, says
):
    human = {"headway": 1.1, "velocity": -3.3, "gap-headway": 0.17}[measure]
    of = row(measure, "unlike", estimate=estimate, ci=ci, human=human, p_holm=0.01,
             difference=estimate - human)  # fmt: skip
    assert (verdict_word(of), differs(of)) == (word, True)
    assert sentence({"collisions": row("collisions", None, n=0), measure: of}).startswith(says)
    assert SHAPES[shown_state(of)] == {"w": "weaker", "s": "stronger"}.get(word[0], "unlike")


@pytest.mark.parametrize(
    ("value", "text"),
    [(None, "–"), (0.0, "0.00"), (12.345, "12.35"), (0.5, "0.50"), (0.0123, "0.012"),
     (-0.00056, "−0.00056")],
)  # fmt: skip
def test_a_price_has_two_digits_at_least(value, text):
    assert money(value) == text


def test_a_measure_of_a_sign_alone_has_another_word_than_one_with_a_margin():
    for name in ("headway", "velocity", "gap-headway"):
        assert verdict_word(row(name, SHOWN)) == "same tendency as people"
    # Nor can a slope that is smaller be read as a smaller count.
    assert verdict_word(row("velocity", WEAKER)) == "weaker than people's"
    assert verdict_word(row("headway", STRONGER)) == "stronger than people's"
    assert verdict_word(row("gap-velocity", SHOWN)) == "like people"
