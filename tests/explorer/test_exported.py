"""An exported study opens from the disk, with the network off; no secret leaves with it."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import duckdb
import pytest
from playwright.sync_api import expect

from analysis.explorer.export import export_folder, export_page
from merge_runner.config import ScenarioConfig
from merge_runner.errors import UsageError
from tests.explorer.axe import serious
from tests.explorer.packed import export_with_a_table


@pytest.fixture(scope="session")
def exported(study, tmp_path_factory):
    """The study as a folder, elsewhere than it was written."""
    made = tmp_path_factory.mktemp("made") / "pages"
    written = export_with_a_table(study, made)
    assert {path.name for path in written} >= {"index.html", "trials.html", "trials-N_0_0.html"}
    return made.rename(made.with_name("moved"))


@pytest.mark.long
def test_a_folder_opens_from_the_disk_with_replay_and_decisions(page, exported):
    page.context.set_offline(True)
    page.goto(f"file://{exported}/index.html")
    expect(page.locator("h1")).to_have_text("The baseline prompt in all 11 conditions")
    expect(page.locator(".strip")).to_have_count(0)
    page.locator("#played").get_by_role("link", name="Watch it").click()
    expect(page.get_by_label("outcome")).to_have_value("collided")
    expect(page.locator("tbody tr:visible")).to_have_count(1)
    page.locator("tbody tr:visible a").click()
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
    page.get_by_role("button", name="next repetition").click()
    expect(page.locator("#ghost-key")).to_contain_text("dashed")
    expect(page.locator("#decision .decision-panel h2")).to_have_count(1)
    page.keyboard.press("Escape")
    expect(page.locator("#decision .decision-panel h2")).to_have_count(4)
    page.locator("#compare").fill("human")
    page.locator("#others button").click()
    expect(page.locator("#ghost-key")).to_contain_text("human P1")
    page.keyboard.press("Escape")
    page.wait_for_url("**/trials.html?*outcome=collided")
    expect(page.locator("tr.chosen")).to_contain_text("rep03")
    page.goto(f"file://{exported}/trials.html?sweep=hostile")
    expect(page.locator("tbody tr:visible")).to_have_count(3)


def test_a_number_of_a_table_leads_to_its_trials(page, exported, study):
    with duckdb.connect(str(study), read_only=True) as connection:
        (row,) = connection.execute(
            "SELECT count(DISTINCT trial_id), count(*) FROM calls WHERE trial_id LIKE 'emulator/%'"
        ).fetchall()
    page.goto(f"file://{exported}/table-attempts.html")
    line = page.locator("tbody tr", has_text="emulator")
    line.get_by_role("link", name=str(row[1]), exact=True).first.click()
    expect(page.locator("#behind")).to_contain_text("The trials behind attempts/emulator")
    expect(page.locator("tbody tr:visible")).to_have_count(row[0])
    page.get_by_label("outcome").select_option("collided")
    expect(page.locator("tbody tr:visible")).to_have_count(1)
    page.reload()
    expect(page.locator("tbody tr:visible")).to_have_count(1)
    page.get_by_role("link", name="Show all").click()
    expect(page.locator("#behind")).to_be_hidden()


def test_no_link_of_an_export_leads_nowhere(page, exported):
    there = {path.name for path in exported.iterdir()}
    assert {"table-attempts.csv", "table-attempts.tex"} <= there
    for name in sorted(name for name in there if name.endswith(".html")):
        page.goto(f"file://{exported}/{name}")
        if name.startswith("trials-"):
            expect(page.locator("#track")).to_be_visible()
        addresses = page.eval_on_selector_all(
            "a[href]", "links => links.map(a => a.getAttribute('href'))"
        )
        files = {address.partition("?")[0].partition("#")[0] for address in addresses}
        of_tables = {file for file in files if file.startswith("table-")}
        assert files - {""} - of_tables <= there, name
        assert "" not in addresses, name


@pytest.mark.long
def test_figures_stand_beside_the_list_of_tables(page, exported):
    page.goto(f"file://{exported}/tables.html")
    page.get_by_role("link", name="ablation-matrix").click()
    expect(page.locator("svg")).to_be_visible()
    assert {path.name for path in exported.glob("*.svg")} == {"ablation-matrix.svg"}


def test_a_page_has_the_scripts_that_it_needs_alone(exported):
    traced = {path.name for path in exported.glob("*.html") if "#drawn" in path.read_text()}
    chosen = {path.name for path in exported.glob("*.html") if '"drawn"' in path.read_text()}
    assert traced | chosen == {path.name for path in exported.glob("condition-*.html")}


def test_a_page_of_its_own_leads_nowhere_else_and_is_accessible(page, study, tmp_path):
    file = tmp_path / "one two.html"
    list(export_page(study, file, ["emulator/baseline/N_0_0/*"]))
    page.goto(f"file://{file}")
    expect(page.locator("#track")).to_be_visible()
    assert serious(page) == []
    expect(page.locator("header nav a")).to_have_count(0)
    addresses = page.eval_on_selector_all(
        "a[href]", "links => links.map(a => a.getAttribute('href'))"
    )
    assert {address.partition("?")[0] for address in addresses} <= {"#main", "one%20two.html"}
    page.keyboard.press("Escape")
    expect(page.locator("#track")).to_be_visible()


@pytest.mark.slow
def test_an_earlier_export_in_the_folder_goes_and_nothing_else(study, tmp_path):
    (tmp_path / "mine.html").write_text("<title>mine</title>")
    list(export_folder(study, tmp_path, ["emulator/baseline/*"]))
    assert (tmp_path / "trials-N_0_0.html").exists()
    list(export_page(study, tmp_path / "one.html", ["emulator/baseline/N_0_0/rep01"]))
    list(export_folder(study, tmp_path, ["emulator/baseline/L_4_0/*"]))
    assert {path.name for path in tmp_path.iterdir()} == {
        *("index.html", "mine.html", "one.html", "trials.html", "trials-L_4_0.html"),
        *("notes.html", "notes.csv", "words.html"),
    }


@pytest.mark.slow
def test_packed_trials_are_not_taken_for_paths(study, tmp_path, monkeypatch):
    file = tmp_path / "one.html"
    list(export_page(study, file, ["emulator/baseline/N_0_0/*"]))
    before, packed = file.read_text(encoding="utf-8").split('id="bundle">')
    packed, after = packed.split("</script>", 1)
    found = re.findall(r"/[A-Za-z0-9+]{1,3}/", packed)
    spelt = next(path for path in found if path not in before + after)
    monkeypatch.setattr("analysis.explorer.export.Path.home", lambda: Path(spelt))
    assert list(export_page(study, file, ["emulator/baseline/N_0_0/*"])) == [file]


def test_what_a_model_wrote_is_text_there_too(page, exported):
    page.goto(f"file://{exported}/trials-L_4_0.html?trial=<b>o3</b>/baseline/L_4_0/rep01")
    page.locator("a.decision").first.click()
    expect(page.locator(".decision-panel")).to_contain_text("<script>document.title='owned'")
    assert "owned" not in page.title()


@pytest.mark.long
def test_a_page_of_few_trials_lists_them(page, study, tmp_path):
    file = tmp_path / "one.html"
    assert list(export_page(study, file, ["emulator/baseline/N_0_0/*"])) == [file]
    page.goto(f"file://{file}")
    listed = page.get_by_label("Trials of this page").get_by_role("link")
    expect(listed).to_have_count(3)
    expect(page.locator("h1")).to_have_text("emulator/baseline/N_0_0/rep01")
    expect(listed.nth(0)).to_have_attribute("aria-current", "page")
    listed.nth(1).click()
    expect(page.locator("h1")).to_have_text("emulator/baseline/N_0_0/rep02")
    expect(page.locator("#choose")).to_have_count(0)


@pytest.mark.long
def test_one_of_many_trials_of_a_page_is_found_by_words(page, study, tmp_path, monkeypatch):
    monkeypatch.setattr("analysis.explorer.export.FEW", 3)
    file = tmp_path / "many.html"
    list(export_page(study, file, ["*/N_0_0/*", "*/L_4_0/*"]))
    page.goto(f"file://{file}")
    found = page.get_by_label("Trials of this page").get_by_role("button")
    page.keyboard.press("/")
    page.keyboard.type("emulator N_0_0 collided")
    expect(found).to_have_text(["emulator/baseline/N_0_0/rep03: collided"])
    for scheme in ("light", "dark"):
        page.emulate_media(color_scheme=scheme)
        page.set_viewport_size({"width": 420, "height": 900})
        assert serious(page) == []
        assert page.evaluate("document.documentElement.scrollWidth - innerWidth") <= 0
    page.keyboard.press("ArrowDown")
    expect(found.first).to_be_focused()
    page.keyboard.press("Enter")
    expect(page.locator("h1")).to_have_text("emulator/baseline/N_0_0/rep03")
    address = page.url
    assert "trial=emulator" in address
    page.keyboard.press("/")
    page.keyboard.type("human")
    expect(found).to_have_count(1)
    page.keyboard.type("x")
    expect(page.get_by_label("Trials of this page")).to_contain_text("No trial has these words")
    page.keyboard.press("Escape")
    expect(page.locator("#found")).to_be_hidden()
    page.goto(address)
    expect(page.locator("h1")).to_have_text("emulator/baseline/N_0_0/rep03")


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
        list(export_folder(db, tmp_path / "pages", ["emulator/baseline/N_0_0/*"]))
    assert not (tmp_path / "pages").exists()


def test_names_that_fit_no_trial_are_told(study, tmp_path):
    with pytest.raises(UsageError, match="holds no trial called o5/"):
        list(export_page(study, tmp_path / "one.html", ["o5/*"]))


@pytest.mark.long
def test_the_list_shows_a_page_at_a_time_of_all_that_are_found(page, study, tmp_path, monkeypatch):
    monkeypatch.setattr("analysis.explorer.exported_list.PAGE", 2)
    monkeypatch.setattr("analysis.explorer.exported_list.PACKED_ROWS", 3)
    list(export_folder(study, tmp_path / "pages", ["*/N_0_0/*", "*/L_4_0/*"]))
    page.goto(f"file://{tmp_path}/pages/trials.html")
    listed = page.locator("tbody tr")
    expect(page.locator("#paging")).to_contain_text("page 1 of 5")
    expect(listed).to_have_count(2)
    first = listed.first.inner_text()
    page.get_by_role("link", name="next").click()
    expect(page.locator("#paging")).to_contain_text("page 2 of 5")
    assert listed.first.inner_text() != first
    page.reload()
    expect(page.locator("#paging")).to_contain_text("page 2 of 5")
    page.get_by_label("search").fill("rep02")
    expect(listed).to_have_count(2)
    expect(page.locator("#paging")).to_be_hidden()
    expect(page.locator("#listed")).to_have_text("2")
    page.keyboard.press("Escape")
    page.keyboard.press("j")
    page.keyboard.press("Enter")
    expect(page.locator("h1")).to_contain_text("rep02")


@pytest.mark.long
def test_charts_are_tables_too_as_soon_as_they_are_opened(page, study, tmp_path):
    file = tmp_path / "one.html"
    list(export_page(study, file, ["emulator/baseline/N_0_0/*"]))
    with duckdb.connect(str(study), read_only=True) as connection:
        (last, samples) = connection.execute(
            "SELECT max(position_m) FILTER (side = 'left'), count(*) // 2 FROM states "
            "WHERE trial_id = 'emulator/baseline/N_0_0/rep01'"
        ).fetchone()
        (plan,) = connection.execute(
            "SELECT plan FROM decisions WHERE trial_id = 'emulator/baseline/N_0_0/rep01' "
            "AND side = 'left' AND decision = 0"
        ).fetchone()
    for address in (f"file://{file}", "/trials/emulator/baseline/N_0_0/rep01"):
        page.goto(address)
        page.locator("#samples summary").click()
        rows = page.locator("#samples tbody tr")
        expect(rows).to_have_count(samples)
        expect(rows.last.locator("td").nth(1)).to_have_text(f"{last:.2f}")
        page.locator("a.decision[data-side=left]").first.click()
        page.locator(".plan-table summary").click()
        expect(page.locator(".plan-table tbody tr")).to_have_count(len(plan))
        value = page.locator(".plan-table tbody tr").first.locator("td").nth(1)
        expect(value).to_have_text(f"{plan[0] * ScenarioConfig().max_acceleration_mps2:+.2f}")
