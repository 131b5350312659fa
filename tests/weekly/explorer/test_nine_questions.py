"""Nine questions of a newcomer, each answered by the pages within three clicks from the first."""

from __future__ import annotations

import re

import httpx
import pytest
from playwright.sync_api import expect

from merge_runner.results.store import query
from tests.support import rich_study
from tests.support.serving import served

MOST_CLICKS = 3
COMPUTED_S = 600  # on a busy machine
# Decisions in which a driver says that it yields, and plans to speed up in the mean.
SAYS_YIELD = """
SELECT count(*) FROM decisions JOIN trials USING (trial_id, spec_hash)
WHERE tactical = 'Y' AND list_avg(plan::DOUBLE[]) > 0.08
"""
ASKED_OF_O3 = """
SELECT count(call_key), count(*) FILTER (NOT valid)
FROM decisions JOIN trials USING (trial_id, spec_hash) WHERE model_left = 'o3'
"""

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def db(tmp_path_factory):
    return rich_study.make(tmp_path_factory.mktemp("rich"))


@pytest.fixture(scope="module")
def site(db):
    with served(db) as address:
        yield address


class Reader:
    """Somebody at the first page, whose clicks are counted."""

    def __init__(self, page):
        self.page = page
        self.clicks = 0
        page.set_default_timeout(1000 * COMPUTED_S)
        page.goto("/")
        expect(page.locator(".answer")).to_be_visible(timeout=1000 * COMPUTED_S)

    def click(self, target):
        self.clicks += 1
        assert self.clicks <= MOST_CLICKS
        target.click()
        self.computed()

    def choose(self, name, value):
        """Choosing in a list is a click, too."""
        self.clicks += 1
        assert self.clicks <= MOST_CLICKS
        self.page.locator(f"select[name={name}]").select_option(value)
        self.computed()

    def place(self, name):
        self.click(self.page.get_by_role("navigation").get_by_role("link", name=name).first)

    def computed(self):
        expect(self.page.locator(".computing")).to_have_count(0, timeout=1000 * COMPUTED_S)

    def row(self, driver):
        """The row of a driver in the first table of a page."""
        head = self.page.get_by_role("rowheader").filter(has_text=re.compile(rf"^\s*{driver}\b"))
        return self.page.get_by_role("row").filter(has=head).first


@pytest.fixture
def reader(page):
    return Reader(page)


def test_does_it_drive_like_humans(reader):
    expect(reader.page.locator(".answer")).to_contain_text(
        "too few to say whether it drives like humans"
    )
    row = reader.row("smollm2")
    expect(row).to_contain_text("does not yield as humans do")
    expect(row).to_contain_text("unlike humans")


def test_which_indicator_fails_and_in_which_trials(reader):
    reader.click(reader.row("quantal").get_by_role("link", name="unlike humans").first)
    verdict = reader.page.get_by_role("row", name=re.compile("unlike humans")).first
    expect(verdict).to_contain_text("The faster one yields")
    behind = verdict.get_by_role("link", name=re.compile(r"^\d+$")).last
    trials = int(behind.inner_text())
    reader.click(behind)
    expect(reader.page.locator(".totals")).to_contain_text(f"{trials} trials")


def test_why_it_collided_what_was_said_and_whether_it_was_avoidable(reader):
    reader.click(reader.row("emulator").get_by_role("link", name=re.compile("to 3|0 to")).first)
    verdict = reader.page.get_by_role("row", name=re.compile("^Collisions by the humans' rule"))
    reader.click(verdict.get_by_role("link").first)
    reader.click(reader.page.locator("th a", has_text="/N_0_0/rep").first)
    account = reader.page.locator("details, section", has_text="Why it collided").last
    expect(account).to_be_visible()
    expect(account).to_contain_text("could still have avoided it")
    expect(reader.page.locator("#panel blockquote").first).to_be_visible()


def test_whether_the_prompt_changes_who_goes_first(reader):
    reader.place("Prompts")
    slopes = reader.page.get_by_role("table").filter(has_text="Who goes first").first
    for prompt in ("baseline", "A1", "A7"):
        row = slopes.get_by_role("row").filter(has_text=re.compile(rf"^\s*{prompt}\b"))
        expect(row.first).to_contain_text(re.compile(r"\[.*\]"))


def test_who_says_yield_and_speeds_up(reader, db):
    reader.place("Words")
    reader.choose("tactical", "Y")
    reader.choose("planned", "go")
    _, [(decisions,)] = query(db, SAYS_YIELD)
    assert decisions > 0
    expect(reader.page.locator("#totals")).to_contain_text(f"{decisions:,} decisions")
    expect(reader.page.locator("td.words").first).to_be_visible()


def test_what_the_prompts_say(reader):
    reader.place("Prompts")
    hurry = reader.page.get_by_role("region", name="hurry")
    expect(hurry.locator("ins")).to_contain_text("late for an appointment")
    expect(reader.page.get_by_role("region", name="A3").locator("del")).to_contain_text(
        "Avoid a collision"
    )


def test_whether_it_can_be_trusted(reader, db):
    _, [(asked, invalid)] = query(db, ASKED_OF_O3)
    row = reader.row("o3 at 127")
    expect(row).to_contain_text(f"of {asked:,}")
    expect(row).to_contain_text(f"{100 * (1 - invalid / asked):.1f} %")
    reader.place("Runs")
    expect(reader.row("o3 at 127").or_(reader.row("baseline"))).to_be_visible()


def test_a_figure_is_taken_along_and_cited(reader):
    reader.click(reader.page.get_by_role("link", name="Tables and figures", exact=True).first)
    reader.click(reader.page.locator("a[href='/figures/first-action']"))
    expect(reader.page.locator("figure img")).to_be_visible()
    expect(reader.page.get_by_role("main")).to_contain_text("arXiv:2604.09609")
    for form in ("SVG", "PNG", "CSV"):
        link = reader.page.get_by_role("link", name=form, exact=True).first
        address = link.get_attribute("href")
        reply = httpx.get(f"{reader.page.url.partition('/figures')[0]}{address}", timeout=600)
        assert reply.status_code == 200, form
    with reader.page.expect_download() as download:
        reader.click(reader.page.get_by_role("link", name="SVG", exact=True).first)
    assert download.value.path().read_text().rstrip().endswith("</svg>")


def test_it_stands_beside_the_models_of_merging(reader):
    for driver in ("cei", "idm"):
        expect(reader.row(driver)).to_contain_text("humans")
    reader.click(reader.row("o3 at 127").get_by_role("rowheader").get_by_role("link"))
    reader.choose("with", "cei")
    reader.click(reader.page.get_by_role("button", name="Apply"))
    expect(reader.page.get_by_role("columnheader", name="cei", exact=True)).to_be_visible()
