"""Verdicts as marks on an axis."""

import pytest

from merge_runner_analysis.tables.model import Row, Table
from merge_runner_analysis.web.effect_rows import ends_text
from merge_runner_analysis.web.marks import cells, measures_of
from merge_runner_analysis.web.pages.prompts import differences


@pytest.mark.parametrize(
    ("crashed", "places"), [((2.5, 30.0), [8.33, 100.0]), ((84.0, 36.0), [84.0, 36.0])]
)
def test_shares_of_crashes_that_differ_have_places_that_differ(crashed, places):
    rows = [Row(str(of), (), {"measure": "collisions", "estimate": of, "n": 99}) for of in crashed]
    measures = measures_of(rows)
    verdicts = [{"collisions": {**row.values, "note": ""}} for row in rows]
    marks = [cells(of, measures)["collisions"].mark for of in verdicts]
    assert [mark.at for mark in marks] == places
    assert not any(mark.arrow for mark in marks)


@pytest.mark.parametrize(
    ("ends", "text"),
    [((-0.306, 0.003), "[−0.306, 0.003]"), ((-0.31, 0.0), "[−0.31, 0.00]"), (None, "")],
)
def test_an_end_beside_0_shows_its_side(ends, text):
    assert ends_text(ends) == text


@pytest.mark.parametrize("p", [0.04, 0.05, None])
def test_what_a_prompt_changes_has_the_same_mark_whatever_its_p(p):
    values = {"driver": "o3", "reference": "baseline", "difference": 1.0, "ci": (0.5, 1.5)}
    row = Row("o3/A1/baseline/gap_m", ("o3/A1",), {**values, "p_holm": p})
    drivers, _ = differences(Table("contrasts", (), [row]), {"o3"})
    mark = drivers["o3"]["A1 against baseline"]["gap_m"]["mark"]
    assert (mark.shape, mark.at, mark.ends) == ("plain", 82.0, (66.0, 98.0))
