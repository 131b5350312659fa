"""The report: one file that needs nothing else, and says what can and cannot be concluded."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import duckdb
import pytest

from merge_runner.errors import UsageError
from merge_runner_analysis.data.provenance import provenance, tally
from merge_runner_analysis.data.reference_data import published
from merge_runner_analysis.data.study import Study
from merge_runner_analysis.figures import FIGURES
from merge_runner_analysis.figures.gallery import MAKERS, rendered
from merge_runner_analysis.report.page import (
    alarms,
    finished_figures,
    report_html,
    write_report,
)
from merge_runner_analysis.tables import TABLES, make_tables
from tests.support.studies import Said, write_study, yielding


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


@pytest.fixture(scope="module", autouse=True)
def one_figure():
    """Drawing takes most of a report's time, and other tests look at the figures."""
    name = "first-action"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("merge_runner_analysis.report.page.FIGURES", {name: FIGURES[name]})
        patch.setattr("merge_runner_analysis.figures.gallery.MAKERS", {name: MAKERS[name]})
        yield


@pytest.fixture(scope="module")
def page(study, tables):
    return Page(report_html(study, list(tables.values()), finished_figures(study)))


def test_the_page_needs_no_network_and_runs_nothing(page):
    assert {"script", "link", "iframe", "object"}.isdisjoint(page.tags)
    assert page.sources
    assert all(source.startswith("data:image/svg+xml;base64,") for source in page.sources)
    assert all(link.startswith("#") for link in page.links)


def test_every_link_leads_somewhere_and_every_id_is_one_of_its_kind(page):
    assert {link[1:] for link in page.links} <= set(page.ids)
    assert len(page.ids) == len(set(page.ids))


def test_every_table_and_reading_is_on_the_page(page):
    assert {*TABLES} <= {*page.ids}
    for point in published("readings")["point"]:
        assert " ".join(point.split()) in page.text


def test_numbers_lead_to_the_trials_behind_them(page):
    assert "o3/A1/L_4_8/rep05" in page.text
    assert "merge-runner sql" in page.text


def test_a_report_begins_with_the_description_the_design_the_prompts_and_the_factors(tmp_path):
    drives = [*yielding("o3", reps=1)[:3], *yielding("o3", "A1", reps=1)[:3]]
    db = write_study(tmp_path / "t.duckdb", drives, config={"description": "Who is <first>?"})
    with duckdb.connect(str(db)) as connection:
        connection.execute(
            "UPDATE decisions SET prompt = 'Drive.\n' || CASE WHEN trial_id LIKE '%/A1/%' "
            "THEN 'You are late.' ELSE 'There is time.' END"
        )
    study = Study(db)
    text = report_html(study, make_tables(study, ["factors", "gap"]), {})
    assert "<body>\n<h1>Who is &lt;first&gt;?</h1>" in text
    conditions = ", ".join(sorted(study.conditions))
    parts = ['id="design"', conditions, "There is time.", "-There is time.\n+You",
             'id="conclusions"', 'id="factors"', 'id="gap"']  # fmt: skip
    places = [text.index(part) for part in parts]
    assert places == sorted(places)
    assert text.count('id="factors"') == 1


def test_equal_results_give_equal_reports(small):
    again = Study(small.db)
    texts = {report_html(study, make_tables(study, ["gap"]), {}) for study in (small, again)}
    assert len(texts) == 1
    assert len({rendered(study, "first-action", "svg") for study in (small, again)}) == 1


def test_an_empty_database_concludes_nothing(tmp_path):
    study = Study(write_study(tmp_path / "t.duckdb", []))
    assert "No language model is judged here." in Page(report_html(study, [], {})).text


def asking(folder, said, *, variant="baseline"):
    """A study of o3 in which the first six trials had this said at their first decision."""
    drives = [replace(d, said={0: said}) for d in yielding("o3", variant, reps=1)[:6]]
    return Study(write_study(folder / "t.duckdb", drives))


def test_what_went_wrong_stands_at_the_top_before_any_number(page):
    warnings, _, _ = page.text.partition("What can be concluded")
    assert "Read this first" in warnings
    for said in (
        "Another model answered. other was asked for, impostor answered: 3 answers, in sweep-1.",
        "Trials failed. 1 of 44 of other/baseline (no answer after 2 attempts).",
        "Many fallbacks. 55 of 906 decisions of o3/A2 (6.1 %).",
        "Attempts of unknown fate. 1 of 896 of o3/A1.",
    ):
        assert said in warnings


def test_a_study_in_which_nothing_went_wrong_has_no_warning(tmp_path):
    study = asking(tmp_path, Said(), variant="A1")
    assert alarms(study, provenance(study.db)) == {}
    assert "Read this first" not in Page(report_html(study, [], {})).text


def test_another_served_model_is_loud_and_its_name_is_shown_as_text(tmp_path):
    study = asking(tmp_path, Said(served="<script>alert(1)</script>"), variant="A1")
    page = Page(report_html(study, [], {}))
    assert "script" not in page.tags
    assert "Another model answered" in page.text
    assert "o3 was asked for, <script>alert(1)</script> answered: 6 answers" in page.text


@pytest.mark.long
def test_an_alias_that_the_sweep_declares_is_no_other_model(tmp_path):
    db = asking(tmp_path, Said(served="o3-2025")).db
    for models, found in (
        ({"o3": {"id": "o3", "aliases": ["o3-2025"]}}, []),
        ({"x": {"id": "x", "aliases": ["o3-2025"]}}, ["o3-2025"]),
        ({}, ["o3-2025"]),
    ):
        with duckdb.connect(str(db)) as connection:
            connection.execute("UPDATE sweeps SET config = ?", [json.dumps({"models": models})])
        study = Study(db)
        assert [*provenance(db).mismatches.served] == found
        assert tally(study, study.models[0])["other_model"] == 6 * len(found)


@pytest.mark.slow
def test_the_fallbacks_of_a_group_are_unusual_above_one_in_twenty(tmp_path):
    study = asking(tmp_path, Said(failure="no_array"))
    found = tally(study, study.models[0])
    assert found["fallback"] == 6
    assert 0.05 < found["fallback"] / found["decisions"] < 0.07
    ((title, text),) = alarms(study, provenance(study.db)).items()
    assert title == "Many fallbacks"
    assert "6 of" in text
    with duckdb.connect(str(study.db)) as connection:
        connection.execute("UPDATE decisions SET fallback = false WHERE trial_id LIKE '%R_-4_-8%'")
    assert alarms(Study(study.db), provenance(study.db)) == {}


def test_a_driver_under_two_specs_is_named(small, tmp_path):
    db = shutil.copy(small.db, tmp_path / "t.duckdb")
    with duckdb.connect(str(db)) as connection:
        for name in ("trials", "states", "decisions"):
            connection.execute(
                f"INSERT INTO {name} SELECT * REPLACE ('changed' AS spec_hash) FROM {name} "
                "WHERE trial_id LIKE '%N_0_0%'"
            )
    ((title, text),) = alarms(Study(db), provenance(db)).items()
    assert title == "Several settings under one name"
    assert text.startswith("o3, o3 [changed].")


def test_the_report_says_what_the_replies_cost_by_model(study, page):
    origin = provenance(study.db)
    models = origin.model_costs.set_index("driver")
    # Every attempt cost a cent but the one of unknown fate.
    assert models["attempts"].to_dict() == {"o3": 3510, "other": 705}
    assert models["cost_usd"].to_dict() == pytest.approx({"o3": 35.09, "other": 7.05})
    assert models["attempts_of_unknown_cost"].to_dict() == {"o3": 1, "other": 0}
    assert "35.09" in page.text
    assert "Attempts of unknown cost are not in the sums" in page.text


def test_a_call_that_several_trials_used_was_made_and_paid_once(tmp_path):
    study = asking(tmp_path, Said(("timeout", "ok")))
    with duckdb.connect(str(study.db)) as connection:
        connection.execute("DELETE FROM calls WHERE decision > 0 OR side = 'right'")
        connection.execute("UPDATE calls SET call_key = 'k'")
    (row,) = provenance(study.db).calls.itertuples()
    assert (row.calls, row.retries, row.cost_usd) == (1, 1, 0.02)


@pytest.mark.slow
def test_the_report_can_write_all_its_parts_as_files(small, tmp_path):
    db = Path(shutil.copy(small.db, tmp_path / "t.duckdb"))
    paths = list(write_report(Study(db), tmp_path / "r/report.html", tmp_path / "r/files"))
    assert (tmp_path / "r/report.html") in paths
    for name in TABLES:
        for suffix in ("txt", "csv", "json", "md", "tex"):
            assert (tmp_path / "r/files" / f"{name}.{suffix}").stat().st_size > 50
    with pytest.raises(UsageError, match="cannot be written"):
        list(write_report(Study(db), tmp_path, None))
