"""The panel beside a replay follows it, until a decision is chosen or somebody reads."""

from __future__ import annotations

import re

import pytest
from playwright.sync_api import expect

from tests.support.axe import serious

TRIAL = "/trials/emulator/baseline/N_0_0/rep01"
COLLIDED = "/trials/emulator/baseline/N_0_0/rep03"
LONG = "/trials/<b>o3</b>/baseline/L_4_0/rep01"


@pytest.fixture
def phone(browser, site):
    """A page as narrow as a telephone."""
    context = browser.new_context(base_url=site, viewport={"width": 420, "height": 800})
    yield context.new_page()
    context.close()


def headings(page):
    return page.locator("#decision .decision-panel h2")


def test_the_panel_shows_what_both_say_now(page):
    page.goto(TRIAL)
    expect(page.locator("#decision")).to_contain_text("What they last said")
    page.locator("#scrub").fill("1.5")
    expect(headings(page)).to_have_text(["left decision 1 at 1.0 s", "right decision 1 at 1.0 s"])
    page.keyboard.press("Shift+ArrowRight")
    expect(headings(page)).to_have_text(["left decision 2 at 2.0 s", "right decision 2 at 2.0 s"])
    expect(page.locator("a.decision[aria-current]")).to_have_count(0)
    assert "decision=" not in page.url


@pytest.mark.long
def test_it_follows_while_the_trial_plays(page):
    page.goto(f"{TRIAL}?t=0.5")
    expect(headings(page).first).to_contain_text("decision 0")
    page.keyboard.press("5")
    page.keyboard.press(" ")
    last = page.locator(".ribbon.left a.decision").last.get_attribute("data-n")
    expect(headings(page).first).to_contain_text(f"decision {last}")
    expect(page.locator("#play")).to_have_text("Play")
    page.locator("#scrub").fill("0.5")
    expect(headings(page).first).to_contain_text("decision 0")


@pytest.mark.long
def test_a_decision_that_is_chosen_stays_until_escape(page):
    page.goto(f"{TRIAL}?t=0.5")
    page.locator("a.decision").nth(1).click()
    expect(headings(page)).to_have_text(["left decision 1 at 1.0 s"])
    expect(page.locator("#follow")).to_be_visible()
    page.locator("#scrub").fill("3.5")
    page.wait_for_timeout(400)
    expect(headings(page)).to_have_text(["left decision 1 at 1.0 s"])
    page.keyboard.press("Escape")
    expect(headings(page)).to_have_text(["left decision 3 at 3.0 s", "right decision 3 at 3.0 s"])
    expect(page.locator("#follow")).to_be_hidden()
    page.locator("#decision .last").first.click()
    expect(headings(page)).to_have_text(["left decision 3 at 3.0 s"])
    expect(page.get_by_role("heading", name="What it was told")).to_be_visible()


@pytest.mark.long
def test_who_scrolls_to_read_is_not_disturbed(page):
    page.set_viewport_size({"width": 1500, "height": 420})
    page.goto(f"{TRIAL}?t=1.5")
    expect(headings(page).first).to_contain_text("decision 1")
    page.locator("#panel").evaluate("panel => { panel.scrollTop = 60; }")
    expect(page.locator("#follow")).to_be_visible()
    page.locator("#scrub").fill("3.5")
    page.wait_for_timeout(400)
    expect(headings(page).first).to_contain_text("decision 1")
    page.locator("#follow").click()
    expect(headings(page).first).to_contain_text("decision 3")


@pytest.mark.long
def test_what_was_said_and_planned_stands_before_the_prompt(page):
    page.goto(f"{TRIAL}?side=left&decision=1")
    found = page.locator("#decision h3").all_inner_texts()
    assert found.index("What it said") < found.index("What it planned")
    assert found.index("What it planned") < found.index("What it was told")


def test_an_invalid_reply_stands_open_and_the_plan_that_went_on_is_named(page):
    page.goto(f"{LONG}?side=left&decision=1")
    panel = page.locator(".decision-panel")
    expect(panel.locator(".verdict")).to_have_text(
        re.compile("no valid plan: no_array: it drove on with an older plan, or kept its speed")
    )
    expect(panel.locator("details", has_text="The whole reply")).to_have_attribute("open", "")


@pytest.mark.long
def test_buttons_go_through_the_decisions(page):
    page.goto(TRIAL)
    page.locator("#next-decision").click()
    page.locator("#next-decision").click()
    expect(headings(page)).to_have_text(["right decision 0 at 0.0 s"])
    page.locator("#previous-decision").click()
    expect(headings(page)).to_have_text(["left decision 0 at 0.0 s"])


@pytest.mark.long
def test_a_decision_that_is_tapped_on_a_phone_is_seen_and_leads_back(phone):
    phone.goto(TRIAL)
    phone.locator("a.decision").nth(2).click()
    expect(phone.locator(".decision-panel h2")).to_be_in_viewport()
    phone.locator("#to-replay").click()
    expect(phone.locator("#track")).to_be_in_viewport(ratio=0.9)
    expect(phone.locator("a.decision[aria-current]")).to_have_count(1)
    assert phone.evaluate("document.documentElement.scrollWidth") == 420


@pytest.mark.long
def test_the_moments_stand_on_the_charts(page):
    page.goto(COLLIDED)
    expect(page.locator("#lines .collision")).to_have_count(1)
    page.goto(TRIAL)
    expect(page.locator("#lines .merge")).to_have_count(2)
    page.get_by_role("button", name="left merges").click()
    told = page.locator("#now").inner_text()
    assert float(re.search(r"left \S+ m/s at (\S+) m", told)[1]) == pytest.approx(100, abs=0.1)


@pytest.mark.long
def test_paper_has_signs_of_the_size_of_the_track(page):
    page.set_viewport_size({"width": 700, "height": 900})
    page.goto(TRIAL)
    sizes = []
    for media in ("screen", "print"):
        page.emulate_media(media=media)
        sizes.append(
            page.eval_on_selector("#track .sign", "sign => getComputedStyle(sign).fontSize")
        )
    assert sizes == ["5px", "2.6px"]


@pytest.mark.long
def test_paper_has_no_link_that_nobody_can_follow_and_the_words_of_a_search(page):
    page.goto(f"{TRIAL}?t=2.5")
    expect(page.locator(".brief .whole").last).to_be_visible()
    page.emulate_media(media="print")
    expect(page.locator(".brief .whole").last).to_be_hidden()
    page.goto("/words?q=script")
    expect(page.locator("#search")).to_be_visible()
    expect(page.locator(".hits thead")).to_be_visible()


@pytest.mark.long
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_a_trial_is_accessible_while_it_is_followed_and_compared(page, scheme):
    page.emulate_media(color_scheme=scheme)
    page.goto(f"{TRIAL}?t=2.5&compare=emulator/baseline/L_4_0/rep01")
    expect(page.locator("#decision .decision-panel")).to_have_count(4)
    page.locator("#compare").click()
    expect(page.locator("#others option").first).to_be_attached()
    assert serious(page) == []
