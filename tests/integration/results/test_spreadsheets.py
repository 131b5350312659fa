"""No text in a file of CSV runs in a spreadsheet, and no number becomes a text."""

import csv
import io
import json

import pytest

from merge_runner.text_safety import csv_writer, in_spreadsheet
from tests.support.serving import client_of
from tests.support.studies import write_study, yielding

FORMULA = "=HYPERLINK(x)"
QUERY = "select '=1+1' as \"=x\", -1.5 as n, -2::DECIMAL(4, 1) as d, '@a' as a, '-' as b, true as c"
RESULT = [["'=x", "n", "d", "a", "b", "c"], ["'=1+1", "-1.5", "-2.0", "'@a", "'-", "true"]]


@pytest.fixture(scope="module")
def db(tmp_path_factory):
    """A driver whose name is a formula."""
    folder = tmp_path_factory.mktemp("spreadsheets")
    return write_study(folder / "t.duckdb", yielding(FORMULA, reps=1))


def cells(text):
    return list(csv.reader(io.StringIO(text, newline="")))


@pytest.mark.parametrize("begins", list("=+-@\t\r\n"))
def test_a_text_that_a_spreadsheet_would_run_gets_an_apostrophe(begins):
    assert in_spreadsheet(f"{begins}1") == f"'{begins}1"
    for same in (f"x{begins}", "", -1, -1.5, None):
        assert in_spreadsheet(same) is same


async def test_sql_and_tables_run_in_no_spreadsheet_and_json_is_as_it_is(merge_runner, db):
    async def printed(*command, form="csv"):
        run = await merge_runner(*command, "--db", db, "--format", form)
        assert form == "json" or ("\r" not in run.out and run.out.endswith("\n"))
        return run.out or run.err

    found = cells(await printed("sql", QUERY))
    assert [row[:5] for row in found] == [row[:5] for row in RESULT]
    assert json.loads(await printed("sql", QUERY, form="json"))[0]["=x"] == "=1+1"
    rows = cells(await printed("tables", "attempts"))
    found = [row[:2] for row in rows if FORMULA in row[0]]
    assert found == [[f"'{FORMULA}/baseline", f"'{FORMULA}"]]
    twice = await printed("sql", "select 1 as a, 2 as a", form="json")
    assert "two columns are named 'a'" in twice


def test_the_explorers_downloads_do_not_run_either(db):
    client = client_of(db)
    trials, found = client.get("/trials.csv").text, client.get("/sql.csv", params={"q": QUERY}).text
    head, *rows = cells(trials)
    assert len(rows) == 11
    for row in rows:
        told = dict(zip(head, row, strict=True))
        assert told["trial_id"].startswith(f"'{FORMULA}/baseline/")
        assert told["joint"] in {"true", "false", ""}
        assert told["end_time_s"] == str(float(told["end_time_s"]))
    assert cells(found) == RESULT
    assert ("\r" in trials + found, found.endswith("\n")) == (False, True)


@pytest.mark.parametrize("text", ["a\rb", "a\nb", "a\r\n", "\r\n", 'a"b', "a,b"])
def test_every_text_comes_back_from_csv_as_it_was(text):
    written = io.StringIO(newline="")
    csv_writer(written).writerows([["x", text], ["y", "z"]])
    assert cells(written.getvalue()) == [["x", text], ["y", "z"]]
