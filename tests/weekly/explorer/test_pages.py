"""Every page of a study as large as a real one keeps nobody out who reads with other eyes."""

from __future__ import annotations

import re

import pytest
from playwright.sync_api import expect

from merge_runner.results.store import query
from tests.support import rich_study
from tests.support.axe import serious
from tests.support.serving import served

COMPUTED_MS = 600_000  # on a busy machine
PAGES = (
    "/",
    "/drivers",
    "/drivers/quantal?variant=baseline",
    "/trials",
    "/trials?cell=attempts/emulator%2Fbaseline:calls",
    "/words?q=merge",
    "/prompts",
    "/discordant?model=emulator&variant=A1",
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
ASKED_OF_O3 = """
SELECT count(call_key), count(*) FILTER (NOT valid)
FROM decisions JOIN trials USING (trial_id, spec_hash) WHERE model_left = 'o3'
"""


@pytest.fixture(scope="module")
def db(tmp_path_factory):
    return rich_study.make(tmp_path_factory.mktemp("rich"))


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
        for scheme, width in (("light", 1024), ("dark", 420)):
            page.emulate_media(color_scheme=scheme)
            page.set_viewport_size({"width": width, "height": 900})
            page.evaluate(DRAWN_ANEW)
            wrong = [over for over in [page.evaluate(OVER)] if over > 0] + serious(page)
            found += [(address, scheme, width, one) for one in wrong]
    assert found == []


def test_the_first_page_says_who_drives_like_humans_and_who_can_be_trusted(page, db):
    opened(page, "/")
    expect(page.locator(".answer")).to_contain_text("too few to say whether it drives like humans")

    def row(driver):
        head = page.get_by_role("rowheader").filter(has_text=re.compile(rf"^\s*{driver}\b"))
        return page.get_by_role("row").filter(has=head).first

    expect(row("smollm2")).to_contain_text("does not yield as humans do")
    _, [(asked, invalid)] = query(db, ASKED_OF_O3)
    expect(row("o3 at 127")).to_contain_text(f"of {asked:,}")
    expect(row("o3 at 127")).to_contain_text(f"{100 * (1 - invalid / asked):.1f} %")
