"""Verdicts as marks on an axis."""

import pytest

from merge_runner_analysis.tables.model import Row
from merge_runner_analysis.web.marks import cells, measures_of


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
