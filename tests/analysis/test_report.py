"""The report: one file that needs nothing else, and says what can and cannot be concluded."""

from __future__ import annotations

from html.parser import HTMLParser

import duckdb
import pytest
from studies import write_study, yielding

from analysis.conclusions import not_shown, shown
from analysis.figures import FIGURES
from analysis.provenance import provenance
from analysis.published import published
from analysis.report import report_html, write_report
from analysis.study import Study
from analysis.tables import TABLES, make_tables
from merge_runner.errors import UsageError


class Page(HTMLParser):
    """What a page refers to and what it shows."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.ids, self.links, self.sources, self.words = [], [], [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        found = dict(attrs)
        self.tags.append(tag)
        self.ids += [found["id"]] if "id" in found else []
        self.links += [found["href"]] if "href" in found else []
        self.sources += [found["src"]] if "src" in found else []

    def handle_data(self, data):
        self.words.append(data)

    @property
    def text(self):
        return " ".join(" ".join(self.words).split())


@pytest.fixture(scope="module")
def page(study):
    return Page(report_html(study, make_tables(study)))


@pytest.fixture
def one_figure(monkeypatch):
    """Drawing takes most of a report's time, and other tests look at the figures."""
    name = "ablation-matrix"
    for place in ("analysis.report.FIGURES", "analysis.figures.FIGURES"):
        monkeypatch.setattr(place, {name: FIGURES[name]})


def test_the_page_needs_no_network_and_runs_nothing(page):
    assert {"script", "link", "iframe", "object"}.isdisjoint(page.tags)
    assert page.sources
    assert all(source.startswith("data:image/svg+xml;base64,") for source in page.sources)
    assert all(link.startswith("#") for link in page.links)


def test_every_link_leads_somewhere_and_every_id_is_one_of_its_kind(page):
    assert {link[1:] for link in page.links} <= set(page.ids)
    assert len(page.ids) == len(set(page.ids))


def test_every_table_and_reading_is_on_the_page(page):
    assert set(TABLES) <= set(page.ids)
    for point in published("readings")["point"]:
        assert " ".join(point.split()) in page.text


def test_numbers_lead_to_the_trials_behind_them(page):
    assert "o3/A1/L_4_8/rep05" in page.text
    assert "merge-runner sql" in page.text


@pytest.mark.usefixtures("one_figure")
def test_equal_results_give_equal_reports(tmp_path):
    db = write_study(tmp_path / "t.duckdb", yielding("o3", reps=1))
    texts = {report_html(study, make_tables(study, ["gap"])) for study in (Study(db), Study(db))}
    assert len(texts) == 1


def test_conclusions_name_power_and_missing_traces(study):
    texts = " ".join(not_shown(study, provenance(study.db)))
    assert "o3: with 110 trials a perfect copy of the humans would pass I1 to I4" in texts
    assert "human recordings are not imported" in texts
    assert "reconstruction" in texts
    said = " ".join(shown(study))
    assert "o3 collided in 0.0 % of 110 trials" in said
    assert "o3 shows, by both rules" in said
    assert "o3, by one rule alone" in said


@pytest.mark.usefixtures("one_figure")
def test_an_empty_database_concludes_nothing(tmp_path):
    study = Study(write_study(tmp_path / "t.duckdb", []))
    assert shown(study) == []
    assert "nothing can be concluded" in " ".join(not_shown(study, provenance(study.db)))
    assert "Nothing yet" in Page(report_html(study, [])).text


CALL = (
    "INSERT INTO calls BY NAME SELECT 'k' AS call_key, trial_id, spec_hash, 'left' AS side, "
    "0 AS decision, unnest([1, 2]) AS attempt, 'openai' AS provider, "
    "'o3-2025-04-16' AS model_requested, ? AS model_served, 200 AS http_status, "
    "'ok' AS outcome, false AS cached, 0.5 AS cost_usd FROM trials LIMIT 6"
)


def answered_by(folder, served):
    """A study in which six trials used one call of two attempts, answered by ``served``."""
    db = write_study(folder / "t.duckdb", yielding("o3", reps=1))
    with duckdb.connect(str(db)) as connection:
        connection.execute(CALL, [served])
    return Study(db)


@pytest.mark.usefixtures("one_figure")
def test_another_served_model_is_loud_and_its_name_is_shown_as_text(tmp_path):
    study = answered_by(tmp_path, "<script>alert(1)</script>")
    page = Page(report_html(study, []))
    assert "script" not in page.tags
    assert "Another model answered" in page.text
    assert "<script>alert(1)</script> answered 1 calls that asked for o3-2025-04-16" in page.text


def test_an_alias_is_no_other_model_and_a_shared_call_is_paid_once(tmp_path):
    origin = provenance(answered_by(tmp_path, "o3").db)
    assert origin.mismatches == []
    (row,) = origin.calls.itertuples()
    assert (row.calls, row.retries, row.cost_usd) == (1, 1, 1.0)


@pytest.mark.usefixtures("one_figure")
def test_the_report_can_write_all_its_parts_as_files(tmp_path):
    study = Study(write_study(tmp_path / "t.duckdb", yielding("o3", reps=1)))
    paths = list(write_report(study, tmp_path / "r/report.html", tmp_path / "r/files"))
    assert (tmp_path / "r/report.html") in paths
    for name in TABLES:
        for suffix in ("txt", "csv", "json", "md", "tex"):
            assert (tmp_path / "r/files" / f"{name}.{suffix}").stat().st_size > 50
    with pytest.raises(UsageError, match="cannot be written"):
        list(write_report(study, tmp_path, None))
