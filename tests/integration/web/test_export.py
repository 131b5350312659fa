"""An exported study refers to nothing but itself; no secret leaves with it."""

import re
import shutil
from html import unescape
from urllib.parse import unquote, urlsplit

import pytest

from merge_runner.config import ScenarioConfig
from merge_runner.errors import UsageError
from merge_runner.results.store import Store, query
from merge_runner_analysis.figures import FIGURES
from merge_runner_analysis.tables import TABLES
from merge_runner_analysis.web.export import export_page
from merge_runner_analysis.web.note_file import Notes
from tests.support.hostile import hostile_trial
from tests.support.serving import Page, export
from tests.support.studies import Drive, as_humans, write_study, yielding

TRIAL, OTHER = "o3/baseline/N_0_0/rep01", "o3/baseline/L_4_0/rep01"
FEW = {  # which stand for all
    "pages.tables.TABLES": {"attempts": TABLES["attempts"]},
    "pages.tables.FIGURES": {"first-action": FIGURES["first-action"]},
    "export.TABLES": {"attempts": TABLES["attempts"]},
    "export.FIGURES": {"first-action": FIGURES["first-action"]},
    "trial_index.PAGE": 3,
    "pages.trials.PAGE": 3,
}


def references(text):
    """What the attributes of a page refer to."""
    named = r'\s(?:href|src|action|data-back|data-others|data-from)="([^"]*)"'
    return [unescape(address) for address in re.findall(named, text)]


def broken(page):
    """What a page refers to that is no file beside it; a picture in the page itself is there."""
    found = []
    for address in references(page.read_text()):
        parts = urlsplit(address)
        file = page.parent / unquote(parts.path) if parts.path else page
        if not address.startswith("data:image/") and (
            parts.scheme or parts.netloc or not file.is_file()
        ):
            found.append(address)
    return found


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """Drivers with words, one of an odd name, a collision, a hostile trial and a human one."""
    path = tmp_path_factory.mktemp("study") / "study.duckdb"
    crash = Drive("o3", "baseline", "N_0_0", 9, (0.0,), (0.0,), {})
    hidden = Drive("o3\u202egpj\u200b", "baseline", "N_0_0", 1, (0.4,), (-0.4,))
    human = Drive("human", "baseline", "N_0_0", 1, (0.4, 0.4), (-0.4, -0.4))
    three = {"N_0_0", "L_4_0", "R_0_8"}
    of_o3 = [drive for drive in yielding("o3", reps=1) if drive.condition in three]
    write_study(path, [*of_o3, crash, hidden, human])
    Store(path).write("sweep-1", [hostile_trial()], patience_s=5)
    as_humans(path)
    return path


def test_all_that_an_export_of_a_study_refers_to_lies_in_it_and_asks_no_server(study, tmp_path):
    db = shutil.copy(study, tmp_path / "study.duckdb")
    Notes(db, "anna").add(TRIAL, "o3-baseline", "", None, "It hesitates.")
    with pytest.MonkeyPatch.context() as patch:
        for name, few in FEW.items():
            patch.setattr(f"merge_runner_analysis.web.{name}", few)
        export(db, tmp_path / "made")
    exported = (tmp_path / "made").rename(tmp_path / "moved")
    names = {path.relative_to(exported).as_posix() for path in exported.rglob("*")}
    assert {name.partition("/")[0] for name in names} == {"index.html", "files"}
    assert names > {
        *("files/trials.html", "files/trials-o3-baseline-N_0_0-rep01.html", "files/sweeps.html"),
        *("files/conditions-N_0_0.html", "files/tables-attempts.csv", "files/tables-attempts.tex"),
        *("files/figures-first-action.svg", "files/notes.html", "files/prompts.html"),
    }
    pages = {page: page.read_text() for page in exported.rglob("*.html")}
    assert {str(page): found for page in pages if (found := broken(page))} == {}
    assert not [page for page, text in pages.items() if "<form" in text]
    assert not [page for page, text in pages.items() if "<script>document" in text]
    said = ["".join(Page(text).said) for text in pages.values()]
    assert not [text for text in said if {"\u202e", "\u200b"} & set(text)]
    lists = [text for page, text in pages.items() if re.match(r"trials(-page-\d+)?$", page.stem)]
    assert [text.count("<td>o3[U+202E]gpj[U+200B]") for text in lists].count(1) == 1
    assert len(lists) == 3
    assert "It hesitates." in pages[exported / "files/notes.html"]
    scripts = {name.partition("static/")[2] for name in names if name.endswith(".js")}
    assert scripts.isdisjoint({"live.js", "notes.js"})
    assert "replay/start.js" in scripts


def test_a_page_of_its_own_refers_to_nothing_but_itself(study, tmp_path):
    for name, wanted in (("one.html", TRIAL), ("several.html", "o3/baseline/N_0_0/*")):
        page = export_page(study, tmp_path / name, [wanted])
        assert broken(page) == []
        text = page.read_text()
        assert {urlsplit(address).path for address in references(text)} == {""}
        assert not re.search("Trials like|The traces of|Another program holds", text)
    sql = (
        f"SELECT plan FROM decisions WHERE trial_id = '{TRIAL}' AND side = 'left' AND decision = 0"
    )
    ((plan,),) = query(study, sql)[1]
    hardest = ScenarioConfig().max_acceleration_mps2
    shown = " ".join(f"{value * hardest:+.2f}" for value in plan)
    assert f"<dd>{shown}" in text.replace("−", "-").replace("&minus;", "-")


def test_an_export_of_some_trials_takes_the_place_of_an_earlier_one_unless_it_holds_a_secret(
    study, tmp_path, monkeypatch
):
    db, folder = shutil.copy(study, tmp_path / "study.duckdb"), tmp_path / "pages"
    folder.mkdir()
    (folder / "mine.html").write_text("<title>mine</title>")
    Notes(db, "anna").add(TRIAL, "o3-baseline", "left", 1, "It hesitates.")
    Notes(db, "ben").add(OTHER, "o3-baseline", "", None, "not of all trials")
    monkeypatch.setattr("merge_runner_analysis.web.export.MOST", 1)
    for wanted, shown in (([OTHER], "not of all"), ([TRIAL, "human/*"], "It hesitates.")):
        export(db, folder, wanted)
        pages = {page.name: page.read_bytes() for page in folder.rglob("*.html")}
        trials = {name for name in pages if re.match(r"trials-.*rep01\.html$", name)}
        assert f"trials-{wanted[0].replace('/', '-')}.html" in trials
        assert (len(trials), "notes.html" in pages) == (len(wanted), False), "humans do not count"
        text = b"".join(pages.values()).decode()
        assert [note in text for note in ("not of all", "It hesitates.")].count(True) == 1
        assert shown in text
    Notes(db, "anna").add(TRIAL, "o3-baseline", "", None, "sk-proj-abcdefghijklmnop0123")
    for refused in (
        lambda: export(db, folder, [TRIAL]),
        lambda: export_page(db, folder / "one.html", [TRIAL]),
    ):
        with pytest.raises(UsageError, match="looks like a key"):
            refused()
    assert {page.name: page.read_bytes() for page in folder.rglob("*.html")} == pages
    assert {path.name for path in folder.iterdir()} == {"index.html", "files", "mine.html"}


@pytest.mark.parametrize("name", ["index.html", "files"])
def test_what_is_no_export_is_not_replaced(study, tmp_path, name):
    if name == "files":
        (tmp_path / name).mkdir()
    else:
        (tmp_path / name).write_text("<!DOCTYPE html>\n<html><title>mine</title>")
    told = f"{name} is there, and is no exported study.*name another"
    with pytest.raises(UsageError, match=told):
        export(study, tmp_path, [TRIAL])
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_of_too_many_trials_or_none_a_line_says_what_else_to_do(study, tmp_path, monkeypatch):
    monkeypatch.setattr("merge_runner_analysis.web.export.MOST", 2)
    told = "6 trials, .* for 2: .*--trials, or send study.duckdb .*view --db study.duckdb"
    with pytest.raises(UsageError, match=told):
        export(study, tmp_path / "pages")
    with pytest.raises(UsageError, match="holds no trial called o5/"):
        export_page(study, tmp_path / "one.html", ["o5/*"])
