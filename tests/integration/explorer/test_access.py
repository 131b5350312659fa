"""Nothing on the pages keeps anybody out who reads with other eyes, at night or on a phone."""

from __future__ import annotations

import pytest
from playwright.sync_api import expect

from tests.integration.explorer.test_exported import exported
from tests.support.axe import serious

__all__ = ["exported"]

PAGES = (
    "/sweeps",
    "/",
    "/conditions/N_0_0",
    "/drivers",
    "/drivers/emulator?variant=baseline",
    "/glossary",
    "/tables",
    "/tables/attempts",
    "/tables/indicators",
    "/prompts",
    "/figures/first-action",
    "/discordant?model=emulator&variant=A1",
    "/trials/o4/baseline/L_4_0/rep01?side=left&decision=2",
    "/trials/human/baseline/N_0_0/rep01",
    "/words?q=script",
    "/notes",
    "/sql?q=select+1",
    "/trials",
    "/trials?cell=attempts/emulator%2Fbaseline:calls",
    "/trials/emulator/baseline/N_0_0/rep01?side=left&decision=2"
    "&compare=emulator/baseline/N_0_0/rep02",
)
# The scheme of the colours and the width of the window, in pixels.
LOOKS = (("light", 1024), ("dark", 420))
DRAWN_ANEW = "new Promise(then => requestAnimationFrame(() => requestAnimationFrame(then)))"
OVER = "document.documentElement.scrollWidth - innerWidth"


def findings(page):
    """What is wrong with a page in each look; where it is too wide, by how many pixels."""
    found = []
    for scheme, width in LOOKS:
        page.emulate_media(color_scheme=scheme)
        page.set_viewport_size({"width": width, "height": 900})
        page.evaluate(DRAWN_ANEW)
        found += [(scheme, width, over) for over in [page.evaluate(OVER)] if over > 0]
        found += [(scheme, width, *finding) for finding in serious(page)]
    return found


@pytest.mark.long
@pytest.mark.parametrize("address", PAGES)
def test_a_page_fits_its_window_and_axe_finds_nothing_serious(page, address):
    page.goto(address)
    page.wait_for_load_state("networkidle")
    expect(page.locator(".computing")).to_have_count(0)
    assert findings(page) == []


@pytest.mark.long
def test_exported_pages_fit_and_axe_finds_nothing_serious(page, exported):
    one = ("index", "trials", "trials-emulator-baseline-N_0_0-rep01", "notes",
           "sweeps", "tables", "tables-attempts", "prompts", "glossary")  # fmt: skip
    for path in sorted(exported.rglob("*.html")):
        if path.stem not in one:
            continue
        page.goto(f"file://{path}")
        if "rep01" in path.name:
            expect(page.locator("#charts .chart")).to_have_count(3)
        assert (path.name, findings(page)) == (path.name, [])


def test_the_dialog_of_a_page_has_the_keys_and_leads_to_all_words(page):
    page.goto("/trials")
    page.get_by_role("button", name="?").click()
    expect(page.locator("#help")).to_contain_text("play and pause")
    for scheme, _ in LOOKS:
        page.emulate_media(color_scheme=scheme)
        assert serious(page) == []
    page.get_by_role("link", name="What words mean").click()
    expect(page.locator("#main dt", has_text="tunnel")).to_be_visible()


@pytest.mark.long
def test_a_theme_is_chosen_and_kept(page):
    page.emulate_media(color_scheme="light")
    page.goto("/glossary")
    paper = "getComputedStyle(document.body).backgroundColor"
    light = page.evaluate(paper)
    page.locator("#theme").select_option("dark")
    dark = page.evaluate(paper)
    assert dark != light
    page.goto("/notes")
    assert page.evaluate(paper) == dark
    page.locator("#theme").select_option("")
    assert page.evaluate(paper) == light
