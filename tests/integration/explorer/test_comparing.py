"""A second trial is found by its words or offered, and laid beside the first."""

from __future__ import annotations

import json
import re
import shutil

import duckdb
import pytest
from playwright.sync_api import expect
from starlette.testclient import TestClient

from merge_runner_analysis.explorer.app import explorer
from merge_runner_analysis.explorer.site import Site
from tests.support.studies import Drive, as_humans, write_study

HOST = "127.0.0.1:8700"
TRIAL = "emulator/baseline/N_0_0/rep01"
# Humans of whom the second keeps its distance as the model does; the last ends too early.
DRIVES = (
    Drive("o3", "baseline", "N_0_0", 1, (0.5, 0.5), (-0.5, -0.5)),
    Drive("o3", "baseline", "N_0_0", 2, (0.0,), (-0.8,) * 3),
    Drive("o3", "A1", "N_0_0", 1, (0.4,), (-0.8,) * 3),
    Drive("o4", "A1", "N_0_0", 1, (0.5, 0.5), (-0.5, -0.5)),
    Drive("o4", "baseline", "N_0_0", 2, (0.5, 0.5), (-0.5, -0.5)),
    Drive("human", "far", "N_0_0", 1, (-0.5, -0.5), (0.5, 0.5)),
    Drive("human", "near", "N_0_0", 1, (0.5, 0.4), (-0.5, -0.5)),
    Drive("human", "short", "N_0_0", 1, (0.5, 0.5), (-0.5, -0.5)),
)


@pytest.fixture(scope="module")
def db(tmp_path_factory):
    """Two drivers and three humans of one condition."""
    path = tmp_path_factory.mktemp("comparing") / "t.duckdb"
    write_study(path, list(DRIVES))
    as_humans(path)
    with duckdb.connect(str(path)) as connection:
        connection.execute("DELETE FROM states WHERE trial_id LIKE 'human/short/%' AND time_s > 2")
    return path


@pytest.fixture(scope="module")
def client(db):
    return TestClient(explorer(Site(db)), base_url=f"http://{HOST}")


def ask(client, trial, **asked):
    return client.get(f"/others/{trial}", params=asked).json()


def test_the_nearest_human_is_the_one_with_the_closest_headway_and_not_one_who_ended(client):
    assert ask(client, "o3/baseline/N_0_0/rep01", offer="nearest human") == (
        "human/near/N_0_0/rep01"
    )
    assert ask(client, "human/near/N_0_0/rep01", offer="nearest human") == "human/far/N_0_0/rep01"


def test_only_a_human_at_the_same_speeds_is_near(db, tmp_path):
    path = shutil.copy(db, tmp_path / "t.duckdb")
    human = "(SELECT spec_hash FROM trials WHERE source = 'human')"

    def nearest(which):
        with duckdb.connect(str(path)) as connection:
            connection.execute(
                "UPDATE specs SET spec = json_merge_patch(spec, ?) "
                f"WHERE spec_hash {which} {human}",
                [json.dumps({"mean_speed_mps": 15})],
            )
        client = TestClient(explorer(Site(path)), base_url=f"http://{HOST}")
        return ask(client, "o3/baseline/N_0_0/rep01", offer="nearest human")

    assert nearest("NOT IN") is None
    assert nearest("IN") == "human/near/N_0_0/rep01"


def test_the_next_repetition_goes_round(client):
    names = ["o3/baseline/N_0_0/rep01", "o3/baseline/N_0_0/rep02"]
    assert [ask(client, name, offer="next repetition") for name in names] == names[::-1]
    assert ask(client, "o3/A1/N_0_0/rep01", offer="next repetition") is None


def test_all_words_of_a_search_count_and_the_own_trial_is_not_found(client):
    found = ask(client, "o3/baseline/N_0_0/rep01", q="O3 rep01")
    assert [one["key"] for one in found["found"]] == ["o3/A1/N_0_0/rep01"]
    assert ask(client, "o3/baseline/N_0_0/rep01", q="nobody has this") == {"found": []}


def test_an_offer_that_is_unknown_names_the_others(client):
    reply = client.get("/others/o3/baseline/N_0_0/rep01", params={"offer": "best"})
    assert reply.status_code == 404
    assert "nearest human, next repetition" in reply.text


def test_a_name_with_several_specs_is_told_with_its_spec(db, tmp_path):
    twice = shutil.copy(db, tmp_path / "t.duckdb")
    with duckdb.connect(str(twice)) as connection:
        for table in ("trials", "states"):
            connection.execute(
                f"INSERT INTO {table} BY NAME SELECT * REPLACE ('abc' AS spec_hash) FROM {table} "
                "WHERE trial_id = 'o4/A1/N_0_0/rep01'"
            )
    client = TestClient(explorer(Site(twice)), base_url=f"http://{HOST}")
    keys = {one["key"] for one in ask(client, "o3/A1/N_0_0/rep01", q="o4 a1")["found"]}
    assert "o4/A1/N_0_0/rep01@abc" in keys
    assert len(keys) == 2
    data = ask(client, "o3/A1/N_0_0/rep01", compare="o4/A1/N_0_0/rep01@abc")
    assert data["spec"] == "abc"


def test_both_ribbons_and_both_words_stand_beside_each_other(page):
    other = "emulator/baseline/L_4_0/rep02"
    page.goto(f"/trials/{TRIAL}?t=2.5&compare={other}")
    expect(page.locator("#other-ribbons .ribbon")).to_have_count(2)
    expect(page.locator("#decision h2.of")).to_have_count(2)
    expect(page.locator("#decision .decision-panel")).to_have_count(4)
    own, others = page.locator("#ribbons a.now"), page.locator("#other-ribbons a.now")
    assert own.first.bounding_box()["x"] == pytest.approx(others.first.bounding_box()["x"], abs=1)
    others.first.click()
    expect(page.locator("#decision .decision-panel h2")).to_have_count(1)
    expect(page).to_have_url(re.compile("of=other"))
    page.reload()
    expect(page.locator("#other-ribbons a[aria-current]")).to_have_count(1)
    page.locator("#ghost-key a").click()
    expect(page.locator("h1")).to_have_text(other)


@pytest.mark.long
def test_the_other_is_found_by_keyboard_alone(page):
    page.goto(f"/trials/{TRIAL}")
    page.keyboard.press("c")
    page.keyboard.type("l_4_0 rep02")
    expect(page.locator("#others option")).to_have_count(1)
    page.keyboard.press("Enter")
    expect(page.locator("#ghost-key")).to_contain_text("L_4_0, rep 2")
    expect(page).to_have_url(re.compile("compare=emulator"))
    page.keyboard.press(" ")
    expect(page.locator("#play")).to_have_text("Pause")


@pytest.mark.long
def test_an_answer_that_comes_late_does_not_replace_that_to_newer_words(page):
    late = []

    def answered(route):
        if "q=l_4_0" in route.request.url and not late:
            late.append(route)
        else:
            route.continue_()

    page.goto(f"/trials/{TRIAL}")
    page.route("**/others/**", answered)
    page.locator("#compare").fill("l_4_0")
    page.locator("#compare").fill("l_4_0 rep02")
    expect(page.locator("#others option")).to_have_count(1)
    with page.expect_response("**/others/**"):
        late[0].continue_()
    page.wait_for_function("() => new Promise((done) => setTimeout(() => done(true)))")
    expect(page.locator("#others option")).to_have_count(1)


@pytest.mark.long
def test_offers_are_a_click_away(page):
    page.goto(f"/trials/{TRIAL}")
    page.get_by_role("button", name="next repetition").click()
    expect(page.locator("#ghost-key")).to_contain_text("rep 2")
    page.get_by_role("button", name="nearest human").click()
    expect(page.locator("#ghost-key")).to_contain_text("human P1")
    page.go_back()
    expect(page.locator("#ghost-key")).to_contain_text("rep 2")


@pytest.mark.long
def test_where_nobody_answers_nothing_is_said_of_what_there_is(browser, site):
    context = browser.new_context(base_url=site)
    page = context.new_page()
    page.goto(f"/trials/{TRIAL}")
    page.route("**/others/**", lambda route: route.abort())
    page.locator("#compare").fill("rep02")
    expect(page.locator("#lost")).to_be_visible()
    expect(page.locator("#others")).to_be_hidden()
    page.get_by_role("button", name="next repetition").click()
    expect(page.locator("#lost")).to_be_visible()
    expect(page.locator("#ghost-key")).to_be_hidden()
    page.unroute_all()
    page.get_by_role("button", name="next repetition").click()
    expect(page.locator("#ghost-key")).to_contain_text("rep 2")
    expect(page.locator("#lost")).to_be_hidden()
    context.close()
