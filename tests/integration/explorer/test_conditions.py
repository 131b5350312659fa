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
from merge_runner_analysis.explorer.pages.conditions import BAND, PANELS, TRACES
from merge_runner_analysis.explorer.site import Site
from tests.support.exporting import export_with_a_table
from tests.support.serving import served
from tests.support.studies import Drive, as_humans, write_study, yielding

HOST = "127.0.0.1:8700"
# Where the cross of a collision is on the screen: 2 units before the end of its line.
ON_THE_CROSS = """path => {
    const at = path.getPointAtLength(path.getTotalLength() - 2);
    const { x, y } = at.matrixTransform(path.getScreenCTM());
    return [x, y];
}"""
CRASH = Drive("o3", "baseline", "N_0_0", 9, (0.0,) * 9, (0.0,) * 9)
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


def read(db, sql, keys):
    """What the page reads of trials by (name, spec)."""
    with duckdb.connect(str(db), read_only=True) as connection:
        found = connection.execute(sql, [list(part) for part in zip(*keys, strict=True)])
        names = [column[0] for column in found.description]
        return [dict(zip(names, row, strict=True)) for row in found.fetchall()]


def test_the_picture_has_a_line_for_each_trial_of_a_driver_that_leads_to_it(ask, db):
    text = ask("/conditions/N_0_0").text
    with duckdb.connect(str(db), read_only=True) as connection:
        there = connection.execute(
            "SELECT trial_id, coalesce(merged_first || '-first', status) FROM trials "
            "WHERE condition = 'N_0_0' AND source <> 'human'"
        ).fetchall()
    assert traces(text) == dict(there)
    assert f"<b>{len(there)}</b> trials of drivers are drawn." in text
    assert "<h1>N_0_0: the drivers' trials beside the humans' band</h1>" in text
    assert traces(text)["o3/baseline/N_0_0/rep09"] == "collided"
    assert text.count(conditions.CROSS) == len(PANELS)


@pytest.mark.parametrize(
    ("asked", "names"),
    [
        ("model=o4", {"o4/baseline"}),
        ("model=o3&model=o4&variant=baseline", {"o3/baseline", "o4/baseline"}),
        ("model=o3&variant=A1", {"o3/A1"}),
        ("variant=A1", {"o3/A1"}),
    ],
)
def test_picture_and_table_are_of_the_scope(ask, asked, names):
    text = ask(f"/conditions/N_0_0?{asked}").text
    assert {name.rpartition("/N_0_0")[0] for name in traces(text)} == names
    rows = re.findall(r'<tr><th scope="row">([^<]*)</th><td>([^<]*)</td>', text)
    assert {"/".join(row) for row in rows} == names


def test_a_run_that_held_no_trial_of_the_condition_leaves_none(ask, db):
    with duckdb.connect(str(db), read_only=True) as connection:
        ((sweep, trials),) = connection.execute(
            "SELECT sweep_id, count(*) FROM sweep_trials JOIN trials USING (trial_id, spec_hash) "
            "WHERE condition = 'N_0_0' AND source <> 'human' GROUP BY ALL"
        ).fetchall()
    assert len(traces(ask(f"/conditions/N_0_0?sweep={sweep}").text)) == trials
    for wrong in ("sweep=none", "model=nobody", "variant=A9"):
        assert ask(f"/conditions/N_0_0?{wrong}").status_code == 404


def test_the_humans_are_a_median_and_a_band(ask, db):
    text = ask("/conditions/N_0_0").text
    assert text.count('class="median"') == text.count('polygon class="band"') == len(PANELS)
    assert "3 human trials: their median" in text
    keys = [(f"human/baseline/N_0_0/rep0{i}", "human-baseline") for i in (1, 2, 3)]
    band = read(db, BAND, keys)
    own = {row["trial_id"]: row for row in read(db, TRACES, keys)}
    one, middle, other = (own[name] for name, _ in keys)
    at = {round(t, 3): v for t, v in zip(middle["time_s"], middle["first_mps"], strict=True)}
    assert len(at) > 10
    for row in band[:20]:  # while all of them go on
        low, median, high = row["first_mps"]
        assert median == pytest.approx(at.get(round(row["time_s"], 3), median))
        assert low <= median <= high
    assert band[-1]["time_s"] > 5
    # The 10th percentile of three is a fifth of the way from the first to the second.
    low, median, high = band[20]["first_mps"]
    first, last = (row["first_mps"][row["time_s"].index(4.0)] for row in (one, other))
    assert low == pytest.approx(first + (median - first) / 5)
    assert high == pytest.approx(last - (last - median) / 5)


def test_the_first_vehicle_is_the_one_that_merged_first_or_was_ahead_at_the_end(db):
    with duckdb.connect(str(db), read_only=True) as connection:
        rows = connection.execute(
            "SELECT trial_id, spec_hash, coalesce(any_value(merged_first), if("
            "arg_max(position_m, time_s) FILTER (side = 'left') >= "
            "arg_max(position_m, time_s) FILTER (side = 'right'), 'left', 'right')), "
            "arg_max(velocity_mps, time_s) FILTER (side = 'left'), "
            "arg_max(velocity_mps, time_s) FILTER (side = 'right') "
            "FROM trials JOIN states USING (trial_id, spec_hash) GROUP BY ALL"
        ).fetchall()
    assert {first for _, _, first, *_ in rows} == {"left", "right"}
    found = read(db, TRACES, [(trial, spec) for trial, spec, *_ in rows])
    ends = {(row["trial_id"], row["spec_hash"]): row for row in found}
    for trial, spec, first, left, right in rows:
        end = ends[trial, spec]
        speeds = (left, right) if first == "left" else (right, left)
        assert (end["first_mps"][-1], end["second_mps"][-1]) == speeds
        assert end["headway_m"][-1] >= 0
        assert end["time_s"][0] == 0


def test_without_humans_the_page_says_so_and_has_no_band(ask):
    text = ask("/conditions/L_4_0").text
    assert "No human trial of this condition is here." in text
    assert "beside the humans" not in text
    assert 'class="median"' not in text


def test_of_too_many_trials_a_part_is_drawn_and_the_page_says_so(ask, monkeypatch):
    monkeypatch.setattr(conditions, "MOST", 3)
    text = ask("/conditions/N_0_0").text
    assert len(traces(text)) == 3
    assert "<b>3</b> trials of drivers are drawn, taken evenly from the list of 7" in text


def test_the_first_page_leads_to_every_condition_and_each_leads_back(ask, db):
    text = ask("/").text
    with duckdb.connect(str(db), read_only=True) as connection:
        names = connection.execute("SELECT DISTINCT condition FROM trials").fetchall()
    for (name,) in names:
        assert f'href="/conditions/{name}"' in text
        assert 'href="/#collisions"' in ask(f"/conditions/{name}").text
    scoped = ask("/?variant=baseline&condition=N_0_0").text
    assert 'href="/conditions/N_0_0?variant=baseline"' in scoped
    assert 'href="/conditions/N_0_0"' in ask("/trials/o3/baseline/N_0_0/rep09").text


@pytest.mark.parametrize("address", ["/"])
def test_the_code_of_a_condition_says_itself_in_words_on_every_page(ask, address):
    text = ask(address).text
    (told,) = set(re.findall(r'title="([^"]*)"[^>]*>(?:<[^>]*>\s*)*R_-2_8[< ]', text)) or {None}
    assert told == "the right vehicle would be 2 m ahead at the merge point, and the left one is " \
        "0.8 m/s faster"  # fmt: skip


def test_a_condition_that_nobody_drove_is_not_there(ask):
    reply = ask("/conditions/nothing")
    assert reply.status_code == 404
    assert "there is no condition" in reply.text


def test_a_page_that_looks_for_news_gets_none_where_there_are_none(ask):
    text = ask("/conditions/N_0_0?model=o4").text
    news = html.unescape(re.search(r'hx-get="([^"]*seen=[^"]*)"', text)[1])
    assert "model=o4" in news
    assert ask(news).status_code == 204
    assert ask(news.replace("seen=", "seen=0")).status_code == 200


def test_a_click_on_a_trace_opens_its_trial_which_leads_back(browser, db):
    context = browser.new_context(viewport={"width": 1440, "height": 1000})
    page = context.new_page()
    with served(db) as address:
        page.goto(f"{address}/conditions/N_0_0")
        page.locator("select[name=variant]").select_option("baseline")
        page.get_by_role("button", name="Apply").click()
        expect(page.locator(".overlay a")).to_have_count(5)
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
    expect(page.locator(".overlay a")).to_have_count(7)
    expect(page.locator(".overlay .median")).to_have_count(3)
    page.goto(f"file://{files}/conditions-N_0_0.html")
    page.locator("path.collided").dispatch_event("click")
    expect(page.locator("h1")).to_have_text("o3/baseline/N_0_0/rep09")
