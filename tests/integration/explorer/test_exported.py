"""An exported study opens from the disk, with the network off; no secret leaves with it."""

from __future__ import annotations

import re
import shutil
from html.parser import HTMLParser
from urllib.parse import unquote, urlsplit

import duckdb
import pytest
from playwright.sync_api import expect

from merge_runner.config import ScenarioConfig
from merge_runner.errors import UsageError
from merge_runner_analysis.explorer.export import export_page
from tests.support.axe import serious
from tests.support.exporting import export, export_with_a_table

TRIAL = "emulator/baseline/N_0_0/rep01"


class References(HTMLParser):
    """What the attributes of a page refer to."""

    def __init__(self, text):
        super().__init__()
        self.found = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        names = {"href", "src", "action", "data-back", "data-others"}
        self.found += [v for name, v in attrs if name in names or name.startswith("hx-")]


def broken(page):
    """What a page refers to that is no file beside it; a picture in the page itself is there."""
    return [
        address
        for address in References(page.read_text()).found
        if not address.startswith("data:image/")
        and (
            (parts := urlsplit(address)).scheme
            or parts.netloc
            or not (page.parent / unquote(parts.path) if parts.path else page).is_file()
        )
    ]


@pytest.fixture(scope="session")
def exported(study, tmp_path_factory):
    """The study as a folder, elsewhere than it was written."""
    made = tmp_path_factory.mktemp("made") / "pages"
    export_with_a_table(study, made)
    assert {path.name for path in made.iterdir()} == {"index.html", "files"}
    return made.rename(made.with_name("moved"))


@pytest.mark.long
def test_a_folder_opens_from_the_disk_with_replay_and_decisions(page, exported):
    page.context.set_offline(True)
    page.goto(f"file://{exported}/index.html")
    expect(page.locator("h1")).to_have_text("The baseline prompt in all 11 conditions")
    expect(page.locator(".strip")).to_have_count(0)
    expect(page.locator("footer")).to_contain_text("Search, filters, SQL and new notes need")
    page.locator('a[href*="outcome-collided"]').first.click()
    expect(page.locator("tbody tr")).to_have_count(1)
    page.locator("tbody tr a").click()
    expect(page.get_by_text("The vehicles collided")).to_be_visible()
    start = page.locator("#track .own.left").get_attribute("transform")
    page.keyboard.press("]")
    page.keyboard.press("]")
    page.keyboard.press("]")
    expect(page.locator(".decision-panel h2")).to_contain_text("decision 1 at 1.0 s")
    expect(page.locator(".decision-panel .block").first).to_contain_text("You drive a car")
    assert page.locator("#track .own.left").get_attribute("transform") != start
    expect(page).to_have_url(re.compile("decision=1"))
    page.reload()
    expect(page.locator(".decision-panel h2")).to_contain_text("decision 1 at 1.0 s")
    expect(page.locator("#charts .chart")).to_have_count(3)
    expect(page.locator(".plan-values dd").first).to_be_visible()
    page.keyboard.press("Escape")
    expect(page.locator("#decision .decision-panel h2")).to_have_count(2)
    page.keyboard.press("Escape")
    page.wait_for_url("**/files/trials-*outcome-collided*.html")
    page.get_by_role("link", name="Trials", exact=True).click()
    expect(page.locator("h1")).to_have_text("Trials")
    page.wait_for_load_state()  # clicks are heard once the scripts have run
    page.locator("#found tbody a").first.click()
    expect(page.locator("#next-trial")).to_be_visible()
    first = page.locator("h1").inner_text()
    page.keyboard.press("j")
    expect(page.locator("h1")).not_to_have_text(first)
    page.get_by_role("link", name="Study").click()
    expect(page.locator("h1")).to_have_text("The baseline prompt in all 11 conditions")
    page.get_by_role("link", name="Tables and figures", exact=True).click()
    page.get_by_role("link", name="first-action").click()
    expect(page.locator("figure img")).to_be_visible()


def test_what_an_export_refers_to_lies_in_it_and_asks_no_server(exported):
    pages = [*exported.rglob("*.html")]
    names = {path.relative_to(exported).as_posix() for path in exported.rglob("*")}
    assert names > {
        *("index.html", "files/trials.html", "files/trials-emulator-baseline-N_0_0-rep01.html"),
        *("files/conditions-N_0_0.html", "files/tables-attempts.csv", "files/tables-attempts.tex"),
        *("files/figures-first-action.svg", "files/sweeps.html"),
    }
    assert {str(page): found for page in pages if (found := broken(page))} == {}
    assert len(pages) > 30
    scripts = {name.partition("static/")[2] for name in names if name.endswith(".js")}
    assert scripts.isdisjoint({"vendor/htmx-2.0.11.min.js", "notes.js", "filters.js", "sql.js"})
    assert "replay/start.js" in scripts
    assert not [page for page in pages if "<form" in page.read_text()]


def test_a_page_of_its_own_refers_to_nothing_but_itself(study, tmp_path):
    for name, wanted in (("one.html", TRIAL), ("several.html", "emulator/baseline/N_0_0/*")):
        page = export_page(study, tmp_path / name, [wanted])
        assert broken(page) == []
        text = page.read_text()
        assert {urlsplit(address).path for address in References(text).found} == {""}
        assert "trials like" not in text
        assert "the traces of" not in text


def test_a_page_of_its_own_leads_nowhere_else_and_is_accessible(page, study, tmp_path):
    file = export_page(study, tmp_path / "one two.html", ["emulator/baseline/N_0_0/*"])
    page.goto(f"file://{file}")
    expect(page.locator("#track")).to_be_visible()
    assert serious(page) == []
    expect(page.locator("header nav a")).to_have_count(0)
    page.keyboard.press("Escape")
    expect(page.locator("#track")).to_be_visible()


@pytest.mark.slow
def test_an_earlier_export_in_the_folder_goes_and_nothing_else(study, tmp_path):
    (tmp_path / "mine.html").write_text("<title>mine</title>")
    export(study, tmp_path, ["emulator/baseline/*"])
    assert (tmp_path / "files/trials-emulator-baseline-N_0_0-rep01.html").exists()
    export_page(study, tmp_path / "one.html", [TRIAL])
    export(study, tmp_path, ["emulator/baseline/L_4_0/*"])
    assert {path.name for path in tmp_path.iterdir()} == {
        *("index.html", "files", "mine.html", "one.html"),
    }
    trials = {path.name for path in tmp_path.glob("files/trials-*rep01.html")}
    assert trials == {"trials-emulator-baseline-L_4_0-rep01.html"}


@pytest.mark.parametrize("name", ["index.html", "files"])
def test_what_is_no_export_is_not_replaced(study, tmp_path, name):
    if name == "files":
        (tmp_path / name).mkdir()
    else:
        (tmp_path / name).write_text("<!DOCTYPE html>\n<html><title>mine</title>")
    with pytest.raises(
        UsageError, match=f"{name} is there, and is no exported study.*name another"
    ):
        export(study, tmp_path, [TRIAL])
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_a_secret_leaves_the_earlier_export_as_it_was(study, tmp_path, monkeypatch):
    folder = tmp_path / "pages"
    export(study, folder, [TRIAL])
    earlier = {path: path.read_bytes() for path in folder.rglob("*.html")}
    monkeypatch.setenv("MY_TOKEN", "You drive a car")
    with pytest.raises(UsageError, match="holds the value of MY_TOKEN"):
        export(study, folder, [TRIAL])
    assert {path: path.read_bytes() for path in folder.rglob("*.html")} == earlier
    assert [path.name for path in tmp_path.iterdir()] == ["pages"]


def test_of_too_many_trials_a_line_says_how_else_to_send_them(study, tmp_path, monkeypatch):
    monkeypatch.setattr("merge_runner_analysis.explorer.export.MOST", 3)
    told = "8 trials, .* for 3: .*--trials, or send study.duckdb .*view --db study.duckdb"
    with pytest.raises(UsageError, match=told):
        export(study, tmp_path / "pages")
    assert export(study, tmp_path / "pages", ["*/N_0_0/*"]).exists(), "humans do not count"


def test_what_a_model_wrote_is_text_there_too(page, exported):
    (file,) = exported.glob("files/trials-*b-o3-b-baseline-L_4_0-rep01.html")
    page.goto(f"file://{file}")
    page.locator("a.decision").first.click()
    expect(page.locator(".decision-panel")).to_contain_text("<script>document.title='owned'")
    assert "owned" not in page.title()


@pytest.mark.long
def test_a_page_of_few_trials_lists_them_and_shows_one(page, study, tmp_path):
    file = export_page(study, tmp_path / "one.html", ["*/N_0_0/*"])
    page.context.set_offline(True)
    page.goto(f"file://{file}")
    listed = page.get_by_label("Trials of this page").get_by_role("link")
    expect(listed).to_have_count(4)
    expect(page.locator("h1")).to_have_text(TRIAL)
    expect(listed.nth(0)).to_have_attribute("aria-current", "page")
    listed.nth(1).click()
    expect(page.locator("h1")).to_have_text("emulator/baseline/N_0_0/rep02")
    page.locator("a.decision").nth(1).click()
    expect(page.locator(".decision-panel .block").first).to_contain_text("You drive a car")


@pytest.mark.parametrize(
    ("said", "told"),
    [
        ("my-dummy-secret-key", "the value of OPENAI_API_KEY"),
        ("sk-proj-abcdefghijklmnop0123", "what looks like a key: sk-pro"),
        ("{cwd}/notes.txt", "names the path"),
        ("ghp_abcdefghijklmnopqrstuvwxyz0123456789", "what looks like a key: ghp_ab"),
        ("/home/somebody/notes.txt", "names the path /home/somebody/"),
    ],
)
def test_a_secret_or_a_path_in_a_reply_stops_the_export(study, tmp_path, monkeypatch, said, told):
    monkeypatch.setenv("OPENAI_API_KEY", "my-dummy-secret-key")
    monkeypatch.chdir(tmp_path)
    db = tmp_path / "study.duckdb"
    shutil.copy(study, db)
    with duckdb.connect(str(db)) as connection:
        connection.execute(
            "UPDATE decisions SET rationale = ? WHERE decision = 2", [said.format(cwd=tmp_path)]
        )
    with pytest.raises(UsageError, match=re.escape(told)):
        export(db, tmp_path / "pages", ["emulator/baseline/N_0_0/*"])
    assert not (tmp_path / "pages").exists()


def test_names_that_fit_no_trial_are_told(study, tmp_path):
    with pytest.raises(UsageError, match="holds no trial called o5/"):
        export_page(study, tmp_path / "one.html", ["o5/*"])


@pytest.mark.long
def test_a_plan_stands_in_figures_beside_its_picture(page, study, tmp_path):
    file = export_page(study, tmp_path / "one.html", ["emulator/baseline/N_0_0/*"])
    with duckdb.connect(str(study), read_only=True) as connection:
        (plan,) = connection.execute(
            "SELECT plan FROM decisions WHERE trial_id = 'emulator/baseline/N_0_0/rep01' "
            "AND side = 'left' AND decision = 0"
        ).fetchone()
    hardest = ScenarioConfig().max_acceleration_mps2
    for address in (f"file://{file}", "/trials/emulator/baseline/N_0_0/rep01"):
        page.goto(address)
        page.locator("a.decision[data-side=left]").first.click()
        said = page.locator(".plan-values dd").first.inner_text().split()
        assert said == [f"{value * hardest:+.2f}".replace("-", "−") for value in plan]
