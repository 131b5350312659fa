"""The study at a glance: what is there at once, what arrives, and where its numbers lead."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from html import unescape
from urllib.parse import parse_qs, urlsplit

import duckdb
import pytest
from playwright.sync_api import expect
from starlette.testclient import TestClient

from merge_runner.config import ScenarioConfig
from merge_runner.errors import UsageError
from merge_runner.scenarios.merge.collision import collided
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner_analysis.data.human_counts import human_counts
from merge_runner_analysis.data.reference_data import published
from merge_runner_analysis.data.study import Study
from merge_runner_analysis.explorer.analysis_process import Computing
from merge_runner_analysis.explorer.app import explorer
from merge_runner_analysis.explorer.assets import STATIC, STYLES
from merge_runner_analysis.explorer.pages.home import Played, account_rows, home_page
from merge_runner_analysis.explorer.site import NothingNew, Site
from merge_runner_analysis.explorer.task_picture import task_picture
from merge_runner_analysis.figures import SHOWS
from merge_runner_analysis.figures.gallery import FIGURES as DRAWN
from merge_runner_analysis.figures.styles import COLOURS
from merge_runner_analysis.metrics import shown_in
from merge_runner_analysis.table_format import TableFormat
from merge_runner_analysis.tables import make_tables
from merge_runner_analysis.tables.formats import render
from tests.analysis.studies import Said, write_study, yielding
from tests.explorer.serving import served
from tests.explorer.test_charts import import_some
from tests.explorer.test_tables_pages import Addresses, Awaited, InProcess, listed

HOST = "127.0.0.1:8700"
WORST = "L_0_-8"


class Never(InProcess):
    """A computation that never comes to anything."""

    def answer(self, request):
        raise UsageError("not now")


@pytest.fixture(scope="module")
def db(tmp_path_factory):
    """o3 and a variant of it, which collide in two conditions; one trial is lost."""
    drives = []
    for drive in [*yielding("o3"), *yielding("o3", "A1", reps=1)]:
        crash = drive.condition == WORST or (drive.condition == "N_0_0" and drive.rep == 1)
        said = {1: Said(("timeout",), lost=True)} if drive.condition == "R_0_8" else {}
        straight = {"left": (0.0,), "right": (0.0,)} if crash else {}
        drives.append(replace(drive, said=said if drive.rep == 2 else {}, **straight))
    return write_study(tmp_path_factory.mktemp("home") / "study.duckdb", drives)


@pytest.fixture(scope="module")
def own(db):
    site = Site(db)
    site.computing = Awaited(db, InProcess)
    site.catalogue.refresh()
    yield site
    site.computing.close()


def client_of(site):
    return TestClient(explorer(site), base_url=f"http://{HOST}")


@pytest.fixture(scope="module")
def client(own):
    return client_of(own)


def test_counts_are_there_before_anything_is_computed_and_lead_to_their_trials(db):
    site = Site(db)
    site.computing = Computing(db, Never)
    client = client_of(site)
    text = unescape(client.get("/").text)
    with duckdb.connect(str(db), read_only=True) as connection:
        counts = dict(
            connection.execute(
                "SELECT condition, count(*) FROM trials WHERE status = 'collided' GROUP BY ALL"
            ).fetchall()
        )
    assert counts == {WORST: 4, "N_0_0": 2}
    assert f"<strong>{WORST}</strong>: 4 of 4 trials (100.0 %) of all drivers" in text
    table = text.split('id="collisions"')[1].split("</table>")[0]
    rows = re.findall(r'<th scope="row"[^>]*>(?:<a[^>]*>)?([^<]+)', table)
    assert rows[:2] == [WORST, "N_0_0"]
    links = re.findall(r'<a href="(/trials\?[^"]*)">(\d+)</a>', table + text.split('id="costs"')[1])
    assert len(links) > 40
    for link, count in links:
        assert listed(client.get(link).text) == int(count), link
    site.computing.close()


@pytest.mark.slow
def test_points_verdicts_and_values_lead_to_their_trials(client):
    text = unescape(client.get("/").text)
    point = re.search(r'<a href="([^"]+)"[^>]*aria-label="o3, baseline, L_4_0: 100[^"]*n 3"', text)
    assert point, text
    assert listed(client.get(point[1]).text) == 3
    verdict = re.search(r'<a href="([^"]+)" aria-label="I1 of o3: (.)"', text)
    assert verdict[2] in "✓✗–"
    assert parse_qs(urlsplit(verdict[1]).query)["cell"] == ["indicators/o3/baseline/I1:n"]
    assert re.search(r"humans pass: \d+ %", text)
    assert "What to keep in mind" in text
    assert Addresses(text).inline == []


def test_a_study_is_grouped_by_any_of_its_factors(client, own):
    text = client.get("/?by=prompt").text
    assert '<strong aria-current="true">prompt</strong>' in text
    heads = text.split('id="collisions"')[1].split("</thead>")[0]
    assert [name.strip() for name in re.findall(r'<th scope="col">([^<]+)', heads)][2:] == [
        "humans",
        "all drivers",
        "A1",
        "baseline",
    ]
    classes = text.split('id="accounts"')[1].split("</table>")[0]
    assert re.findall(r'"number">([^<]+)</th>', classes)[2:] == ["A1", "baseline"]
    links = re.findall(r'<a href="([^"]+variant=baseline[^"]*)">(\d+)</a>', classes)
    assert links
    assert [listed(client.get(unescape(link)).text) for link, _ in links] == [
        int(count) for _, count in links
    ]
    assert "grouped by driver and prompt, prompt" in client.get("/?by=mood").text
    groups = [g["id"] for g in own.computing.ask(("home", "prompt", "0"), (0, 0), wait_s=60)
              .content["groups"]]  # fmt: skip
    assert groups == ["human", "prompt=baseline", "prompt=A1"]
    point = re.search(
        r'<a href="([^"]+)"[^>]*aria-label="A1, L_4_0:', client.get("/?by=prompt").text
    )
    assert listed(client.get(unescape(point[1])).text) == 1


def test_levels_of_a_factor_are_groups_with_their_trials(played):
    site = Site(played.db)
    site.computing = Computing(played.db, Never)
    client = client_of(site)
    costs = unescape(client.get("/?by=temperature").text).split('id="costs"')[1]
    links = re.findall(r'<a href="(/trials\?[^"]*factor.temperature=[^"]*)">(\d+)</a>', costs)
    assert len(links) >= 2
    for link, count in links:
        assert listed(client.get(link).text) == int(count)
    site.computing.close()


def test_human_counts_are_the_published_ones_and_lead_on_only_when_all_are_imported(
    db, tmp_path, client
):
    assert sum(of.collided for of in human_counts().values()) == 28
    outcomes = published("human_outcomes").set_index("condition")
    for name, of in human_counts().items():
        assert tuple(outcomes.loc[name, list(of._fields)]) == of
    assert "who=humans" not in client.get("/").text
    part = shutil.copy(db, tmp_path / "part.duckdb")
    import_some(part, tmp_path / "recordings")
    site = Site(part)
    site.computing = Computing(part, Never)
    text = client_of(site).get("/").text
    assert "who=humans" not in text
    # Nor do they join the drivers' counts.
    assert "4 of 4 trials (100.0 %) of all drivers" in text
    site.computing.close()


def test_the_strip_says_what_to_type_and_nothing_twice(db, tmp_path):
    copy = shutil.copy(db, tmp_path / "study.duckdb")
    with duckdb.connect(copy) as connection:
        connection.execute("UPDATE sweeps SET ended_at = started_at, exit_code = 3")
    site = Site(tmp_path / "study.duckdb", program="/opt/bin/merge-runner")
    site.computing = Computing(copy, Never)
    client = client_of(site)
    text = client.get("/").text
    assert "Stopped: the account" in text
    assert "<code>/opt/bin/merge-runner sweep test --model" in text
    (again,) = re.findall(r'hx-get="(/\?seen=[^"]+)"', text)
    assert client.get(again).status_code == 204
    with pytest.raises(NothingNew):
        home_page(site, {"seen": again.partition("=")[2]})
    with duckdb.connect(copy) as connection:
        connection.execute("UPDATE sweeps SET exit_code = 0")
    assert (
        "the database holds only" in client.get(again).text or "Finished" in client.get(again).text
    )
    site.computing.close()


def test_a_driver_that_is_not_judged_ranks_no_condition(tmp_path):
    prose = dict.fromkeys(range(99), Said(failure="no_array"))
    bad = [replace(drive, said=prose, left=(), right=()) for drive in yielding("bad", reps=1)]
    pages = []
    for drives in (bad, [*bad, *yielding("o3", reps=1)]):
        site = Site(db := write_study(tmp_path / f"{len(drives)}.duckdb", drives))
        site.computing = Computing(db, Never)
        site.catalogue.refresh()
        pages.append(client_of(site).get("/").text)
        site.computing.close()
    alone, beside = pages
    reason = (
        "not judged: 46 of the 92 decisions of bad, baseline are invalid (50.0 %, more than 20 %)"
    )
    assert f"<p>{reason}.</p>" in alone
    assert 'id="collisions"' not in alone
    assert "No trial of o3, baseline collided." in beside
    assert f'title="{reason}">not judged</span>' in beside


def test_the_study_begins_with_its_description(tmp_path):
    config = {"description": "Who is <first>?"}
    db = write_study(tmp_path / "t.duckdb", yielding("o3", reps=1)[:1], config=config)
    site = Site(db)
    site.computing = Computing(db, Never)
    assert "<h1>Who is &lt;first&gt;?</h1>" in client_of(site).get("/").text
    site.computing.close()


def test_classes_of_collisions_stand_beside_the_published_ones():
    published = {"humans": {"same action": 14, "no action": 5, "other": 4}}
    o3, unjudged, stand_in = (
        Played(label, "drivers", {}, cells={account: {"trials": 1}})
        for label, account in (("o3", "both gave way"), ("o4", None), ("o5", "invalid plan"))
    )
    rows = account_rows([o3, unjudged, stand_in], published)
    assert rows["classes"] == [
        *("both insisted", "both gave way", "no action", "other", "invalid plan")
    ]
    assert (rows["same"], rows["groups"]) == ({"humans": 14}, [o3, stand_in])
    assert account_rows([unjudged], published) is None


def test_the_picture_of_the_task_shows_a_moment_before_the_merge(own):
    task = task_picture(own.catalogue)
    left, right = task["vehicles"]
    assert task["condition"] == "L_4_0"
    assert left["x"] > right["x"]
    assert left["y"] < 0 < right["y"]
    for one in (left, right):
        assert TRACK.tunnel_exit_m * TRACK.branch_cosine < one["x"] < task["merge_m"]
    assert not collided(ScenarioConfig(), TRACK, left["x"], right["x"])


def of_longer_vehicles(db, folder, whose):
    """The study with longer vehicles in these trials."""
    with duckdb.connect(shutil.copy(db, folder / "longer.duckdb")) as connection:
        connection.execute(
            f"UPDATE specs SET spec = json_merge_patch(spec, ?) WHERE {whose}",
            [json.dumps({"scenario": {"vehicle_length_m": 6}})],
        )
    site = Site(folder / "longer.duckdb")
    site.computing = Computing(site.db, Never)
    return site


def test_the_picture_shows_the_studys_own_vehicles(db, tmp_path):
    site = of_longer_vehicles(db, tmp_path, "true")
    text = client_of(site).get("/").text
    assert "50 m before the merge point" in text
    assert task_picture(site.catalogue)["length_m"] == 6
    assert text.count('width="6.0" height="1.8"') == 2
    assert "the commonest" not in text
    site.close()


def test_of_several_sizes_the_commonest_is_shown_and_the_page_says_so(db, tmp_path):
    site = of_longer_vehicles(db, tmp_path, "spec_hash LIKE '%A1'")
    text = client_of(site).get("/").text
    assert text.count('width="4.5" height="1.8"') == 2
    assert "The vehicles have the commonest of 2 sizes, that of 33 of 44" in text
    site.close()


@pytest.mark.parametrize(("suffix", "form"), [("csv", TableFormat.CSV), ("tex", TableFormat.LATEX)])
def test_a_table_comes_as_a_file(client, db, suffix, form):
    reply = client.get(f"/tables/attempts.{suffix}")
    assert reply.text == render(make_tables(Study(db), ["attempts"]), form) + "\n"
    assert f'filename="attempts.{suffix}"' in reply.headers["content-disposition"]
    assert f'href="/tables/attempts.{suffix}" download' in client.get("/tables/attempts").text
    assert client.get("/tables/attempts.exe").status_code == 404
    assert client.get(f"/tables/nothing.{suffix}").status_code == 404


@pytest.mark.slow
def test_every_figure_is_offered_and_comes_as_svg(client):
    assert list(SHOWS) == list(DRAWN)
    assert set(re.findall(r'href="/figures/([^"]+)\.svg"', client.get("/tables").text)) == set(
        DRAWN
    )
    reply = client.get("/figures/ablation-matrix.svg")
    assert reply.headers["content-type"].startswith("image/svg+xml")
    assert "</svg>" in reply.text
    assert "sandbox" in reply.headers["content-security-policy"]
    assert client.get("/figures/nothing.svg").status_code == 404


def test_no_head_of_a_table_is_empty(client):
    heads = re.findall(r"<th scope=\"col\"[^>]*>(.*?)</th>", client.get("/tables/indicators").text)
    assert heads
    assert all(re.sub("<[^>]*>", "", head).strip() for head in heads)


def test_heads_sort_and_the_address_keeps_it(page):
    page.goto("/tables")
    page.goto("/")
    # What is computed comes into the page, whose rows are sorted anew a moment later.
    expect(page.locator(".computing")).to_have_count(0)
    column = page.locator("#costs tbody td:nth-child(2)")
    page.locator("#costs thead").get_by_role("button", name="trials").click()
    down = [int(text) for text in column.all_inner_texts()]
    assert down == sorted(down, reverse=True)
    assert len(set(down)) > 1
    expect(page.locator("#costs th[aria-sort=descending]")).to_have_text("trials")
    expect(page).to_have_url(re.compile("sorted=-costs.1"))
    page.reload()
    expect(column).to_have_text(list(map(str, down)))
    page.locator("#costs thead").get_by_role("button", name="trials").click()
    expect(column).to_have_text(list(map(str, sorted(down))))
    expect(page).to_have_url(re.compile("sorted=costs.1"))
    page.context.grant_permissions(["clipboard-read", "clipboard-write"])
    page.locator("#copy-link").click()
    expect(page.locator("#copy-link")).to_have_text("copied")
    assert page.evaluate("navigator.clipboard.readText()") == page.url


def test_every_measure_of_the_ablations_is_explained_above_them(client):
    above = unescape(client.get("/ablations").text.split("<table")[0])
    for metric in shown_in("tables"):
        assert f"<strong>{metric.heading}</strong>: {metric.meaning}" in above


def test_the_colours_of_drivers_are_those_of_the_figures():
    styles = (STATIC / "styles/colours.css").read_text()
    light, _, _ = styles.partition("@media")
    assert re.findall(r"--tint-\d: (#\w+);", light) == list(COLOURS)
    used = (STATIC / "styles/tables.css").read_text()
    assert re.findall(r"\.tint-(\d) ", used) == [str(i) for i in range(len(COLOURS))]


def test_captions_of_all_tables_have_one_rule():
    rules = [
        name
        for name in STYLES
        for _ in re.findall(r"(?:^|\} )caption \{", (STATIC / name).read_text(), re.MULTILINE)
    ]
    assert rules == ["styles/base.css"]


@pytest.mark.long
def test_ablations_are_whole_at_1024_pixels_and_numbers_look_like_links(browser, db):
    with served(db) as address:
        page = browser.new_page(viewport={"width": 1024, "height": 800})
        page.goto(f"{address}/ablations")
        table = page.locator("table.ablations")
        expect(table).to_be_visible()
        assert page.eval_on_selector(".scroll", "e => e.scrollWidth <= e.clientWidth")
        page.goto(f"{address}/tables/attempts")
        number = page.locator("table.of-report td a").first
        looks = "e => [getComputedStyle(e).color, getComputedStyle(e).textDecorationStyle]"
        assert number.evaluate(looks) == page.locator("main p a").first.evaluate(looks)
        assert number.evaluate(looks)[1] == "solid"
        page.close()


@pytest.mark.long
def test_nothing_is_cut_off_at_1024_pixels(page):
    page.set_viewport_size({"width": 1024, "height": 800})
    page.goto("/")
    expect(page.locator(".multiples").first).to_be_visible()
    expect(page.locator(".computing")).to_have_count(0)
    cut = page.eval_on_selector_all(
        ".multiples, .multiples svg, .scroll table, main",
        "all => all.filter(e => e.getBoundingClientRect().right > innerWidth)"
        ".map(e => e.id || e.tagName)",
    )
    assert cut == []
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
