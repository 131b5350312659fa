"""The answer to a study's own question, of rows made by hand."""

import re
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from merge_runner_analysis.tables.model import Column, Row, Table
from merge_runner_analysis.web import effect_rows
from merge_runner_analysis.web.claims import UNREAD, answered
from merge_runner_analysis.web.question import answer_of
from merge_runner_analysis.wording import EGO, LEFT, PLANTED, SAME_TRIALS, WORDS

GOES_FIRST, GAP, COST = "goes first (%)", "gap (m)", "cost (USD)"
METRICS = {GOES_FIRST: "left_first_percent", "coll. (%)": "collided_percent", GAP: "gap_m",
           COST: "cost_usd"}  # fmt: skip
DIRECTION = re.compile(r"\bchanges\b|\binteract:")


def effect(factor="hurry", p=0.001, measure=GOES_FIRST, *, difference=13.0, n=400, **values):
    of = {"level": "yes", "reference": "no", "estimate": 63.0, "estimate_reference": 50.0}
    name = f"{factor}=yes/{METRICS[measure]}"
    if " × " in factor:
        name = f"persona=taxi/hurry=yes/interaction/{METRICS[measure]}"
    main = measure == GOES_FIRST and " × " not in factor and factor != "model"
    of |= {"factor": factor, "measure": measure, "difference": difference, "p": p}
    of |= {"ci": (difference - 7, difference + 7), "p_corrected": p, "detectable": 10.0}
    of |= {"n": n, "n_reference": n, "primary": "primary" if main else None}
    return Row(name, (), of | values)


def unspaced(text):
    return text.replace(effect_rows.NO_BREAK, " ")


def copied(factor):
    """Levels of which a mock model plays the same trials."""
    row = effect(factor, p=None, difference=0.0, n=0, drivers="scripted")
    values = row.values | dict.fromkeys(("estimate", "estimate_reference", "difference", "ci"))
    return replace(row, values=values, note=SAME_TRIALS, untested=True)


HURRY = (
    "Hurry changes who goes first: in the same situations the driver under study goes first in "
    "63.00 % of finished trials with hurry=yes and in 50.00 % with hurry=no."
)
SAME = "The difference is +13.00 points [6.00, 20.00] (95 % interval), corrected "
SEEN = "The study had 80 % power for an effect of 10.00 points."


@pytest.mark.parametrize(
    ("rows", "claim", "rest"),
    [
        ([], "", ""),
        ([effect(p=None)], "", ""),
        (
            [effect("persona", 0.5, difference=1.0), effect()],
            HURRY,
            f"{SAME}p = 0.001. Persona=yes is not shown to change who goes first: "
            "+1.00 points [−6.00, 8.00], "
            "corrected p = 0.500.",
        ),
        (
            [effect(p=0.2), effect(measure=GAP, p=0.0001, estimate=3.8, estimate_reference=4.3)],
            "No change of who goes first is shown by hurry.",
            "Hurry=yes is not shown to change who goes first: +13.00 points [6.00, 20.00], "
            f"corrected p = 0.200. {SEEN} Hurry changes the gap at the merge point: "
            "3.80 m with hurry=yes, 4.30 m with hurry=no.",
        ),
        (
            [effect(p=0.0001), effect("hurry × persona", 0.01, difference=-8.0)],
            HURRY,
            f"{SAME}p < 0.001. Hurry and persona interact: −8.00 points [−15.00, −1.00], "
            "corrected p = 0.010.",
        ),
        (
            [effect(drivers="scripted"), copied("persona")],
            f"In a rehearsal with a mock model, h{HURRY[1:]}",
            f"{SAME}p = 0.001. Persona=yes is {UNREAD}.",
        ),
        (
            [effect(f"words{n}", 0.9 - n / 10, difference=1.0) for n in range(4)],
            "No change of who goes first is shown by words3, words2, words1 and words0.",
            "4 levels are not shown to change who goes first; words3=yes comes nearest: "
            "+1.00 points "
            f"[−6.00, 8.00], corrected p = 0.600. {SEEN}",
        ),
        (
            [copied("hurry")],
            f"In a rehearsal with a mock model, hurry=yes is {UNREAD}.",
            "",
        ),
        (
            [
                effect("hurry", 0.0001, drivers="scripted"),
                effect("hurry", 0.4, difference=2.0),
                effect("persona × hurry", 0.01, difference=-8.0, drivers="scripted"),
            ],
            "No change of who goes first is shown by hurry.",
            "Hurry=yes is not shown to change who goes first: +2.00 points [−5.00, 9.00], "
            f"corrected p = 0.400. {SEEN}",
        ),
        (
            [effect(p=0.2), effect("persona", 0.3, difference=1.0)],
            "No change of who goes first is shown by hurry and persona.",
            "Hurry=yes is not shown to change who goes first: +13.00 points [6.00, 20.00], "
            "corrected p = "
            "0.200. Persona=yes is not shown to change who goes first: "
            "+1.00 points [−6.00, 8.00], corrected p "
            f"= 0.300. {SEEN.rstrip('.')} (hurry), 10.00 (persona).",
        ),
        (
            [effect(n=12)],
            "Too few trials to say whether hurry changes who goes first: 12 a level.",
            "",
        ),
    ],
)
def test_the_answer_is_the_primary_test_and_else_what_could_have_been_seen(rows, claim, rest):
    assert answered(rows) == (claim, rest)


@given(
    st.lists(
        st.tuples(
            st.sampled_from(["hurry", "persona", "model", "hurry × persona"]),
            st.floats(0.05, 1),
            st.sampled_from([*METRICS]),
            st.floats(-50, 50),
        )
    )
)
def test_no_change_is_claimed_that_no_corrected_p_carries(found):
    rows = [effect(name, p, measure, difference=d) for name, p, measure, d in found]
    claim, rest = answered(rows)
    assert not DIRECTION.search(claim + rest)
    assert "no effect" not in (claim + rest).lower()


def levels_of(factor, drivers=("",)):
    """The two levels of a factor, of all drivers and of each."""
    return [
        Row(
            f"{driver}{factor}={level}",
            (),
            {"factor": factor, "level": level, "driver": driver.rstrip("/") or None, "k": k,
             "n": 100, "value": k, "ci": (k - 8.0, k + 8.0), "crashed": 3, "ended": 103,
             "repeated": 7, "gap_m": None, "rmse_mps": 1.0},
        )
        for driver in drivers
        for level, k in (("no", 50), ("yes", 63))
    ]  # fmt: skip


def answer(effects, levels, *notes):
    columns = (Column("factor", "factor"),)
    tables = (Table("effects", columns, effects, notes), Table("levels", columns, levels, notes))
    return answer_of(*tables)


PLANT = f"{PLANTED}: hurry=yes adds 1.5"


@pytest.mark.parametrize(("drivers", "is_said"), [("scripted", True), (None, False)])
def test_a_planted_effect_is_said_of_a_rehearsal_with_its_size(drivers, is_said):
    rest = answer([effect(drivers=drivers)], levels_of("hurry"), PLANT).rest
    assert rest.endswith(f"{PLANT[0].upper()}{PLANT[1:]}.") is is_said
    assert "lanted" not in answer([effect(drivers=drivers)], levels_of("hurry")).rest


@pytest.mark.parametrize("who", [EGO, LEFT])
def test_the_driver_that_goes_first_is_named_and_explained(who):
    made = answer([effect()], levels_of("hurry"), who[1])
    assert f"in the same situations {who[0]} goes first in" in made.claim
    assert made.who == f"G{who[1][1:]}"


def test_a_side_has_its_count_and_the_chart_the_axis_of_its_data():
    made = answer(
        [effect(), effect(measure="coll. (%)", p=0.3)], levels_of("hurry", ("", "o3/", "o4/"))
    )
    (change,), (crashes,) = made.changes, made.others
    assert made.asked == "Does hurry change who goes first?"
    assert (change.reference.k, change.level.k, change.level.n) == (50, 63, 100)
    assert (change.reference.name, change.level.name) == ("no", "yes")
    assert (change.is_shown, crashes.is_shown) == (True, False)
    assert change.mark.shape == crashes.mark.shape == "plain"
    assert (crashes.level.k, crashes.level.n, crashes.level.text[:4]) == (3, 103, "63.0")
    # Of both drivers, which are drawn.
    assert (
        made.counted
        == "400 finished trials, 12 with a crash; 28 identical to another one are left out"
    )
    (chart,) = made.charts
    assert chart.title == "By factor"
    assert not made.adjusted
    assert [line.name for line in chart.lines] == ["no", "yes"]
    assert [point.shape for point in chart.lines[0].points] == ["dot", "square"]
    places = [tick[0] for tick in chart.ticks]
    for line in chart.lines:
        for point in line.points:
            assert min(places) <= point.ends[0] < point.x < point.ends[1] <= max(places)


@pytest.mark.parametrize(("percent", "shown"), [(0.0, 0), (100.0, 0), (50.0, 1)])
def test_a_share_that_cannot_differ_is_not_shown(percent, shown):
    same = {"estimate": percent, "estimate_reference": percent, "difference": 0.0}
    crashes = effect(measure="coll. (%)", p=1.0)
    crashes = replace(crashes, values=crashes.values | same)
    assert len(answer([effect(), crashes], levels_of("hurry")).others) == shown


def test_the_chart_of_a_driver_has_the_values_and_the_interval_of_the_table():
    rows = [effect(), effect(level="much", difference=42.0, estimate=94.0, estimate_reference=52.0)]
    levels = [*levels_of("hurry"), *levels_of("hurry")[1:]]
    levels[2] = replace(levels[2], id="more", values=levels[2].values | {"level": "much"})
    made = answer(rows, levels)
    assert made.adjusted
    assert made.is_cut
    points = [(point.shape, point.says) for line in made.charts[0].lines for point in line.points]
    assert points == [
        ("dot", "all drivers: 50.00"),
        ("dot", "all drivers: 52.00"),
        ("dot", "all drivers: 63.00 [56.00, 70.00]"),
        ("dot", "all drivers: 94.00 [87.00, 101.00]"),
    ]
    assert not answer([effect()], levels_of("hurry")).is_cut


def test_a_level_has_its_words_and_halves_are_counted():
    levels = levels_of("hurry")
    levels[0] = replace(
        levels[0], values=levels[0].values | {"k": None, "n": 27, "value": 50 / 0.9}
    )
    made = answer([effect()], levels, f"{WORDS}hurry=yes: “Be late: go.”, to both drivers")
    (change,) = made.changes
    assert change.detail == "yes: “Be late: go.”, to both drivers"
    assert (change.reference.k, change.reference.halves, change.reference.n) == (None, "15", 27)


def test_levels_that_are_not_tested_are_not_drawn():
    made = answer(
        [effect(drivers="scripted"), copied("persona")],
        [*levels_of("persona"), *levels_of("hurry"), *levels_of("hurry × persona")],
    )
    (chart,) = made.charts
    assert [line.head for line in chart.lines] == ["hurry", ""]
    assert (
        made.counted
        == "200 finished trials, 6 with a crash; 14 identical to another one (persona=yes "
        "changes nothing) are left out"
    )


def test_an_interaction_names_the_levels_of_both_factors():
    crossed = {"level": "taxi × yes", "reference": "none × no"}
    made = answer([effect(), effect("persona × hurry", 0.4, **crossed)], levels_of("hurry"))
    main, interaction = made.changes
    assert main.detail == "yes"
    assert interaction.detail == "effect of persona=taxi with hurry=yes, less that with hurry=no"
    assert (interaction.reference, interaction.level) == (None, None)


def test_a_copy_of_the_same_driver_is_said_to_be_one():
    opponent = {"level": "idm", "reference": "self"}
    rows = [effect("opponent", **opponent), effect("opponent", measure=COST, **opponent)]
    made = answer(rows, levels_of("hurry"))
    assert "opponent=self (another copy of the same driver)." in made.claim
    assert made.changes[0].reference.name == "self (another copy of the same driver)"


def test_a_small_price_keeps_two_digits():
    cheap = {"estimate": 0.00024, "estimate_reference": 0.0, "ci": (-0.0012, 0.00031)}
    made = answer(
        [effect(measure=COST, difference=-0.0005, **cheap), effect(p=0.2)], levels_of("hurry")
    )
    assert "Hurry changes the cost of a trial: 0.00024 USD with hurry=yes" in unspaced(made.rest)
    assert effect_rows.measured(effect(measure=COST, difference=-0.0005, **cheap)).test == (
        "−0.00050 USD [−0.0012, 0.00031], corrected p = 0.001"
    )


def test_what_a_person_sees_at_once_is_said_of_several_other_changes():
    others = [effect(measure=COST, p=0.0001), effect(measure="coll. (%)", p=0.01)]
    assert "Hurry changes how many trials end in a crash: " in answered([effect(p=0.2), *others])[1]


def test_the_end_of_an_interval_reads_as_0_only_where_it_is():
    assert effect_rows.measured(effect(ci=(0.001, 0.075))).interval == "[0.001, 0.075]"
    assert effect_rows.measured(effect(ci=(-7.0, 0.0))).interval == "[−7.00, 0.00]"
