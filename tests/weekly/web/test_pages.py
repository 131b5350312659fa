"""Every page fits its window and keeps nobody out who reads with other eyes."""

import shutil
import subprocess

import pytest
from playwright.sync_api import expect

from merge_runner.results.store import Store
from merge_runner_analysis.study import StudyResults
from merge_runner_analysis.tables import make_tables
from merge_runner_analysis.web.report import report_html
from tests.support.harness import PROGRAM, environment
from tests.support.serving import in_a_thread, served
from tests.support.studies import played, yielding
from tests.support.web_fixtures import serious

LONG = ("meta-llama/Llama-3.3-70B-Instruct-Turbo", "instruct at localhost:8123+idm/set1")
HIGHEST_PX = 15_000  # a report, in a window of 1440
COMPUTED_MS = 600_000  # on a busy machine
PAPER_PX = round(190 * 96 / 25.4)  # A4 within its margins
# A number, a share, a p-value, an interval or a date, of which no part may stand in a line below.
BROKEN = r"""() => [...document.querySelectorAll("td")].filter((cell) => {
  if (!/^[-−+<\[\]\d., :]*\d[-−\d., :\]%]*$/.test(cell.textContent.trim())) return false;
  const range = document.createRange();
  range.selectNodeContents(cell.querySelector("a") ?? cell);
  const lines = [...range.getClientRects()].filter((box) => box.width > 0);
  return new Set(lines.map((box) => Math.round(box.bottom))).size > 1;
}).map((cell) => cell.textContent)"""
PAGES = (
    "/",
    "/drivers",
    "/drivers/quantal?variant=baseline",
    "/trials",
    "/trials?cell=attempts/emulator%2Fbaseline:calls",
    "/words?q=merge",
    "/prompts",
    "/discordant?model=cheap&variant=taxi",
    "/conditions/N_0_0",
    "/sweeps",
    "/tables",
    "/tables/indicators",
    "/figures/first-action",
    "/glossary",
    "/notes",
    "/sql?q=select+1",
    "/trials/emulator/baseline/N_0_0/rep01?side=left&decision=2"
    "&compare=emulator/baseline/N_0_0/rep02",
)
DRAWN_ANEW = "new Promise(then => requestAnimationFrame(() => requestAnimationFrame(then)))"
OVER = "document.documentElement.scrollWidth - innerWidth"
# Elements that scroll by themselves; a wide table may do so sideways.
WITHIN = """() => [...document.querySelectorAll("main *")].filter((one) => {
  const { overflowX, overflowY } = getComputedStyle(one);
  const scrolls = (overflow) => ["auto", "scroll"].includes(overflow);
  const down = scrolls(overflowY) && one.scrollHeight > one.clientHeight + 1;
  const across = scrolls(overflowX) && one.scrollWidth > one.clientWidth + 1;
  return down || (across && !one.matches(".wide"));
}).map((one) => one.outerHTML.slice(0, 80))"""


@pytest.fixture(scope="module")
def db(golden, tmp_path_factory):
    """Every kind of trial, and drivers with long names."""
    path = shutil.copy(golden / "golden.duckdb", tmp_path_factory.mktemp("pages") / "t.duckdb")
    drives = [drive for name in LONG for drive in yielding(name, reps=1)]
    Store(path).write("long", [played(drive) for drive in drives], patience_s=5)
    return path


@pytest.fixture(scope="module")
def site(db):
    with served(db) as address:
        yield address


def opened(page, address):
    page.goto(address)
    page.wait_for_load_state("networkidle")
    expect(page.locator(".computing")).to_have_count(0, timeout=COMPUTED_MS)


def test_every_page_fits_its_window_and_axe_finds_nothing_serious(page):
    found = []
    for address in PAGES:
        opened(page, address)
        for width in (1440, 1100, 1024, 800, 420):
            scheme = "dark" if width == 420 else "light"
            page.emulate_media(color_scheme=scheme)
            page.set_viewport_size({"width": width, "height": 900})
            page.evaluate(DRAWN_ANEW)
            wrong = [over for over in [page.evaluate(OVER)] if over > 0] + page.evaluate(WITHIN)
            wrong += serious(page) if width in {1024, 420} else []
            found += [(address, scheme, width, one) for one in wrong]
    assert found == []


def test_verdicts_stand_on_paper_and_in_a_small_window_without_a_broken_interval(page):
    opened(page, "/drivers")
    page.emulate_media(media="print")
    page.set_viewport_size({"width": PAPER_PX, "height": 1000})
    assert page.evaluate(OVER) <= 0
    lines = page.locator(".m span:not(.vh)").evaluate_all(
        "all => all.map(e => e.getClientRects().length)"
    )
    assert max(lines) == 1
    page.emulate_media(media="screen")
    page.set_viewport_size({"width": 1024, "height": 1000})
    opened(page, "/tables/verdicts")
    last = page.get_by_role("columnheader", name="verdict", exact=True).bounding_box()
    assert last["x"] + last["width"] <= 1024


def test_the_report_of_the_tutorials_study_is_at_most_so_high(page, tmp_path):
    kept = ("--db", tmp_path / "t.duckdb")
    played = ("sweep", "baseline", *kept, "--cache", tmp_path / "cache", "--quiet")
    for typed in (played, ("report", *kept, "--out", tmp_path / "report.html")):
        subprocess.run([PROGRAM, *typed], cwd=tmp_path, env=environment(), check=True)
    page.set_viewport_size({"width": 1440, "height": 900})
    page.goto((tmp_path / "report.html").as_uri())
    assert page.evaluate("document.documentElement.scrollHeight") <= HIGHEST_PX
    assert page.locator("#crashes").is_visible()


def test_a_report_breaks_no_number_and_cuts_no_table_on_a_screen_and_on_paper(page, db, tmp_path):
    study = in_a_thread(StudyResults, db)
    html = in_a_thread(lambda: report_html(study, make_tables(study), {}))
    (tmp_path / "report.html").write_text(html)
    page.goto((tmp_path / "report.html").as_uri())
    page.evaluate("document.querySelectorAll('.folded').forEach((one) => { one.open = true; })")
    last = page.locator("#verdicts thead th").last
    assert last.text_content() == "verdict"
    for media, width in (("screen", 1440), ("print", PAPER_PX)):
        page.emulate_media(media=media)
        page.set_viewport_size({"width": width, "height": 1000})
        assert page.evaluate(BROKEN) == []
        box = last.bounding_box()
        assert box["x"] + box["width"] <= width
        assert media == "screen" or page.evaluate(OVER) <= 0
    page.goto("/glossary")
