"""A value has the same digits on every page, in the report and in text: the CSV's, rounded."""

import csv
import io
import re
from functools import partial
from html import unescape
from math import floor, isnan, log10

import pytest

from merge_runner_analysis import table as table_of
from merge_runner_analysis.metrics import DECIMALS
from merge_runner_analysis.study import StudyResults
from merge_runner_analysis.table_format import TableFormat
from merge_runner_analysis.tables import TABLES, make_tables
from merge_runner_analysis.tables.formats import names_of, render, shown_columns, shown_rows
from merge_runner_analysis.web.report import report_html
from tests.support.serving import client_of, words_of

NUMBERS = {"number", "percent", "interval", "p"}


@pytest.fixture(scope="module")
def study(golden):
    return StudyResults(golden / "golden.duckdb")


@pytest.fixture(scope="module")
def tables(study):
    return {table.name: table for table in make_tables(study)}


@pytest.fixture(scope="module")
def client(golden, tables):
    return client_of(golden / "golden.duckdb")


@pytest.fixture(scope="module")
def report(study, tables):
    return report_html(study, list(tables.values()), {})


def as_csv(table):
    """The rows of a table's CSV by their ids."""
    rows = csv.DictReader(io.StringIO(render([table], TableFormat.CSV)))
    return {row["row"]: row for row in rows}


def rounded(value, decimals=DECIMALS):
    """A value of the CSV as it is to be printed; there is no minus zero."""
    return re.sub(r"^-(0\.0*)$", r"\1", f"{float(value):.{decimals}f}") if value else "–"


def p_value(p):
    return "<0.001" if float(p) < 0.001 else rounded(p, 3)


def price(value):
    """A price as it is to be printed: with two digits that are not 0."""
    usd = abs(float(value or 0))
    return rounded(value, max(DECIMALS, 1 - floor(log10(usd))) if 0 < usd < 1 else DECIMALS)


def expected(column, name, row):
    """What a cell with a number is to show of a row of the CSV, by the row's name."""
    number = price if name.endswith("/cost_usd") else partial(rounded, decimals=column.digits)
    if column.kind == "interval":
        ends = [row[f"{column.name}_low"], row[f"{column.name}_high"]]
        return f"[{', '.join(map(number, ends))}]" if all(ends) else "–"
    if column.kind == "p" and row[column.name]:
        return p_value(row[column.name])
    return number(row[column.name])


def plain(html):
    """The words of a piece of a page, with a minus sign that Python reads."""
    return words_of(html).replace("−", "-")


def rows_of(html, before=""):
    """The texts of the cells of each row of a table by the row's id, without the word "of"."""
    return {
        unescape(name): [plain(cell) for cell in re.findall(r"<t[dh].*?</t[dh]>", row, re.DOTALL)]
        for name, row in re.findall(rf'<tr id="{before}([^"]+)">(.*?)</tr>', html, re.DOTALL)
    }


@pytest.mark.parametrize("name", TABLES)
def test_a_tables_numbers_are_those_of_its_csv_in_text_on_its_page_and_in_the_report(
    name, study, tables, client, report
):
    table, shown = tables[name], shown_columns(tables[name])
    values = as_csv(table)
    frame = table_of(study, name)
    assert list(values) == [row.id for row in table.rows] == list(frame.index)
    page = rows_of(client.get(f"/tables/{name}").text)
    of_report = rows_of(report, f"{name}/")
    rows = [row.id for row in shown_rows(table)]
    lines = render([table], TableFormat.TEXT).splitlines()[3 : 3 + len(rows)]
    for line, row in zip(lines, rows, strict=True):
        cells = values[row]
        numbers = {c.name: expected(c, row, cells) for c in shown if c.kind in NUMBERS}
        in_line = " ".join(line.split())
        for place, column in enumerate(shown):
            if column.name in numbers:
                assert page[row][place] == numbers[column.name], (row, column.name)
        for text in numbers.values():
            # The report has the paper's values and differences between them.
            assert text in of_report[row], (row, text)
            assert text in in_line
            in_line = in_line[in_line.index(text) + len(text) :]
    for row, cells in values.items():
        for column in names_of(table)[1:]:
            value = frame.loc[row, column]
            if isinstance(value, float):
                assert isnan(value) if cells[column] == "" else float(cells[column]) == value
