"""An exported study opens from the disk, with the network off; no secret leaves with it."""

from __future__ import annotations

import re
import shutil

import duckdb
import pytest
from playwright.sync_api import expect

from analysis.explorer.export import export_folder, export_page
from merge_runner.errors import UsageError


@pytest.fixture(scope="session")
def exported(study, tmp_path_factory):
    """The study as a folder, elsewhere than it was written."""
    made = tmp_path_factory.mktemp("made") / "pages"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("analysis.explorer.export.TABLES", ["attempts"])  # one stands for all
        written = list(export_folder(study, made, []))
    assert {path.name for path in written} >= {"index.html", "trials.html", "trials-N_0_0.html"}
    return made.rename(made.with_name("moved"))


def test_a_folder_opens_from_the_disk_with_replay_and_decisions(page, exported):
    page.context.set_offline(True)
    page.goto(f"file://{exported}/index.html")
    expect(page.locator(".sweep-verdict")).to_contain_text("Finished")
    page.get_by_role("link", name="collisions").click()
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
    assert "decision=1" in page.url
    page.reload()
    expect(page.locator(".decision-panel h2")).to_contain_text("decision 1 at 1.0 s")
    page.locator("#compare").select_option(index=1)
    expect(page.locator("#ghost-key")).to_contain_text("dashed")
    page.goto(f"file://{exported}/trials.html?sweep=hostile")
    expect(page.locator("tbody tr:visible")).to_have_count(1)


def test_what_a_model_wrote_is_text_there_too(page, exported):
    page.goto(f"file://{exported}/trials-L_4_0.html?trial=<b>o3</b>/baseline/L_4_0/rep01")
    page.locator("a.decision").first.click()
    expect(page.locator(".decision-panel")).to_contain_text("<script>document.title='owned'")
    assert "owned" not in page.title()


def test_a_page_of_chosen_trials_holds_these_alone(page, study, tmp_path):
    file = tmp_path / "one.html"
    assert list(export_page(study, file, ["emulator/baseline/N_0_0/*"])) == [file]
    page.goto(f"file://{file}")
    expect(page.locator("#chooser option")).to_have_count(3)
    expect(page.locator("h1")).to_have_text("emulator/baseline/N_0_0/rep01")
    page.locator("#chooser").select_option(index=1)
    expect(page.locator("h1")).to_have_text("emulator/baseline/N_0_0/rep02")


def test_equal_blocks_of_prompts_are_there_once(study, tmp_path):
    three, one = tmp_path / "three.html", tmp_path / "one.html"
    list(export_page(study, three, ["emulator/baseline/N_0_0/*"]))
    list(export_page(study, one, ["emulator/baseline/N_0_0/rep01"]))
    frame = one.stat().st_size
    prompts = sum(len(p) for (p,) in _prompts(study))
    assert three.stat().st_size - frame < prompts / 2


def _prompts(study):
    with duckdb.connect(str(study), read_only=True) as connection:
        return connection.execute(
            "SELECT prompt FROM decisions WHERE trial_id LIKE 'emulator/baseline/N_0_0/%'"
        ).fetchall()


@pytest.mark.parametrize(
    ("said", "told"),
    [
        ("my-dummy-secret-key", "the value of OPENAI_API_KEY"),
        ("sk-proj-abcdefghijklmnop0123", "what looks like a key: sk-pro"),
        ("{cwd}/notes.txt", "names the path"),
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
        list(export_folder(db, tmp_path / "pages", []))
    assert not (tmp_path / "pages").exists()


def test_names_that_fit_no_trial_are_told(study, tmp_path):
    with pytest.raises(UsageError, match="holds no trial called o4/"):
        list(export_page(study, tmp_path / "one.html", ["o4/*"]))
