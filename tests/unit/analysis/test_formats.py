"""Tables as texts: what a reader sees of rows and values."""

import pytest

from merge_runner_analysis.table_format import TableFormat
from merge_runner_analysis.tables.formats import render, table_view
from merge_runner_analysis.tables.model import Column, Optional, Row, Table

COLUMNS = (Column("factor", "factor"), Optional("difference", "difference", "number"))
WHY = "not tested: the same trials"
ROWS = [
    Row("hurry=yes/cost_usd", ("a",), {"factor": "hurry", "difference": 0.00012}),
    Row("hurry=yes/gap_m", ("a",), {"factor": "hurry", "difference": -0.004}),
    *(
        Row(f"persona=taxi/{name}", ("a", "b"), {"factor": "persona"}, WHY, untested=True)
        for name in ("gap_m", "cost_usd")
    ),
]
TABLE = Table("effects", COLUMNS, ROWS)


@pytest.mark.parametrize("form", [TableFormat.TEXT, TableFormat.MD, TableFormat.LATEX])
def test_a_level_that_is_not_tested_is_one_line_that_says_why(form):
    text = render([TABLE], form)
    assert text.count("persona") == text.count(f"persona=taxi: {WHY}") == 1
    assert text.count("–") == 0


def test_values_and_pages_of_a_level_that_is_not_tested():
    assert render([TABLE], TableFormat.CSV).count("persona") == 4  # its row ids and factor
    view = table_view(TABLE, lambda *_: None)
    assert [row["id"] for row in view["rows"]] == [row.id for row in ROWS[:2]]
    assert view["notes"] == [f"persona=taxi: {WHY}"]


def test_a_table_without_any_test_has_its_notes_alone():
    text = render([Table("effects", COLUMNS, ROWS[2:], title="Effects")], TableFormat.TEXT)
    assert text.splitlines() == ["Effects", f"  persona=taxi: {WHY}"]


def test_a_price_has_two_digits_and_other_values_two_decimals():
    text = render([TABLE], TableFormat.TEXT)
    assert "0.00012" in text
    assert " 0.00\n" in text


def test_a_verdict_is_said_in_the_words_of_the_pages():
    verdict = Table(
        "verdicts",
        (Optional("state", "verdict"),),
        [Row("a/headway", ("a",), {"measure": "headway", "state": "weaker", "n": 40})],
    )
    assert "weaker than people's" in render([verdict], TableFormat.TEXT)
    assert "weaker" in render([verdict], TableFormat.CSV)
