"""The report in a browser, on a screen and on paper."""

from __future__ import annotations

import pytest

from merge_runner_analysis.data.study import Study
from merge_runner_analysis.report.page import report_html
from merge_runner_analysis.tables import make_tables
from tests.support.studies import Drive, write_study, yielding

A4_MM, MARGIN_MM = 210, 10
PX_PER_MM = 96 / 25.4
# A number, a share, a p-value, an interval or a date, of which no part may stand in a line below.
BROKEN = r"""() => [...document.querySelectorAll("td")].filter((cell) => {
  if (!/^[-+<\[\]\d., :]*\d[-\d., :\]%]*$/.test(cell.textContent.trim())) return false;
  const range = document.createRange();
  range.selectNodeContents(cell);
  const lines = [...range.getClientRects()].filter((box) => box.width > 0);
  return new Set(lines.map((box) => Math.round(box.bottom))).size > 1;
}).map((cell) => cell.textContent)"""
CUT_OFF = """() => [...document.querySelectorAll("table")]
  .filter((table) => table.getBoundingClientRect().right > document.documentElement.clientWidth)
  .map((table) => table.querySelector("th").textContent)"""

LINES = """(cells) => cells.map((cell) => {
  const range = document.createRange();
  range.selectNodeContents(cell);
  return new Set([...range.getClientRects()].map((box) => Math.round(box.bottom))).size;
})"""
# The longest that stands in cells of the first table.
LONGEST = r"""() => {
  for (const cell of document.querySelectorAll("#verdicts + .wide td")) {
    if (/^\[.*\]$/.test(cell.textContent.trim())) cell.textContent = "[-24.12, 100.00]";
    if (!cell.nextElementSibling) cell.textContent = "inconclusive";
  }
}"""


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """A report of one driver under two prompts, with all columns, and of one with a long name."""
    folder = tmp_path_factory.mktemp("report")
    drives = [
        *yielding("o3", reps=4),
        *yielding("o3", "A1", reps=2),
        *yielding("smollm2-instruct at localhost:8123", reps=2),
        # Of its collision nobody knows whether it is one by the humans' rule.
        Drive("o3", "baseline", "N_0_0", 9, (0.0,), (0.0,)),
    ]
    study = Study(write_study(folder / "t.duckdb", drives))
    file = folder / "report.html"
    file.write_text(report_html(study, make_tables(study), {}), encoding="utf-8")
    return file


@pytest.mark.parametrize(
    ("media", "width"), [("screen", 1440), ("print", round((A4_MM - 2 * MARGIN_MM) * PX_PER_MM))]
)
def test_no_number_of_the_report_is_broken(page, report, media, width):
    page.emulate_media(media=media)
    page.set_viewport_size({"width": width, "height": 1000})
    page.goto(report.as_uri())
    assert page.locator("#verdicts + .wide td").count() > 100
    assert page.evaluate(BROKEN) == []


def test_every_table_of_the_report_fits_on_paper(page, report):
    page.emulate_media(media="print")
    page.set_viewport_size({"width": round((A4_MM - 2 * MARGIN_MM) * PX_PER_MM), "height": 1000})
    page.goto(report.as_uri())
    assert page.evaluate(CUT_OFF) == []


def test_the_first_table_of_the_report_shows_its_verdicts_without_scrolling(page, report):
    page.set_viewport_size({"width": 1440, "height": 1000})
    page.goto(report.as_uri())
    heads = page.locator("#verdicts + .wide th")
    assert heads.last.text_content() == "verdict"
    assert "undecided" in heads.all_text_contents()
    page.evaluate(LONGEST)
    last = heads.last.bounding_box()
    assert last["x"] + last["width"] <= page.evaluate("document.documentElement.clientWidth - 18")


def test_no_name_of_a_row_of_the_design_is_broken_on_paper(page, report):
    page.emulate_media(media="print")
    page.set_viewport_size({"width": round((A4_MM - 2 * MARGIN_MM) * PX_PER_MM), "height": 1000})
    page.goto(report.as_uri())
    names = page.locator("#design + table th")
    many = "projected-order, human-odds, " * 6
    page.locator("#design + table td").first.evaluate(
        "(cell, text) => cell.textContent = text", many
    )
    assert "conditions" in names.all_text_contents()
    assert names.evaluate_all(LINES) == [1] * names.count()
