"""The sentences that verdicts are told in, of rows made by hand."""

import pytest

from merge_runner_analysis.wording import headline, sentence, told


def row(measure, state="shown", *, n=110, p_holm=0.5, estimate=1.0, ci=(0.5, 1.5), **others):
    return {"measure": measure, "state": state, "n": n, "p_holm": p_holm, "estimate": estimate,
            "ci": ci, "human": 2.0, "human_ci": None, **others}  # fmt: skip


def driver(finished=110, *, collided=0, undecided=None, **states):
    """The rows of a driver by measure, which have these states or are as in humans."""
    n = finished + collided
    rows = {
        "headway": row("headway", n=n),
        "velocity": row("velocity", n=n),
        "collisions": row("collisions", "inconclusive", n=n, k=collided, undecided=undecided),
        "gap": row("gap", "inconclusive", n=finished),
    }
    for place, (name, state) in enumerate(states.items(), 1):
        rows[name] |= {"state": state, "p_holm": place / 1000}
    return rows


WILD = driver(collisions="unlike", gap="unlike", collided=10)


@pytest.mark.parametrize(
    ("drivers", "claim", "because"),
    [
        ({}, "No language model is judged here.", ""),
        (
            {"gpt": {"gap": row("gap", None)}},
            "No language model can be compared with humans yet.",
            "",
        ),
        (
            {"wild": WILD},
            "wild does not drive like humans:",
            "it collides in 1.00 [0.50, 1.50] % of trials, humans in 2.00 % (n = 120).",
        ),
        ({"o3": driver()}, "No difference from humans is shown for o3.", ""),
        (
            {"o3": driver(), "wild": WILD},
            "No difference from humans is shown for o3;",
            "but wild collides in 1.00 [0.50, 1.50] % of trials, humans in 2.00 % (n = 120). 2 of "
            "8 comparisons with humans show a difference at 5 %, corrected by Holm within each of "
            "2 models.",
        ),
    ],
)
def test_a_headline_says_the_surest_difference_and_how_many_comparisons_it_rests_on(
    drivers, claim, because
):
    assert headline(drivers) == (claim, because)


@pytest.mark.parametrize(
    ("of", "counts"),
    [
        (driver(0, undecided=11), "0 finished trials of 11"),
        (driver(1), "1 finished trial"),
        (driver(7, undecided=15), "7 finished trials of 22"),
        (driver(19), "19 finished trials"),
        (driver(7, undecided=12, collided=3), "7 finished trials of 22"),
    ],
)
def test_of_few_outcomes_a_headline_says_the_counts_alone(of, counts):
    rest = "too few to say whether it drives like humans."
    assert headline({"gpt": of}) == (f"gpt: {counts}, {rest}", "")
    claim, because = headline({"wild": WILD, "gpt": of})
    assert claim == "wild does not drive like humans:"
    assert because == f"{headline({'wild': WILD})[1]} gpt: {counts}, {rest}"


@pytest.mark.parametrize("of", [(20, 0), (16, 4), (0, 20)])
def test_who_collides_has_an_outcome_too(of):
    claim, _ = headline({"gpt": driver(of[0], collided=of[1], gap="unlike")})
    assert claim == "gpt does not drive like humans:"


def test_several_drivers_are_told_together():
    few = {"gpt": driver(7, undecided=15), "o4": driver(2)}
    assert headline(few)[0] == (
        "gpt: 7 finished trials of 22 and o4: 2 finished trials, too few to say whether they drive "
        "like humans."
    )
    assert headline({"a": WILD, "b": WILD})[0] == "No language model here drives like humans:"
    assert headline({"a": WILD, "b": WILD, **few})[0] == "a and b do not drive like humans:"


@pytest.mark.parametrize("measure", ["gap-velocity", "held"])
@pytest.mark.parametrize(
    ("level", "said"),
    [(98.75, "98.75"), (100 * (1 - 0.05 / 7), "99.29"), (90.0, "90"), (95.0, None), (None, None)],
)
def test_an_interval_beside_a_margin_names_its_level_where_that_is_not_95_percent(
    measure, level, said
):
    own = f"; its interval at {said} %" if said else ""
    assert told(row(measure, n=14, level=level)).endswith(f"(n = 14{own})")
    assert told(row("gap", n=14, level=level)).endswith("(n = 14)")


@pytest.mark.parametrize(
    ("of", "says"),
    [
        (driver(), "Goes first as humans do. Collisions and mean gap: inconclusive."),
        (
            driver(headway="weaker"),
            "Goes first by headway less than humans. When faster, yields as",
        ),
        (driver(velocity="unlike"), "When faster, does not yield as humans do. "),
        (driver(50, collided=50, collisions="unlike"), "Collides in 50.00 % of trials"),
        (
            driver(2, collided=1, undecided=1),
            "ions (25.00 to 50.00 % of trials) and mean gap: inco",
        ),
        ({"": {"note": "not judged: why"}}, "Not judged: why."),
    ],
)
def test_a_sentence_tells_the_states_of_the_rows(of, says):
    assert says in sentence(of)
