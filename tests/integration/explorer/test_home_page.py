"""The study at a glance: what is there at once, what arrives, and where its numbers lead."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from dataclasses import replace
from html import unescape

import duckdb
import pytest
from playwright.sync_api import expect
from starlette.testclient import TestClient

from merge_runner.errors import UsageError
from merge_runner.results.store import results_digest
from merge_runner_analysis.data.study import Study
from merge_runner_analysis.explorer.app import explorer
from merge_runner_analysis.explorer.computing import Computing
from merge_runner_analysis.explorer.site import STATIC, STYLES, Site
from merge_runner_analysis.figures import FIGURES
from merge_runner_analysis.figures.gallery import MAKERS
from merge_runner_analysis.names import TableFormat
from merge_runner_analysis.tables import make_tables
from merge_runner_analysis.tables.formats import render
from merge_runner_analysis.verdict_words import (
    MEASURES,
    by_group,
    headline,
    sentence,
    verdict_word,
)
from tests.integration.explorer.test_tables_pages import Addresses, Awaited, InProcess, listed
from tests.support.serving import served
from tests.support.studies import Said, write_study, yielding

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
    config = {"typed": ["sweep", "test"]}
    return write_study(tmp_path_factory.mktemp("home") / "study.duckdb", drives, config=config)


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


def test_trials_are_counted_before_anything_is_computed_and_lead_to_them(db):
    site = Site(db)
    site.computing = Computing(db, Never)
    client = client_of(site)
    text = unescape(client.get("/").text)
    assert "This could not be computed" in text
    links = re.findall(r'<a href="(/trials\?[^"]*)">(\d+)</a>', text)
    assert len(links) >= 3
    for link, count in links:
        assert listed(client.get(link).text) == int(count), link
    site.computing.close()


@pytest.fixture(scope="module")
def verdicts(db):
    (table,) = make_tables(Study(db), ["verdicts"])
    return by_group(table.rows)


def test_a_row_has_the_sentence_and_the_values_of_the_table(client, verdicts):
    text = unescape(client.get("/").text)
    assert " ".join(headline({"o3": verdicts["o3/baseline"]})) in re.sub(r"</?strong>", "", text)
    assert sentence(verdicts["o3/baseline"]) in text
    assert sentence(verdicts["o3/A1"]) not in text
    assert "Not shown: 1 other prompt." in text
    cells = re.findall(r'href="/drivers/o3\?variant=baseline#([\w-]+)"\s+title="([^"]+)"', text)
    told = dict(cells)
    for name in ("velocity", "collisions", "gap"):  # so few trials have no slope on headway
        values = verdicts["o3/baseline"][name]
        assert f"n = {values['n']}" in told[name]
        assert verdict_word(values) in told[name]
    assert Addresses(text).inline == []


def test_the_scope_is_in_the_address_and_every_number_obeys_it(client, db):
    text = unescape(client.get("/?variant=A1").text)
    assert '<option value="A1" selected>' in text
    assert "/drivers/o3?variant=A1" in text
    assert "/drivers/o3?variant=baseline" not in text
    one = unescape(client.get(f"/?condition={WORST}").text)
    (link,) = set(re.findall(r'href="(/trials\?[^"]*variant=baseline[^"]*)">3</a>', one)) - set(
        re.findall(r'href="(/trials\?[^"]*outcome[^"]*)"', one)
    )
    assert listed(client.get(link).text) == 3
    (part,) = make_tables(Study(db, condition=WORST), ["verdicts"])
    rows = by_group(part.rows)
    collisions = rows["o3/baseline"]["collisions"]
    assert collisions["n"] + (collisions["undecided"] or 0) == 3
    assert rows["human"]["collisions"]["n"] == 90
    for wrong in ("variant=A9", "condition=nowhere", "sweep=none", "model=nobody"):
        assert client.get(f"/?{wrong}").status_code == 404, wrong


def test_links_take_the_scope_to_every_page(client):
    part = f"variant=baseline&condition={WORST}"
    for page in ("/", "/drivers", "/trials", "/words", "/prompts", "/sweeps", "/sql"):
        text = unescape(client.get(f"{page}?{part}").text)
        assert re.search(f'<option value="{WORST}"[^>]* selected', text), page
        for other in ("/drivers", "/trials", "/words", "/prompts", "/sweeps", "/sql"):
            assert f'href="{other}?{part}"' in text, (page, other)
    assert f"condition in ('{WORST}')" in unescape(client.get(f"/sql?{part}").text)
    runs = client.get(f"/sweeps?{part}").text
    assert listed(client.get(f"/trials?{part}&sweep=sweep-1").text) == 3
    assert re.search(r"all runs together</th><td class=\"n\">3</td>", runs)


def test_a_number_has_a_true_minus_sign_on_pages(client):
    for page in ("/", "/drivers/o3?variant=baseline", "/tables/verdicts", "/tables/gap"):
        shown = re.sub(r"<(script|svg).*?</\1>|<[^>]*>", " ", client.get(page).text, flags=re.S)
        assert not re.search(r"(?<![\w-])-\d+\.\d", shown), page
        assert re.search(r"−\d", shown), page


def test_a_sweep_is_a_scope(db):
    study = Study(db, sweep="sweep-1")
    assert sum(len(group.trials) for group in study.played) == 44
    assert Study(db, sweep="none").played == []


def test_a_drivers_page_has_its_verdicts_with_the_trials_behind_them(client, verdicts):
    text = unescape(client.get("/drivers/o3?variant=baseline").text)
    assert sentence(verdicts["o3/baseline"]) in text
    table = text.split('class="verdicts ')[1].split("</table>")[0]
    for measure in MEASURES.values():
        assert measure.trait in table
    (link, n) = re.findall(r'<a href="([^"]*cell=verdicts[^"]*)">(\d+)</a>', table)[0]
    assert listed(client.get(link).text) == int(n) == verdicts["o3/baseline"]["headway"]["n"]
    for link, count in re.findall(r'<a href="(/trials\?[^"]*)">(\d+)</a>', text):
        assert listed(client.get(link).text) == int(count), link
    assert client.get("/drivers/nobody").status_code == 404
    assert "990 trials" in client.get("/drivers/human").text


def test_the_explorer_begins_without_the_libraries_of_the_statistics():
    """They would hold up the first page by a second; the worker imports them beside it."""
    code = "import sys, merge_runner_analysis.explorer.app; sys.exit('scipy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_a_driver_stands_beside_another(tmp_path):
    drives = [*yielding("o3", reps=2), *yielding("o4", reps=2)]
    site = Site(db := write_study(tmp_path / "t.duckdb", drives))
    site.computing = Awaited(db, InProcess)
    text = client_of(site).get("/drivers/o3?with=o4").text
    assert "<option selected>o4</option>" in text
    verdicts, _, by_condition = text.partition("In the conditions")
    drawn = re.findall(r'class="o" href="#(\w+)" x="([\d.]+)%"', verdicts)
    assert {shape for shape, _ in drawn} == {"other", "beyond"}
    assert ("beyond", "100.0") in drawn  # outside its axis it is an arrow, and no value at the end
    assert ("other", "100.0") not in drawn
    left_first = re.search(r"Left goes first <small>.*?</tr>", by_condition, re.DOTALL)[0]
    with duckdb.connect(str(db), read_only=True) as connection:
        shares = connection.execute(
            "SELECT round(100 * avg((merged_first = 'left')::INT), 2) FROM trials "
            "WHERE model_left = 'o3' AND merged_first IS NOT NULL GROUP BY condition"
        ).fetchall()
    marks = re.findall(r'class="d" href="#plain" x="([\d.]+)%"', left_first)
    assert sorted(map(float, marks)) == sorted(share for (share,) in shares)
    assert left_first.count('class="band"') == len(marks) == left_first.count('href="#other"')
    assert client_of(site).get("/drivers").text.count('href="/trials?') == 2
    site.computing.close()


def test_a_driver_that_is_not_judged_has_no_verdict(tmp_path):
    prose = dict.fromkeys(range(99), Said(failure="no_array"))
    bad = [replace(drive, said=prose, left=(), right=()) for drive in yielding("bad", reps=1)]
    site = Site(db := write_study(tmp_path / "t.duckdb", [*bad, *yielding("o3", reps=1)]))
    site.computing = Awaited(db, InProcess)
    text = client_of(site).get("/").text
    assert "Not judged: 46 of the 92 decisions of bad are invalid (50.0 %, more than 20 %)." in text
    assert "/drivers/bad?variant=baseline#" not in text
    assert "/drivers/o3?variant=baseline#" in text
    assert "Not judged" in client_of(site).get("/drivers/bad").text
    site.computing.close()


def test_missing_decisions_are_counted_and_lead_to_their_trials(tmp_path):
    missing = dict.fromkeys(range(2), Said(failure="no_decision"))
    every = enumerate(yielding("o3", reps=1))
    drives = [replace(drive, said=missing if n < 3 else {}) for n, drive in every]
    site = Site(db := write_study(tmp_path / "t.duckdb", drives))
    site.computing = Awaited(db, InProcess)
    client = client_of(site)
    text = client.get("/").text
    assert "100.0 %" in text
    ((url, count),) = re.findall(
        r'<a href="([^"]+)">(\d+)</a>\s+without the decision asked for', text
    )
    assert count == "6"
    assert client.get(unescape(url)).text.count("rep01</a>") == 3
    assert "Without the decision asked for" in client.get("/drivers/o3?variant=baseline").text
    assert "missing decisions" in client.get("/sweeps/sweep-1").text
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
    assert "<code>/opt/bin/merge-runner sweep test</code>" in text
    (again,) = re.findall(r'hx-get="(/\?seen=[^"]+)"', text)
    assert client.get(again).status_code == 204
    with duckdb.connect(copy) as connection:
        connection.execute("UPDATE sweeps SET exit_code = 0")
    assert (
        "the database holds only" in client.get(again).text or "Finished" in client.get(again).text
    )
    site.computing.close()


def test_the_study_begins_with_its_description(tmp_path):
    config = {"description": "Who is <first>?"}
    db = write_study(tmp_path / "t.duckdb", yielding("o3", reps=1)[:1], config=config)
    site = Site(db)
    site.computing = Computing(db, Never)
    assert "<h1>Who is &lt;first&gt;?</h1>" in client_of(site).get("/").text
    site.computing.close()


@pytest.mark.parametrize(("suffix", "form"), [("csv", TableFormat.CSV), ("tex", TableFormat.LATEX)])
def test_a_table_comes_as_a_file(client, db, suffix, form):
    reply = client.get(f"/tables/attempts.{suffix}")
    assert reply.text == render(make_tables(Study(db), ["attempts"]), form) + "\n"
    assert f'filename="attempts.{suffix}"' in reply.headers["content-disposition"]
    assert f'href="/tables/attempts.{suffix}" download' in client.get("/tables/attempts").text
    assert client.get("/tables/attempts.exe").status_code == 404
    assert client.get(f"/tables/nothing.{suffix}").status_code == 404


@pytest.mark.slow
def test_every_figure_is_offered_and_comes_as_svg(client, db):
    assert list(FIGURES) == list(MAKERS)
    assert set(re.findall(r'href="/figures/([^"]+)\.svg"', client.get("/tables").text)) == set(
        MAKERS
    )
    reply = client.get("/figures/first-action.svg")
    assert reply.headers["content-type"].startswith("image/svg+xml")
    assert "</svg>" in reply.text
    policy = reply.headers["content-security-policy"]
    assert "style-src 'unsafe-inline'; img-src data:; sandbox" in policy
    assert client.get("/figures/first-action.png").content.startswith(b"\x89PNG")
    assert client.get("/figures/nothing.svg").status_code == 404
    page = client.get("/figures/first-action").text
    assert 'src="data:image/svg+xml;base64,' in page
    assert 'href="/tables/first-action.csv" download' in page
    assert f"<code>{results_digest(db)[0]}</code>" in page
    assert "arXiv:2604.09609" in page


def test_no_head_of_a_table_is_empty(client):
    heads = re.findall(r"<th scope=\"col\"[^>]*>(.*?)</th>", client.get("/tables/indicators").text)
    assert heads
    assert all(re.sub("<[^>]*>", "", head).strip() for head in heads)


def test_captions_of_all_tables_have_one_rule():
    rules = [
        name
        for name in STYLES
        for _ in re.findall(r"(?:^|\} )caption \{", (STATIC / name).read_text(), re.MULTILINE)
    ]
    assert rules == ["styles/base.css"]


@pytest.mark.long
def test_the_numbers_of_a_table_look_like_links(browser, db):
    with served(db) as address:
        page = browser.new_page(viewport={"width": 1024, "height": 800})
        page.goto(f"{address}/tables/attempts")
        number = page.locator("#content td a").first
        looks = "e => [getComputedStyle(e).color, getComputedStyle(e).textDecorationStyle]"
        assert number.evaluate(looks) == page.locator("main p a").first.evaluate(looks)
        assert number.evaluate(looks)[1] == "solid"
        page.close()


@pytest.mark.long
def test_nothing_is_cut_off_at_1024_pixels(page):
    page.set_viewport_size({"width": 1024, "height": 800})
    page.goto("/")
    expect(page.locator("tr.humans").first).to_be_visible()
    expect(page.locator(".computing")).to_have_count(0)
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
