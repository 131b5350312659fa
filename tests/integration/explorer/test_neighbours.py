"""A trial leads to the next one of the list that led to it, and the list keeps its place."""

from __future__ import annotations

import pytest
from playwright.sync_api import expect

LIST = "/trials?q=emulator&sort=-end"


def opened(page, name):
    """Wait until a trial is shown, with its neighbours."""
    expect(page.locator("h1")).to_have_text(name)
    expect(page.locator("#next-trial")).to_be_visible()


@pytest.fixture
def names(page):
    """The names of a list, of which the second is open now."""
    page.goto(LIST)
    found = page.locator("tbody th a").all_inner_texts()
    page.locator("tbody th a").nth(1).click()
    opened(page, found[1])
    return found


def test_keys_and_links_go_to_the_neighbours_as_the_list_was_sorted(page, names):
    page.keyboard.press("j")
    opened(page, names[2])
    page.locator("#previous-trial").click()
    opened(page, names[1])
    page.keyboard.press("k")
    expect(page.locator("h1")).to_have_text(names[0])
    expect(page.locator("#previous-trial")).to_be_hidden()
    expect(page.locator("#next-trial")).to_be_visible()


@pytest.mark.long
def test_escape_leads_back_to_the_list(page, names):
    page.keyboard.press("j")
    opened(page, names[2])
    page.keyboard.press("Escape")
    page.wait_for_url(f"**{LIST}")


@pytest.mark.long
def test_a_list_of_decisions_leads_on_by_trials(page):
    page.goto("/words?q=merge")
    every = [row.split(" ")[0] for row in page.locator(".hits tbody th").all_inner_texts()]
    names = list(dict.fromkeys(row.split("\n")[0] for row in every))
    assert 2 < len(names) < len(every)
    page.locator(".hits tbody th a").first.click()
    opened(page, names[0])
    page.keyboard.press("j")
    opened(page, names[1])
    page.keyboard.press("j")
    expect(page.locator("h1")).to_have_text(names[2])


@pytest.mark.long
def test_a_trial_that_no_list_led_to_has_no_neighbours(page):
    page.goto("/trials/emulator/baseline/N_0_0/rep01")
    expect(page.locator("#track")).to_be_visible()
    expect(page.locator("#next-trial")).to_be_hidden()
