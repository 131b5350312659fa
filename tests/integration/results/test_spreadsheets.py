"""No text in a file of CSV runs in a spreadsheet, and no number becomes a text."""

from __future__ import annotations

import csv
import io
import json

import pytest
from starlette.testclient import TestClient

from merge_runner.text_safety import csv_writer, in_spreadsheet
from merge_runner_analysis.explorer.app import explorer
from merge_runner_analysis.explorer.site import Site
from tests.support.studies import write_study, yielding

HOST = "127.0.0.1:8700"
FORMULA = "=HYPERLINK(x)"
QUERY = "select '=1+1' as \"=x\", -1.5 as n, -2::DECIMAL(4, 1) as d, '@a' as a, '-' as b, true as c"


@pytest.fixture(scope="module")
def db(tmp_path_factory):
    """A driver whose name is a formula."""
    folder = tmp_path_factory.mktemp("spreadsheets")
    return write_study(folder / "t.duckdb", yielding(FORMULA, reps=1))


def cells(text):
    return list(csv.reader(io.StringIO(text, newline="")))


@pytest.fixture
def client(db):
    return TestClient(explorer(Site(db)), base_url=f"http://{HOST}")


@pytest.mark.parametrize("begins", list("=+-@\t\r\n"))
def test_a_text_that_a_spreadsheet_would_run_gets_an_apostrophe(begins):
    assert in_spreadsheet(f"{begins}1") == f"'{begins}1"
    for same in (f"x{begins}", "", -1, -1.5, None):
        assert in_spreadsheet(same) is same


async def test_sql_keeps_numbers_and_json_as_they_are(merge_runner, db):
    run = await merge_runner("sql", QUERY, "--db", db, "--format", "csv")
    assert [row[:5] for row in cells(run.out)] == [
        ["'=x", "n", "d", "a", "b"],
        ["'=1+1", "-1.5", "-2.0", "'@a", "'-"],
    ]
    run = await merge_runner("sql", QUERY, "--db", db, "--format", "json")
    assert json.loads(run.out)[0]["=x"] == "=1+1"


async def test_a_table_names_a_driver_so_that_it_does_not_run(merge_runner, db):
    run = await merge_runner("tables", "attempts", "--db", db, "--format", "csv")
    rows = [row for row in cells(run.out) if FORMULA in row[0]]
    assert [row[:2] for row in rows] == [[f"'{FORMULA}/baseline", f"'{FORMULA}"]]


def test_the_explorers_downloads_do_not_run_either(client):
    head, *rows = cells(client.get("/trials.csv").text)
    assert len(rows) == 11
    for row in rows:
        told = dict(zip(head, row, strict=True))
        assert told["trial_id"].startswith(f"'{FORMULA}/baseline/")
        assert told["joint"] in {"true", "false", ""}
        assert told["end_time_s"] == str(float(told["end_time_s"]))
    assert cells(client.get("/sql.csv", params={"q": QUERY}).text) == [
        ["'=x", "n", "d", "a", "b", "c"],
        ["'=1+1", "-1.5", "-2.0", "'@a", "'-", "true"],
    ]


async def test_lines_of_csv_end_alike_wherever_they_come_from(merge_runner, db, client):
    async def printed(*command):
        run = await merge_runner(*command, "--db", db, "--format", "csv")
        return run.out

    texts = [
        await printed("sql", QUERY),
        await printed("tables", "attempts"),
        client.get("/trials.csv").text,
        client.get("/sql.csv", params={"q": QUERY}).text,
    ]
    assert [text.count("\r") for text in texts] == [0, 0, 0, 0]
    assert all(text.endswith("\n") for text in texts)


@pytest.mark.parametrize("text", ["a\rb", "a\nb", "a\r\n", "\r\n", 'a"b', "a,b"])
def test_every_text_comes_back_from_csv_as_it_was(text):
    written = io.StringIO(newline="")
    csv_writer(written).writerows([["x", text], ["y", "z"]])
    assert cells(written.getvalue()) == [["x", text], ["y", "z"]]


async def test_two_columns_of_one_name_are_no_json(merge_runner, db):
    run = await merge_runner("sql", "select 1 as a, 2 as a", "--db", db, "--format", "json")
    assert (run.code, run.out) == (2, "")
    assert "two columns are named 'a'" in run.err
