"""Two drivers side by side: the page's numbers are the table's, and its counts lead to trials."""

import re
from dataclasses import replace
from html import unescape

import pytest

from merge_runner_analysis.selection import Selection
from merge_runner_analysis.study import StudyResults
from merge_runner_analysis.tables import make_tables
from merge_runner_analysis.web.report import report_html
from merge_runner_analysis.web.site import Site
from merge_runner_analysis.wording import UNREADABLE, brackets, capital, money, number, p_value
from tests.support.serving import client_of, listed, words_of
from tests.support.studies import Said, scaled, write_study, yielding
from tests.support.tables import values_of

A, B = "gpt-5.2", "o3"


@pytest.fixture(scope="module")
def drives():
    """B collides in three of five repetitions, A in one and brakes harder; a trial of A is lost."""
    drives = []
    for name, crashes, strength in ((A, {5}, 1.0), (B, {3, 4, 5}, 0.8)):
        for drive in scaled(yielding(name, reps=5), strength, crashes):
            is_lost = (name, drive.condition, drive.rep) == (A, "N_0_0", 2)
            said = {1: Said(("timeout",), lost=True)} if is_lost else {}
            drives.append(replace(drive, said=said))
    return drives


@pytest.fixture(scope="module")
def db(drives, tmp_path_factory):
    return write_study(tmp_path_factory.mktemp("compared") / "t.duckdb", drives)


@pytest.fixture(scope="module")
def client(db):
    return client_of(db)


def test_a_less_b_is_the_table_of_effects_with_its_interval_and_both_p(db, client):
    page = words_of(client.get(f"/drivers/{A}?with={B}").text)
    rows = values_of(StudyResults(db, Selection([B, A])), "effects")
    tested = [
        row for name, row in rows.items() if name.startswith("model=") and row["p"] is not None
    ]
    assert len(tested) >= 6
    for row in tested:
        unit = row["measure"].rpartition("(")[2].rstrip(")").replace("%", "points")
        sign, form = "+" if row["difference"] > 0 else "", money if unit == "USD" else number
        shown = f"{sign}{form(row['difference'])} {unit} {brackets(row['ci'], form)}"
        assert shown in page
        _, _, rest = page.partition(shown)
        numbers = re.match(r" (?:−\S+ 0 \+\S+ \S+ )?(\S+) (\S+)", rest).groups()
        assert numbers == (p_value(row["p"]), p_value(row["p_corrected"]))
        assert row["detectable"] is None or f"{form(row['detectable'])} {unit}" in page


def test_the_headline_says_crashes_in_counts_then_points_interval_and_p(client):
    page = client.get(f"/drivers/{A}?with={B}").text
    claim = words_of(re.search(r'<p class="answer">(.*?)</p>', page, re.S)[1])
    assert re.fullmatch(
        rf"{A} crashed in 11 of 54 trials, {B} in 33 of 55\. In the same situations {A} crashed "
        r"less often, by \d\d\.\d\d points \[\d\d\.\d\d, \d\d\.\d\d\]; corrected p < 0\.001\.",
        claim,
    )
    turned = words_of(client.get(f"/drivers/{B}?with={A}").text)
    assert f"{B} crashed in 33 of 55 trials, {A} in 11 of 54" in turned
    assert f"{B} crashed more often, by" in turned


def test_two_models_without_factors_are_what_the_first_page_and_the_report_answer(db, client):
    study = StudyResults(db)
    table = make_tables(study, ["verdicts"])
    claim = f"{A} crashed in 11 of 54 trials, {B} in 33 of 55. "
    answer = re.search(r'<p class="answer">(.*?)</p>', client.get("/").text, re.S)[1]
    assert words_of(answer).startswith(claim)
    assert claim in words_of(report_html(study, table, {}))


def test_a_comparison_that_is_computed_while_its_page_is_made_is_still_awaited(db, monkeypatch):
    made = client_of(db)
    made.get(f"/drivers/{A}?with={B}")  # the table of verdicts is there from now on
    whole = Site.computed

    class Ending:
        """A computation that ends once it was looked at."""

        def __init__(self, job):
            self.job, self.looks = job, 0

        def __getattr__(self, name):
            return getattr(self.job, name)

        @property
        def content(self):
            self.looks += 1
            return self.job.content if self.looks > 1 else None

    def computed(site, request):
        job = whole(site, request)
        return Ending(job) if request[0] == "comparison" else job

    monkeypatch.setattr(Site, "computed", computed)
    for address in (f"/drivers/{A}?with={B}", "/"):
        assert "Computing" in words_of(made.get(address).text), address


@pytest.mark.parametrize(
    ("asked", "found"), [("collided", "collided_percent"), ("of_a_plugin", None), (None, None)]
)
def test_a_database_of_one_study_says_what_it_asks(drives, tmp_path, asked, found):
    text = f'models = ["{A}"]\nrepetitions = 1\n' + (f'primary = "{asked}"' if asked else "")
    db = write_study(tmp_path / "t.duckdb", drives, config={"study": {"text": text}})
    rows = values_of(StudyResults(db), "effects")
    primary = [name for name, row in rows.items() if row["primary"]]
    assert primary == ([f"model={B}/{found}"] if found else [])


def test_every_count_leads_to_so_many_trials(client):
    page = client.get(f"/drivers/{A}?with={B}").text
    section = page[page.index('aria-labelledby="apart"') :]
    section = section[: section.index("</section>")]
    links = re.findall(r'<a href="([^"]*)">(\d+)</a>', section)
    assert {"11", "33", "55"} <= {count for _, count in links}
    for address, count in links:
        assert listed(client.get(unescape(address)).text) == int(count)


def test_a_stored_study_that_cannot_be_read_is_said_in_a_line_and_the_pages_work(drives, tmp_path):
    drives = [*drives, *(replace(drive, variant="A1") for drive in drives)]
    text = 'models = ["o3"]\nrepetitions = 1\nof_a_later_version = 1\n'
    db = write_study(tmp_path / "t.duckdb", drives, config={"study": {"text": text}})
    notes = make_tables(StudyResults(db), ["effects"])[0].notes
    (said,) = [note for note in notes if note.startswith(UNREADABLE)]
    assert "of_a_later_version" in said
    assert "\n" not in said
    with client_of(db) as client:
        assert capital(said) in words_of(client.get("/").text)
        assert client.get(f"/drivers/{A}?with={B}").status_code == 200
