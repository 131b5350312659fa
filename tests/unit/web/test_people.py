"""What the first page says of drivers beside people, with the notes on their numbers."""

import pytest

from merge_runner_analysis.web.judged import Driver, noted
from merge_runner_analysis.web.marks import Cell
from merge_runner_analysis.web.people import could_see
from merge_runner_analysis.wording import OPEN, PROGRAM


def driver(name, **verdicts):
    cells = {of: Cell(None, values, None, "", "", "", "") for of, values in verdicts.items()}
    return Driver(name, "baseline", PROGRAM, cells, "", None, "", "")


def least(**by_measure):
    """Verdicts with these detectable differences; without one, too few trials for a verdict."""
    return {
        name: {"detectable": size, "state": OPEN, "n": 110 if size else 11, "ended": 110}
        for name, size in by_measure.items()
    }


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
        (
            [least(collisions=12.0, gap=3.0), least(gap=2.0)],
            "12.00\xa0points in crashes, 2.00 (b) to 3.00 (a) m in the gap",
        ),
        (
            [{"collisions": {"undecided": 4}, **least(gap=3.0)}],
            "3.00\xa0m in the gap; in crashes unknown, as another crash rule ended some trials",
        ),
        ([{"collisions": {"undecided": 4}}], ""),
        ([{"gap": least(gap=3.0)["gap"] | {"n": 19, "ended": 19}}], ""),
    ],
)
def test_the_least_and_the_largest_detectable_differences_name_their_drivers(drivers, text):
    named = [driver(name, **of) for name, of in zip("abcd", drivers, strict=False)]
    assert could_see(named, {name: name for name in "abcd"}) == text


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
