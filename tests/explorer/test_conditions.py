"""All trials of a condition in one picture: what is drawn of whom, and where it leads."""

from __future__ import annotations

import html
import re

import duckdb
import pytest
from playwright.sync_api import expect
from starlette.testclient import TestClient

from merge_runner_analysis.explorer.app import explorer
from merge_runner_analysis.explorer.pages import conditions
from merge_runner_analysis.explorer.site import Site
from merge_runner_analysis.explorer.traces import MEASURES, POINTS, read_band, read_traces
from tests.analysis.studies import Drive, as_humans, write_study, yielding
from tests.explorer.exporting import export_with_a_table
from tests.explorer.serving import served

HOST = "127.0.0.1:8700"
# Where the cross of a collision is on the screen: 2 units before the end of its line.
ON_THE_CROSS = """path => {
    const at = path.getPointAtLength(path.getTotalLength() - 2);
    const { x, y } = at.matrixTransform(path.getScreenCTM());
    return [x, y];
}"""
CRASH = Drive("o3", "baseline", "N_0_0", 9, (0.0,) * 9, (0.0,) * 9)
OTHER = {"left": "right", "right": "left"}
# The median of these three is the second one.
HUMANS = [Drive("human", "baseline", "N_0_0", i, (i / 10,) * 9, (-0.5,) * 9) for i in (1, 2, 3)]


@pytest.fixture(scope="module")
def db(tmp_path_factory):
    """Two drivers, one with two prompts, a collision, and three humans in one condition."""
    path = tmp_path_factory.mktemp("conditions") / "t.duckdb"
    others = [*yielding("o3", "A1", reps=2), *yielding("o4", reps=2)]
    write_study(path, [*yielding("o3", reps=2), CRASH, *others, *HUMANS])
    as_humans(path)
    return path


@pytest.fixture
def ask(db):
    site = Site(db)
    client = TestClient(explorer(site), base_url=f"http://{HOST}")
    yield client.get
    site.close()


def traces(text):
    """The trials of the picture by name, with the class of each line."""
    found = re.findall(
        r'<a href="/trials/([^"?]*)[^>]*><title>[^<]*</title><path class="([^"]*)"', text
    )
    return dict(found)


def test_the_picture_has_a_line_for_each_trial_that_leads_to_it(ask, db):
    text = ask("/conditions/N_0_0").text
    with duckdb.connect(str(db), read_only=True) as connection:
        there = connection.execute(
            "SELECT trial_id, coalesce(merged_first || '-first', status) FROM trials "
            "WHERE condition = 'N_0_0' AND source <> 'human'"
        ).fetchall()
    assert traces(text) == dict(there)
    assert traces(text)["o3/baseline/N_0_0/rep09"] == "collided"
    assert text.count(conditions.CROSS) == len(MEASURES)


@pytest.mark.parametrize(
    ("asked", "names"),
    [
        ("model=o4", {"o4/baseline"}),
        ("model=o3&variant=A1", {"o3/A1"}),
        ("variant=A1", {"o3/A1"}),
        ("model=human", {"human/baseline"}),
    ],
)
def test_the_address_chooses_the_driver_and_the_prompt(ask, asked, names):
    found = traces(ask(f"/conditions/N_0_0?{asked}").text)
    assert {name.rpartition("/N_0_0")[0] for name in found} == names


def test_the_humans_are_a_median_and_a_band(ask, db):
    text = ask("/conditions/N_0_0").text
    assert text.count('class="median"') == text.count('class="band"') == len(MEASURES)
    assert "median of 3 human trials" in text
    keys = [(f"human/baseline/N_0_0/rep0{i}", "human-baseline") for i in (1, 2, 3)]
    band, own = read_band(db, keys), read_traces(db, keys)
    middle = own[keys[1]]
    at = {round(t, 3): v for t, v in zip(middle["time_s"], middle["first_mps"], strict=True)}
    assert len(at) > 10
    for row in band[:20]:  # while all of them go on
        low, median, high = row["first_mps"]
        assert median == pytest.approx(at.get(round(row["time_s"], 3), median))
        assert low <= median <= high
    assert band[-1]["time_s"] > 5
    # The 10th percentile of three is a fifth of the way from the first to the second.
    low, median, high = band[20]["first_mps"]
    first, last = (own[key]["first_mps"][own[key]["time_s"].index(4.0)] for key in keys[::2])
    assert low == pytest.approx(first + (median - first) / 5)
    assert high == pytest.approx(last - (last - median) / 5)


def test_the_first_vehicle_is_that_which_merged_first(ask, db):
    with duckdb.connect(str(db), read_only=True) as connection:
        rows = connection.execute(
            "SELECT trial_id, spec_hash, merged_first FROM trials WHERE merged_first IS NOT NULL"
        ).fetchall()
        speeds = {
            tuple(key): speed
            for *key, speed in connection.execute(
                "SELECT trial_id, spec_hash, side, arg_max(velocity_mps, step) FROM states "
                "GROUP BY ALL"
            ).fetchall()
        }
    traces = read_traces(db, [(trial, spec) for trial, spec, _ in rows])
    assert {first for *_, first in rows} == {"left", "right"}
    for trial, spec, first in rows:
        trace = traces[trial, spec]
        assert trace["headway_m"][-1] > 0
        last = [speeds[trial, spec, side] for side in (first, OTHER[first])]
        assert [trace["first_mps"][-1], trace["second_mps"][-1]] == last
    text = ask("/conditions/N_0_0").text
    assert "Speed of the vehicle that merged first (m/s)" in text
    assert text.count('class="median"') == len(MEASURES)
    turned = [(f"o3/baseline/N_0_0/rep0{i}", "o3-baseline") for i in (1, 2)]
    assert read_band(db, turned)[-1]["headway_m"][0] > 0


def test_without_humans_the_page_says_what_reads_them(ask):
    text = ask("/conditions/L_4_0").text
    assert "merge-runner human import PATH" in text
    assert 'class="median"' not in text


def test_a_trace_begins_and_ends_with_its_trial(db):
    key = ("o3/baseline/N_0_0/rep09", "o3-baseline")
    trace = read_traces(db, [key])[key]
    with duckdb.connect(str(db), read_only=True) as connection:
        (last,) = connection.execute(
            "SELECT [max(time_s), arg_max(position_m, time_s) FILTER (side = 'left') - "
            "arg_max(position_m, time_s) FILTER (side = 'right')] FROM states "
            "WHERE (trial_id, spec_hash) = ($1, $2)",
            key,
        ).fetchone()
    assert trace["time_s"][0] == 0
    assert [trace["time_s"][-1], trace["headway_m"][-1]] == last
    assert len(trace["time_s"]) <= POINTS + 2


def test_of_too_many_trials_a_part_is_drawn_and_the_page_says_so(ask, monkeypatch):
    monkeypatch.setattr(conditions, "MOST", 3)
    text = ask("/conditions/N_0_0").text
    assert len(traces(text)) == 3
    assert "<strong>3</strong> trials are drawn, taken evenly from the list of 7" in text


def test_the_first_page_leads_to_every_condition_and_each_leads_back(ask, db):
    text = ask("/").text
    with duckdb.connect(str(db), read_only=True) as connection:
        names = connection.execute("SELECT DISTINCT condition FROM trials").fetchall()
    for (name,) in names:
        assert f'href="/conditions/{name}"' in text
        assert 'href="/#collisions"' in ask(f"/conditions/{name}").text


@pytest.mark.parametrize("address", ["/", "/trials"])
def test_the_code_of_a_condition_says_itself_in_words_on_every_page(ask, address):
    text = ask(address).text
    (told,) = set(re.findall(r'title="([^"]*)"[^>]*>(?:<[^>]*>\s*)*R_-2_8[< ]', text)) or {None}
    assert told == "the right vehicle would be 2 m ahead at the merge point, and the left one is " \
        "0.8 m/s faster"  # fmt: skip


def test_a_condition_that_nobody_drove_is_not_there(ask):
    reply = ask("/conditions/nothing")
    assert reply.status_code == 404
    assert "no trial of the condition nothing is here" in reply.text


def test_a_page_that_looks_for_news_gets_none_where_there_are_none(ask):
    text = ask("/conditions/N_0_0").text
    news = html.unescape(re.search(r'hx-get="([^"]*seen=[^"]*)"', text)[1])
    assert ask(news).status_code == 204
    assert ask(news.replace("seen=", "seen=0")).status_code == 200


def test_a_click_on_a_trace_opens_its_trial_and_a_choice_changes_the_picture(browser, db):
    context = browser.new_context(viewport={"width": 1440, "height": 1000})
    page = context.new_page()
    with served(db) as address:
        page.goto(f"{address}/conditions/N_0_0")
        page.locator("#choice-model").select_option("o4")
        expect(page.locator(".overlay path")).to_have_count(2)
        expect(page).to_have_url(re.compile("model=o4$"))
        page.locator("#choice-model").select_option("o3")
        expect(page.locator(".overlay path")).to_have_count(5)
        page.locator("#choice-variant").select_option("baseline")
        expect(page.locator(".overlay path")).to_have_count(3)
        crash = page.locator("path.collided")
        expect(crash).to_have_count(1)
        crash.scroll_into_view_if_needed()
        x, y = crash.evaluate(ON_THE_CROSS)
        page.mouse.click(x, y)
        expect(page.locator("h1")).to_have_text("o3/baseline/N_0_0/rep09")
        page.get_by_role("link", name="the traces of N_0_0").click()
        expect(page.locator("h1")).to_contain_text("N_0_0")
    context.close()


@pytest.mark.long
def test_an_export_has_the_same_picture(page, db, tmp_path):
    files = export_with_a_table(db, tmp_path / "pages")
    page.context.set_offline(True)
    page.goto(f"file://{tmp_path}/pages/index.html")
    page.get_by_role("link", name="N_0_0", exact=True).click()
    expect(page.locator(".overlay path")).to_have_count(7)
    expect(page.locator(".overlay .median")).to_have_count(3)
    page.locator("tbody tr", has_text="o4").locator("td a").first.click()
    expect(page.locator("tbody tr")).to_have_count(2)
    page.goto(f"file://{files}/conditions-N_0_0.html")
    page.locator("path.collided").dispatch_event("click")
    expect(page.locator("h1")).to_have_text("o3/baseline/N_0_0/rep09")
