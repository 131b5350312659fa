"""A trial is watched and its decisions read, by mouse, by keys and by address."""

from __future__ import annotations

import re

import pytest
from playwright.sync_api import expect

from tests.support.hostile import HOSTILE

TRIAL = "/trials/emulator/baseline/N_0_0/rep01"
COLLIDED = "/trials/emulator/baseline/N_0_0/rep03"


def clock(page) -> float:
    return float(page.locator("#clock").inner_text().split()[0])


def place(page, side):
    return page.locator(f"#track .own.{side}").get_attribute("transform")


def test_the_list_leads_to_a_collision_and_its_words(page):
    page.goto("/trials")
    page.get_by_label("condition").select_option("N_0_0")
    page.get_by_label("outcome").select_option("collided")
    expect(page.locator(".totals")).to_contain_text("1 of 1 ended ones collided")
    expect(page).to_have_url(re.compile("condition=N_0_0.*outcome=collided"))
    page.reload()
    expect(page.locator("tbody tr")).to_have_count(1)
    page.locator("tbody a").first.click()
    expect(page.get_by_text("The vehicles collided")).to_be_visible()
    page.locator("a.decision").last.click()
    panel = page.locator(".decision-panel")
    for heading in ("What it was told", "What it said", "What it planned"):
        expect(panel.get_by_role("heading", name=heading)).to_be_visible()
    expect(panel.locator("h4").first).to_contain_text("C0")
    page.go_back()
    page.go_back()
    expect(page.locator("tbody tr")).to_have_count(1)


def test_time_moves_by_play_scrub_and_keys(page):
    page.goto(TRIAL)
    start = place(page, "left")
    page.keyboard.press("5")
    page.keyboard.press(" ")
    expect(page.locator("#clock")).to_have_text(re.compile(r"^[1-9]"))
    page.keyboard.press(" ")
    stopped = clock(page)
    assert place(page, "left") != start
    page.keyboard.press("ArrowRight")
    assert clock(page) == pytest.approx(stopped + 0.1, abs=0.051)
    page.keyboard.press("Shift+ArrowRight")
    assert clock(page) == pytest.approx(stopped + 1.1, abs=0.051)
    page.locator("#scrub").fill("2.5")
    assert clock(page) == 2.5
    page.keyboard.press("ArrowLeft")
    assert clock(page) == 2.4
    page.keyboard.press("ArrowRight")
    left = page.locator("#playhead").bounding_box()["x"]
    page.keyboard.press("Shift+ArrowRight")
    assert page.locator("#playhead").bounding_box()["x"] > left
    expect(page).to_have_url(re.compile(r"t=3\.5"))


def test_a_trial_is_played_to_its_end(page):
    page.goto(f"{COLLIDED}?t=2.5")
    crash = page.locator("#track .crash")
    expect(crash).to_be_hidden()
    page.keyboard.press("5")
    page.locator("#play").click()
    expect(crash).to_be_visible()
    expect(page.locator("#play")).to_have_text("Play")


@pytest.mark.long
def test_brackets_go_through_the_decisions_and_escape_goes_back(page):
    page.goto(TRIAL)
    for _ in range(3):
        page.keyboard.press("]")
    current = page.locator("a.decision[aria-current]")
    expect(current).to_have_attribute("aria-label", re.compile("left, decision 1 at 1.0 s"))
    expect(page.locator(".decision-panel h2")).to_contain_text("decision 1 at 1.0 s")
    assert clock(page) == 1.0
    page.keyboard.press("[")
    expect(current).to_have_attribute("aria-label", re.compile("right, decision 0"))
    page.keyboard.press("Escape")
    expect(current).to_have_count(0)
    page.keyboard.press("Escape")
    page.wait_for_url("**/trials")


@pytest.mark.long
def test_escape_leads_back_to_the_list_as_it_was_filtered(page):
    page.goto("/trials?condition=N_0_0&sort=-end")
    page.locator("tbody a").first.click()
    page.locator("a.decision.now").first.click()
    expect(page.locator(".decision-panel")).to_be_visible()
    page.reload()
    expect(page.locator("a.decision[aria-current]")).to_have_count(1)
    page.keyboard.press("Escape")
    expect(page.locator(".decision-panel")).to_have_count(0)
    expect(page.locator("#decision")).to_contain_text("What they last said")
    page.keyboard.press("Escape")
    page.wait_for_url("**/trials?condition=N_0_0&sort=-end")


@pytest.mark.long
def test_brackets_begin_where_the_replay_was_stopped(page):
    page.goto(f"{TRIAL}?t=3.4")
    driven = page.locator("a.decision.now")
    assert [link.get_attribute("data-n") for link in driven.all()] == ["3", "3"]
    page.keyboard.press("[")
    current = page.locator("a.decision[aria-current]")
    expect(current).to_have_attribute("aria-label", re.compile("right, decision 3"))
    page.locator("#scrub").fill("1.5")
    page.keyboard.press("]")
    expect(current).to_have_attribute("aria-label", re.compile("left, decision 2"))
    expect(driven.first).to_have_attribute("data-n", "2")


def test_an_address_brings_everything_back(page):
    other = "emulator/baseline/N_0_0/rep02"
    page.goto(f"{TRIAL}?t=4.2&side=right&decision=3&compare={other}")
    expect(page.locator(".decision-panel h2")).to_contain_text("right")
    expect(page.locator("#clock")).to_have_text(re.compile(r"^4\.2 s"))
    expect(page.locator("#ghost-key")).to_contain_text("rep 2")
    expect(page.locator("#track .ghost.left")).to_be_visible()
    page.locator("a.decision").first.click()
    expect(page.locator(".decision-panel h2")).to_contain_text("decision 0")
    page.go_back()
    expect(page.locator(".decision-panel h2")).to_contain_text("decision 3")
    expect(page.locator("#clock")).to_have_text(re.compile(r"^4\.2 s"))


@pytest.mark.long
def test_keys_are_off_while_one_types(page):
    page.goto("/trials")
    page.keyboard.press("/")
    page.keyboard.type("jk?1")
    assert page.locator("#search").input_value() == "jk?1"
    expect(page.locator("#help")).to_be_hidden()
    page.locator("#search").fill("")
    page.keyboard.press("Escape")
    page.keyboard.press("?")
    expect(page.locator("#help")).to_be_visible()


@pytest.mark.long
def test_a_click_into_a_chart_moves_the_clock(page):
    page.goto(TRIAL)
    chart = page.locator("#chart-h")
    chart.click(position={"x": chart.bounding_box()["width"] / 2, "y": 20})
    end = float(page.locator("#clock").inner_text().split()[3])
    assert clock(page) == pytest.approx(end / 2, abs=0.2)


@pytest.mark.parametrize("side", ["left", "right"])
def test_what_a_model_wrote_is_text(page, side):
    page.goto(f"/trials/<b>o3</b>/baseline/L_4_0/rep01?side={side}&decision=1")
    panel = page.locator(".decision-panel")
    expect(panel).to_contain_text("<script>document.title='owned'</script>")
    expect(panel).to_contain_text("{{ 7*7 }}")
    expect(panel).to_contain_text("[U+202E]")
    assert "owned" not in page.title()
    assert panel.locator("script, img").count() == 0
    reply = panel.locator("details", has_text="The whole reply")
    if reply.get_attribute("open") is None:  # as it is where the plan is valid
        reply.locator("summary").click()
    raw = page.request.get(panel.get_by_role("link", name="the whole text").get_attribute("href"))
    assert raw.headers["content-type"].startswith("text/csv")
    assert "attachment" in raw.headers["content-disposition"]
    assert len(raw.text()) > len(HOSTILE) + 1_000_000
    assert len(panel.inner_text()) < 50_000


@pytest.mark.long
def test_who_wants_no_motion_gets_pictures(browser, site):
    context = browser.new_context(base_url=site, reduced_motion="reduce")
    page = context.new_page()
    page.clock.install()
    page.goto(TRIAL)
    page.evaluate(
        "window.seen = new Set(); new MutationObserver(() => seen.add("
        "document.getElementById('clock').textContent)).observe("
        "document.getElementById('clock'), {childList: true, characterData: true, subtree: true})"
    )
    page.keyboard.press(" ")
    page.clock.run_for(1500)
    pictures = page.evaluate("seen.size")
    context.close()
    assert 1 <= pictures <= 4


@pytest.mark.long
def test_figures_choose_the_speed_and_c_the_other_trial(page):
    page.goto(TRIAL)
    for key, speed in zip("12345", ("0.25", "0.5", "1", "2", "4"), strict=True):
        page.keyboard.press(key)
        expect(page.locator("#speed")).to_have_value(speed)
    page.keyboard.press("c")
    expect(page.locator("#compare")).to_be_focused()
    page.keyboard.type("human")
    page.keyboard.press("Enter")
    expect(page.locator("#ghost-key")).to_contain_text("human P1")
    page.keyboard.press(" ")
    expect(page.locator("#play")).to_have_text("Pause")


@pytest.mark.long
def test_the_other_trial_goes_on_where_this_one_ended(page):
    page.goto(f"{COLLIDED}?compare=emulator/baseline/N_0_0/rep01")
    expect(page.locator("#ghost-key")).to_contain_text("dashed")
    own = float(page.locator(".outcome-text").inner_text().split("after ")[1].split()[0])
    page.locator("#scrub").fill(str(own + 1))
    assert clock(page) == pytest.approx(own + 1)
    expect(page.locator("#track .crash")).to_be_visible()
    before = page.locator("#track .ghost.left").get_attribute("transform")
    page.keyboard.press("Shift+ArrowRight")
    assert page.locator("#track .ghost.left").get_attribute("transform") != before
    assert "after" in page.locator("#ghost-key").inner_text()
    page.locator("#alone").click()
    expect(page.locator("#clock")).to_have_text(f"{own:.1f} s of {own:.1f} s")


@pytest.mark.long
def test_a_trial_that_is_not_there_to_compare_with_is_said(page):
    page.goto(f"{TRIAL}?compare=emulator/baseline/L_4_0/rep99")
    expect(page.locator("#ghost-key")).to_contain_text("is not there to compare with")
    expect(page.locator("#compare")).to_have_value("")


@pytest.mark.long
def test_a_call_without_an_answer_can_be_read(page):
    page.goto("/trials/o4/baseline/L_4_0/rep01")
    lost = page.get_by_role("link", name="left, decision 2 at 2.0 s")
    expect(lost).to_have_attribute("aria-label", re.compile("no answer, never driven"))
    lost.click()
    panel = page.locator(".decision-panel")
    expect(panel).to_contain_text("The call got no answer")
    expect(panel.locator("tbody")).to_contain_text("timeout")
    other = page.get_by_role("link", name="right, decision 2 at 2.0 s")
    expect(other).to_have_attribute("aria-label", re.compile("decision, never driven"))
    other.click()
    expect(panel).to_contain_text("right decision 2 at 2.0 s")


@pytest.mark.long
def test_the_last_words_of_both_lead_to_their_decisions(page):
    page.goto(COLLIDED)
    words = page.locator("#decision article")
    expect(words).to_have_count(2)
    expect(words.first).to_contain_text("I take the gap")
    words.last.get_by_role("link").click()
    expect(page.locator(".decision-panel h2")).to_contain_text("right decision")
    expect(page.locator("a.decision[aria-current]")).to_have_count(1)
    page.go_back()
    expect(words).to_have_count(2)


@pytest.mark.long
def test_a_block_that_did_not_change_is_folded(page):
    page.goto(f"{TRIAL}?side=left&decision=2")
    blocks = page.locator("details.block")
    expect(blocks.first).to_have_attribute("open", "")
    same = page.locator("details.block", has_text="as before").first
    expect(same.locator("pre")).to_be_hidden()


@pytest.mark.long
def test_nothing_that_is_typed_into_the_search_is_lost(page):
    page.goto("/trials")
    page.locator("#search").press_sequentially("n_0_0/rep0", delay=260)
    expect(page.locator("#search")).to_have_value("n_0_0/rep0")
    expect(page.locator("tbody tr").first).to_contain_text("N_0_0")
    page.wait_for_url("**/trials?q=n_0_0%2Frep0")
    page.keyboard.press("Enter")
    page.wait_for_timeout(300)
    assert page.url.endswith("/trials?q=n_0_0%2Frep0")
    expect(page.locator("#search")).to_be_focused()


@pytest.mark.long
def test_who_filters_by_keyboard_stays_where_he_was(page):
    page.goto("/trials")
    page.get_by_label("outcome").focus()
    page.get_by_label("outcome").select_option("collided")
    expect(page.locator("tbody tr")).to_have_count(1)
    expect(page.get_by_label("outcome")).to_be_focused()
    with page.expect_event("load"):
        page.go_back()
    expect(page.locator("tbody tr")).not_to_have_count(1)
    page.keyboard.press("?")
    expect(page.locator("#help")).to_be_visible()
