"""What the first page says of drivers beside people, with the notes on their numbers."""

import pytest

from merge_runner_analysis.web.judged import Driver, noted
from merge_runner_analysis.web.marks import Cell
from merge_runner_analysis.web.people import could_see, verdict_rules
from merge_runner_analysis.wording import PROGRAM


def driver(name, **verdicts):
    cells = {of: Cell(None, values, None, "", "", "", "") for of, values in verdicts.items()}
    return Driver(name, "baseline", PROGRAM, cells, "", None, "", "")


def least(**by_measure):
    return {name: {"detectable": size} for name, size in by_measure.items()}


@pytest.mark.parametrize(
    ("drivers", "text"),
    [
        ([{}], ""),
        ([least(collisions=None)], ""),
        ([least(collisions=12.0)], "12.00\xa0points in crashes"),
        (
            [least(collisions=12.0), least(collisions=7.5), least(collisions=9.0), {}],
            "7.50 (b) to 12.00 (a) points in crashes",
        ),
        ([least(collisions=6.221), least(collisions=6.219)], "6.22\xa0points in crashes"),
        (
            [least(collisions=12.0, gap=3.0), least(gap=2.0)],
            "12.00\xa0points in crashes, 2.00 (b) to 3.00 (a) m in the gap",
        ),
        (
            [{"collisions": {"undecided": 4}, **least(gap=3.0)}],
            "3.00\xa0m in the gap; in crashes unknown, as another crash rule ended some trials",
        ),
        ([{"collisions": {"undecided": 4}}], ""),
    ],
)
def test_the_least_and_the_largest_detectable_differences_name_their_drivers(drivers, text):
    named = [driver(name, **of) for name, of in zip("abcd", drivers, strict=False)]
    assert could_see(named, {name: name for name in "abcd"}) == text


@pytest.mark.parametrize(
    ("drivers", "text"),
    [
        ([], "a driver's tests"),
        ([{}], "a driver's tests"),
        ([{"gap": {"p_holm": 0.3}}], "a driver's 1 tests"),
        ([{"gap": {"p_holm": 0.3}}, {}], "a driver's 0 to 1 tests"),
    ],
)
def test_the_rule_of_a_verdict_has_the_number_of_tests_where_it_is_known(drivers, text):
    named = [driver(name, **of) for name, of in zip("ab", drivers, strict=False)]
    assert text in verdict_rules(named, {})[2]


def test_drivers_with_the_same_note_on_a_measure_share_it():
    few, other = {"note": "few trials"}, {"note": "other rule"}
    drivers = [
        driver("a", collisions=few, gap=few),
        driver("b", collisions=few, gap={}),
        driver("c", collisions=other),
        driver("d"),
    ]
    crashes = [(["a", "b"], "crashes", "Few trials"), (["c"], "crashes", "Other rule")]
    assert noted(drivers, {"collisions": "crashes"}) == crashes
    gap = [(["a"], "gap", "Few trials")]
    assert sorted(noted(drivers, {"collisions": "crashes", "gap": "gap"})) == sorted(crashes + gap)
    assert noted(drivers, {"gap": "gap"}, {"gap": "not posed"}) == [
        (["a", "b", "c", "d"], "gap", "Not posed")
    ]
